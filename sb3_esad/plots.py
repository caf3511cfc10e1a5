"""The learning curve: what the training episodes earned and what they cost, side by side."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_esad.common.save_util import whole_file
from sb3_esad.progress import TrainingEpisode

WINDOW = 20


def plot_learning_curve(path: Path, episodes: Sequence[TrainingEpisode], cost_limit: float | None) -> None:
    """
    Draw return, cost and driving score of the training episodes over the steps of the environment.

    :param path: where to write the PNG
    :param episodes: in their order
    :param cost_limit: drawn dashed beside the cost, None for none
    :raises ValueError: if there are no episodes
    """
    if not episodes:
        raise ValueError("No training episode has ended, so there is no learning curve to draw; train for more steps.")
    from matplotlib.figure import Figure  # takes a second, and only this needs it

    steps, returns, costs, scores = np.array(episodes, dtype=np.float64).T
    figure = Figure(figsize=(13, 4), layout="constrained")
    for axes, label, values in zip(
        figure.subplots(1, 3), ("return", "cost", "driving score [%]"), (returns, costs, scores), strict=True
    ):
        _plot(axes, steps, values, label)
        if label == "cost" and cost_limit is not None:
            axes.axhline(cost_limit, color="black", linestyle="--", label=f"limit {cost_limit:g}")
        axes.legend()
    figure.suptitle("Training episodes, whose actions are sampled")
    with whole_file(path) as target:
        figure.savefig(target, dpi=120)


def _plot(axes: Any, steps: NDArray[np.floating], values: NDArray[np.floating], label: str) -> None:
    window = min(WINDOW, len(values))
    means = np.convolve(values, np.ones(window) / window, mode="valid")
    axes.plot(steps, values, ".", color="C0", alpha=0.25, label="episode")
    axes.plot(steps[window - 1 :], means, color="C0", label=f"mean of {window} episodes")
    axes.set(xlabel="environment steps", ylabel=label)
    axes.set_ylim(bottom=min(0.0, values.min()))
    axes.grid(alpha=0.3)
