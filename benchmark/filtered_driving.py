"""
What the filter is worth at the wheel: ``python benchmark/filtered_driving.py MODEL.zip --env esad-braking-v0``.

A trained model drives the same unseen episodes twice, without the filter and with it, so that whatever differs is the filter's
doing. With ``--buffer`` the cost critics, which the filter believes, are fitted first (see ``benchmark/calibration.py``).
The filter waits for critics that training has found calibrated; with ``--trust`` it does not.
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from driving import UNSEEN
from predict_latency import TrustedCritics

from sb3_esad import ESADLEND
from sb3_esad.common.agent import LatentAgent
from sb3_esad.common.selection import NoFilter, SafetyFilter, Selection, SelectionRates
from sb3_esad.common.type_aliases import Belief
from sb3_esad.demo import FIT_UPDATES
from sb3_esad.driving_evaluation import evaluate_model
from sb3_esad.envs.episode import Record
from sb3_esad.envs.intervals import mean_interval
from sb3_esad.report import format_table, summarise_any

COMPARED = ("return", "cost", "driving_score", "mean_speed", "min_ttc")
"""Keys of the records whose change by the filter is printed."""


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


class Counted(ESADLEND):
    """ESAD-LEND with that filter."""

    filter_class = CountedFilter


class Trusting(Counted):
    """ESAD-LEND whose filter does not wait for calibrated critics."""

    penalty_class = TrustedCritics


class Paired(NamedTuple):
    """
    What became of the same episodes.

    :param prevented: how many have a collision without the filter and none with it
    :param caused: how many have none without it and one with it
    :param changes: by key of the record, what it has with the filter less what it has without: mean and 95 % interval
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
    for key in COMPARED:
        change = np.array([new[key] - old[key] for old, new in zip(without, filtered, strict=True)])
        changes[key] = (float(change.mean()), *mean_interval(change))
    return Paired(int((before & ~after).sum()), int((after & ~before).sum()), changes)


def main() -> None:
    """Drive twice and compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--env", default="esad-highway-v0")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--seed", type=int, default=UNSEEN, help="of the first episode (default: %(default)s)")
    parser.add_argument("--buffer", type=Path, help="of the model: fit its critics first")
    parser.add_argument("--imagined-coef", type=float, default=0.33, help="weight of imagined transitions in that fit")
    parser.add_argument("--trust", action="store_true", help="let the filter judge whether or not critics are calibrated")
    args = parser.parse_args()
    th.set_num_threads(1)
    model = (Trusting if args.trust else Counted).load(args.model, device="cpu", filter_start=0)
    if args.buffer is not None:
        model.load_replay_buffer(args.buffer)
        model.fit_cost_critic(FIT_UPDATES, imagined_coef=args.imagined_coef)
    seeds = range(args.seed, args.seed + args.episodes)
    filtered = evaluate_model(model, args.env, seeds, n_envs=1)
    rates = model.policy.action_filter.rates.take()
    model.policy.action_filter = NoFilter()
    without = evaluate_model(model, args.env, seeds)
    print(format_table({"without": summarise_any(without), "filter": summarise_any(filtered)}))
    print(", ".join(f"{name} {rate:.3f}" for name, rate in rates.items()))
    paired = compare(without, filtered)
    print(f"Collisions prevented in {paired.prevented} episodes, caused in {paired.caused}")
    for key, (change, low, high) in paired.changes.items():
        print(f"{key}: {change:+.3f} [{low:+.3f}, {high:+.3f}]")


if __name__ == "__main__":
    main()
