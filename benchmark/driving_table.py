"""
Learning curves as tables: ``python benchmark/driving_table.py runs/esad_lend_*.jsonl``.

A row for each evaluation and a column for each run: driving score, collision-free %, m/s, by the best actions and by sampled
ones, and the costs of the training so far. Below it what the runs were worst at after ``--from`` steps, what the training cost
from there on, and how each run ended.
"""

import argparse
import json
from pathlib import Path
from typing import Any

from sb3_esad.envs.intervals import poisson_interval

Line = dict[str, Any]
MODES = ("best", "sampled")


def read(path: Path) -> list[Line]:
    """
    Read one run.

    :param path: file that ``benchmark/driving.py`` wrote
    :return: its evaluations
    """
    return [json.loads(line) for line in path.read_text().splitlines()]


def cell(line: Line) -> str:
    """
    Set out one evaluation.

    :param line: evaluation
    :return: text for a table
    """
    shown = (f"{line[m]['DS']:.0f}, {100 * line[m]['collision_free']:.0f}, {line[m]['speed']:.0f}" for m in MODES)
    return f"{' / '.join(shown)} ({line['training_cost']:.0f})"


def ending(line: Line) -> str:
    """
    Set out the last evaluation with 95 % intervals.

    :param line: evaluation
    :return: a sentence
    """

    def interval(figures: dict[str, float], name: str, scale: float) -> str:
        low, high = (scale * figures[f"{name}_{end}"] for end in ("low", "high"))
        return f"{scale * figures[name]:.1f} [{low:.1f}, {high:.1f}]"

    shown = (("DS", 1), ("collision_free", 100), ("speed", 1), ("cost", 1))
    modes = (
        f"{mode} actions: " + ", ".join(f"{name} {interval(line[mode], name, scale)}" for name, scale in shown)
        for mode in MODES
    )
    return f"{line['steps']} steps, {line['seconds']} s of training; " + "; ".join(modes)


def budget(lines: list[Line]) -> str:
    """
    Set out what the training cost.

    :param lines: evaluations, of which the first and the last count
    :return: a sentence, with Poisson's 95 % interval
    """
    cost, episodes = (lines[-1][name] - lines[0][name] for name in ("training_cost", "training_episodes"))
    low, high = poisson_interval(cost)
    rates = f"{cost / episodes:.3f} [{low / episodes:.3f}, {high / episodes:.3f}] an episode"
    return f"{cost:.0f} costs in {episodes} episodes of training after {lines[0]['steps']} steps, {rates}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--from", type=int, default=4000, dest="first", help="steps after which a collapse counts")
    args = parser.parse_args()
    runs = {str(path.with_suffix("")): read(path) for path in args.files}
    print("| steps |", " | ".join(runs), "|\n|---|" + "---|" * len(runs))
    longest = max(runs.values(), key=len)
    for index, line in enumerate(longest):
        cells = [cell(run[index]) if index < len(run) else "" for run in runs.values()]
        print(f"| {line['steps']:,} |", " | ".join(cells), "|")
    late = [line[mode] for run in runs.values() for line in run if line["steps"] > args.first for mode in MODES]
    if late:
        free, completion = (min(figures[name] for figures in late) for name in ("collision_free", "RC"))
        print(
            f"\nAfter {args.first:,} steps at least {100 * free:.0f} % collision-free and {completion:.0f} % route completion."
        )
    for name, run in runs.items():
        print(f"\n{name}: {ending(run[-1])}")
        settled = [line for line in run if line["steps"] > args.first]
        if len({line["training_episodes"] for line in settled}) > 1:
            print(budget(settled))


if __name__ == "__main__":
    main()
