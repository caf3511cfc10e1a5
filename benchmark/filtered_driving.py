"""
What the filter does at the wheel: ``python benchmark/filtered_driving.py MODEL.zip --env esad-braking-v0``.

A trained model drives the same unseen episodes twice, with the best actions, without the filter and with it. The filter judges
whatever training has found of the critics, which may have been fitted since; ``--buffer`` fits them first, as in
``benchmark/calibration.py``.
"""

import argparse
from typing import Any, NamedTuple

import numpy as np
import torch as th
from calibration import add_fit, load_fitted
from driving import UNSEEN
from predict_latency import TrustedCritics, require_limit

from sb3_esad import ESADLEND
from sb3_esad.common.agent import LatentAgent
from sb3_esad.common.selection import NoFilter, SafetyFilter, Selection, SelectionRates
from sb3_esad.common.type_aliases import Belief
from sb3_esad.driving_evaluation import evaluate_model
from sb3_esad.envs.episode import Record
from sb3_esad.envs.intervals import mean_interval, wilson_interval
from sb3_esad.report import format_table, summarise_any

COMPARED = {
    "return": ("return", 1.0),
    "cost": ("cost", 1.0),
    "driving_score": ("driving score [%]", 100.0),
    "mean_speed": ("speed [m/s]", 1.0),
    "min_ttc": ("smallest time to collision [s]", 1.0),
}
"""Of a record, what is compared episode by episode: label and factor to its unit by key."""


class CountedFilter(SafetyFilter):
    """
    Filter that counts how often it judges and replaces actions.

    :param settings: see :class:`SafetyFilter`
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self.rates = SelectionRates()

    def select(self, agent: LatentAgent, belief: Belief, proposed: th.Tensor) -> Selection:
        """See :meth:`SafetyFilter.select`."""
        selection = super().select(agent, belief, proposed)
        self.rates.note(selection)
        return selection


class Filtered(ESADLEND):
    """ESAD-LEND with that filter, at work from the start."""

    filter_class = CountedFilter
    penalty_class = TrustedCritics


class Paired(NamedTuple):
    """
    What became of the same episodes.

    :param prevented: how many have a collision without the filter and none with it
    :param caused: how many have none without it and one with it
    :param changes: by label, what there is with the filter less what there is without: mean and 95 % interval
    """

    prevented: int
    caused: int
    changes: dict[str, tuple[float, float, float]]


def compare(without: list[Record], filtered: list[Record]) -> Paired:
    """
    Compare episode by episode.

    :param without: records of a driver
    :param filtered: of the same driver with a filter, in the same order
    :return: what differs
    """
    before, after = (np.array([record["collisions"] > 0 for record in records]) for records in (without, filtered))
    changes = {}
    for key, (label, scale) in COMPARED.items():
        change = scale * np.array([new[key] - old[key] for old, new in zip(without, filtered, strict=True)])
        changes[label] = (float(change.mean()), *mean_interval(change))
    return Paired(int((before & ~after).sum()), int((after & ~before).sum()), changes)


def report(without: list[Record], filtered: list[Record], rates: dict[str, float]) -> None:
    """
    Print what has been found.

    :param without: records of a driver
    :param filtered: of the same driver with a filter, in the same order
    :param rates: how often the filter judged and replaced actions
    """
    print(format_table({"without": summarise_any(without), "filter": summarise_any(filtered)}))
    print("Shares of all actions:", ", ".join(f"{name} {rate:.3f}" for name, rate in rates.items()))
    paired = compare(without, filtered)
    print(f"Collisions prevented in {paired.prevented} episodes, caused in {paired.caused}", end="")
    if differ := paired.prevented + paired.caused:
        low, high = wilson_interval(paired.prevented, differ)
        print(f": prevented in {paired.prevented / differ:.2f} [{low:.2f}, {high:.2f}] of those that differ", end="")
    print("\nWith the filter less without, mean of the episodes:")
    for label, (change, low, high) in paired.changes.items():
        print(f"  {label}: {change:+.2f} [{low:+.2f}, {high:+.2f}]")


def main() -> None:
    """Drive twice and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_fit(parser)
    parser.add_argument("--env", default="esad-highway-v0")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=UNSEEN, help="of the first episode (default: %(default)s)")
    args = parser.parse_args()
    th.set_num_threads(1)
    model = load_fitted(parser, args, Filtered, filter_start=0)
    require_limit(parser, args.model, model)
    # One by one: environments that stand still would be counted, and batches of another size differ in the last digit
    seeds = range(args.seed, args.seed + args.episodes)
    filtered = evaluate_model(model, args.env, seeds, n_envs=1)
    rates = model.policy.action_filter.rates.take()
    model.policy.action_filter = NoFilter()
    report(evaluate_model(model, args.env, seeds, n_envs=1), filtered, rates)


if __name__ == "__main__":
    main()
