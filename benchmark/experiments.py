"""
The experiments of docs/experiments.md by name: ``python benchmark/experiments.py E3``.

Every arm is a training with ``benchmark/driving.py`` in a process of its own, two at a time; what has been finished is kept,
also where the code has changed since: move it away then.
Those that imagine have the demo's updates, about a thousand in 20,000 steps, but for E5 and the ablations, whose filter waits
for calibrated critics, the crawl and an arm of E9: these have the settings of hyperparams/. E0, E1, E8 and E10 are scripts of
their own, with options of their own. The table pools the last evaluation of all seeds: driving score with the interval over
seeds, the rest over episodes. Costs in training are counted for each seed, and again from the step on at which all arms have
begun to learn.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from arms import EXPERIMENTS, IMAGINING, SCRIPTS, Arm
from driving import UNSEEN

from sb3_esad.envs.intervals import mean_interval, wilson_interval

PRACTISED = 4_000
SEEDS = [0, 10, 20]
"""Apart, for environment 1 of a training with seed 0 drives through the same traffic as environment 0 of one with seed 1."""


class Run(NamedTuple):
    """
    One training.

    :param env_id: scenario
    :param name: of the arm
    :param arm: what is trained
    :param seed: of the training
    :param folder: where it leaves its curve
    """

    env_id: str
    name: str
    arm: Arm
    seed: int
    folder: Path

    @property
    def curve(self) -> Path:
        """File with a line of JSON for each evaluation."""
        return self.folder / f"{self.arm.algorithm}_{self.seed}.jsonl"


def runs(name: str, envs: Sequence[str], seeds: list[int], out: Path) -> Iterator[Run]:
    """
    List the trainings of an experiment.

    :param name: key of ``EXPERIMENTS``
    :param envs: scenarios, of those that it has
    :param seeds: of the trainings
    :param out: folder of all results
    :return: one run for each scenario, arm and seed
    """
    for seed in seeds:
        for env_id in envs:
            for arm_name, arm in EXPERIMENTS[name].arms.items():
                yield Run(env_id, arm_name, arm, seed, out / name / env_id / arm_name.replace(" ", "_"))


def end_of(run: Run, unseen: int) -> dict[str, Any] | None:
    """
    Read the last evaluation of a training.

    :param run: which
    :param unseen: seed of the first episode that it must have been evaluated on, where its curve says on which
    :return: its line of the curve; None if there is none
    """
    if not run.curve.exists():
        return None
    end: dict[str, Any] = json.loads(run.curve.read_text().splitlines()[-1])
    known = end.get("unseen", unseen)
    if known != unseen:
        sys.exit(f"{run.curve} has episodes from {known}: give --unseen {known}, or another --out than its own.")
    return end


def train(run: Run, steps: int, episodes: int, unseen: int) -> None:
    """
    Train and evaluate on a thread of its own, unless that has been done.

    :param run: which
    :param steps: of the training
    :param episodes: of each evaluation
    :param unseen: seed of their first
    """
    end = end_of(run, unseen)
    if end is not None and end["steps"] >= steps:
        return
    script = Path(__file__).with_name("driving.py")
    what = [run.arm.algorithm, "--env", run.env_id, "--seed", str(run.seed), "--set", json.dumps(run.arm.changes)]
    how = ["--steps", str(steps), "--every", str(steps // 2), "--episodes", str(episodes), "--threads", "1"]
    how += ["--unseen", str(unseen)]
    how += ["--few-updates"] if run.arm.few_updates and run.arm.algorithm in IMAGINING else []
    print(f"{run.env_id}, {run.name}, seed {run.seed} ...", flush=True)
    quiet = {"stdout": subprocess.DEVNULL, "env": {**os.environ, "OMP_NUM_THREADS": "1"}}
    subprocess.run([sys.executable, str(script), *what, *how, "--out", str(run.folder)], check=True, **quiet)  # type: ignore[call-overload]


def row(name: str, ends: list[dict[str, Any]]) -> str:
    """
    Pool the ends of an arm's seeds.

    :param name: of the arm
    :param ends: last evaluations
    :return: a line of the table
    """
    cells = []
    for mode in ("best", "sampled"):
        scores = np.array([end[mode]["DS"] for end in ends])
        low, high = mean_interval(scores) if len(scores) > 1 else (ends[0][mode]["DS_low"], ends[0][mode]["DS_high"])
        n = round(sum(end[mode]["episodes"] for end in ends))
        free = round(sum(end[mode]["collision_free"] * end[mode]["episodes"] for end in ends))
        safe = 100 * np.array(wilson_interval(free, n))
        speed = np.mean([end[mode]["speed"] for end in ends])
        route, safety = np.mean([end[mode]["RC"] for end in ends]), f"{100 * free / n:.0f} [{safe[0]:.0f}, {safe[1]:.0f}]"
        cells.append(f"{scores.mean():.1f} [{low:.1f}, {high:.1f}], {safety}, {route:.0f}, {speed:.1f}")
    nearness = np.mean([end["best"]["TTC_5"] for end in ends])
    later = [sum(step > PRACTISED for step in end["cost_steps"]) for end in ends]
    costs = ", ".join(f"{len(end['cost_steps'])} ({n})" for end, n in zip(ends, later, strict=True))
    minutes = ", ".join(f"{end['seconds'] / 60:.0f}" for end in ends)
    return f"| {name} | {' | '.join(cells)} | {nearness:.2f} | {costs} | {filtered(ends)} | {minutes} |"


def filtered(ends: list[dict[str, Any]]) -> str:
    """
    Say what the filter did in the last part of the trainings.

    :param ends: last evaluations of an arm
    :return: shares of the steps that it judged, and of the actions that it replaced, for each seed
    """
    rates = [[end.get("log", {}).get(f"rollout/{name}") for name in ("filter_rate", "intervention_rate")] for end in ends]
    return ", ".join(f"{judged:.2f} / {replaced:.2f}" for judged, replaced in rates if judged is not None)


def print_table(every: list[Run], unseen: int) -> None:
    """
    Print what has been found so far.

    :param every: trainings of an experiment
    :param unseen: seed of the first episode of their evaluations
    """
    print("| scenario, arm | best: DS, collision-free %, RC %, m/s | sampled | best: TTC_5 [s] | ", end="")
    print("costs in training | filter at work / replaced | minutes |")
    print("|---|---|---|---|---|---|---|")
    ends: dict[str, list[dict[str, Any]]] = {}
    for run in every:
        end = end_of(run, unseen)
        if end is not None:
            ends.setdefault(f"{run.env_id}, {run.name}", []).append(end)
    for label, lines in ends.items():
        print(row(label, lines))


def main() -> None:
    """Run an experiment, or print its table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=[*EXPERIMENTS, *SCRIPTS])
    parser.add_argument("--seeds", type=int, nargs="+", default=SEEDS)
    parser.add_argument("--envs", nargs="+", help="scenarios, instead of all that the experiment has")
    parser.add_argument("--steps", type=int, help="of each training, instead of those that the experiment has")
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument("--unseen", type=int, default=UNSEEN, help="see benchmark/driving.py")
    parser.add_argument("--out", type=Path, default=Path("runs"))
    parser.add_argument("--table", action="store_true", help="print what has been found so far")
    args = parser.parse_args()
    if args.name in SCRIPTS:
        for script, *arguments in SCRIPTS[args.name]:
            subprocess.run([sys.executable, str(Path(__file__).with_name(script)), *arguments], check=True)
        return
    experiment = EXPERIMENTS[args.name]
    every = list(runs(args.name, args.envs or experiment.envs, args.seeds, args.out))
    if not args.table:
        for run in every:
            end_of(run, args.unseen)  # hours of training must not end with a curve that is refused
        with ThreadPoolExecutor(2) as two:
            list(two.map(lambda run: train(run, args.steps or experiment.steps, args.episodes, args.unseen), every))
    print(f"{args.name}: {experiment.question}\n")
    print_table(every, args.unseen)


if __name__ == "__main__":
    main()
