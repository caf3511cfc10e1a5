"""RL Zoo's plots, where there is something to plot."""

import argparse
import sys
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from importlib import import_module
from itertools import product
from pathlib import Path
from unittest import mock

import numpy as np


def plot(function: str) -> None:
    """
    Let RL Zoo plot, into files where there is no screen.

    :param function: of ``rl_zoo3.plots``
    """
    from matplotlib import pyplot

    screen = pyplot.get_backend().lower() != "agg"  # which is chosen where there is none
    with nullcontext() if screen else mock.patch.object(pyplot, "show", _save_figures):
        getattr(import_module("rl_zoo3.plots"), function)()


def all_plots() -> None:
    """
    Plot and tabulate evaluations.

    RL Zoo takes an agent that was never trained, or evaluated once only, for one with results of 0: costs of 0, too.

    :raises ValueError: if there is too little to plot of an algorithm
    """
    parser = argparse.ArgumentParser(add_help=False)
    for short, long in (("-a", "--algos"), ("-e", "--env"), ("-f", "--exp-folders")):
        parser.add_argument(short, long, nargs="+", default=[])
    asked, _ = parser.parse_known_args(sys.argv[1:])
    for algorithm, env_id in product(asked.algos, asked.env):
        _check_evaluations(algorithm.lower(), env_id, asked.exp_folders)
    plot("all_plots")


def _check_evaluations(algorithm: str, env_id: str, folders: Sequence[str]) -> None:
    trained = [folder for folder in folders if Path(folder, algorithm).is_dir()] or folders
    for folder in trained:
        most = max(_evaluations(Path(folder, algorithm), env_id), default=0)
        if most < 2:
            remedy = "train longer, or with a smaller --eval-freq, or leave it out"
            found = f"{folder} holds {most} evaluations of {algorithm} on {env_id} in one training"
            raise ValueError(f"{found}, and a plot takes 2 at least: {remedy}.")


def _evaluations(folder: Path, env_id: str) -> Iterator[int]:
    """How often each training was evaluated."""
    for path in folder.glob(f"*{env_id}*/evaluations.npz"):
        with np.load(path) as evaluations:
            yield len(evaluations["timesteps"])


def _save_figures() -> None:
    from matplotlib import pyplot

    for label in pyplot.get_figlabels():
        path = Path(f"{label.replace(' ', '_')}.png")
        pyplot.figure(label).savefig(path)
        print(f"There is no screen to show it on, so it is in {path}")
