"""Callbacks that follow a training: its episodes, its progress bar, its time."""

import time
from typing import NamedTuple

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, ProgressBarCallback

from sb3_esad.common.costs import CostReader, EpisodeCosts


class TrainingEpisode(NamedTuple):
    """
    An episode of the training.

    :param step: environment steps of the training when it ended
    :param total_reward: its return, nan in environments without a ``Monitor``
    :param cost: what it has cost
    :param driving_score: in %, nan outside driving scenarios
    """

    step: int
    total_reward: float
    cost: float
    driving_score: float


class EpisodeHistory(BaseCallback):
    """Collects what became of the episodes of a training in ``episodes``."""

    def __init__(self) -> None:
        super().__init__()
        self.episodes: list[TrainingEpisode] = []

    def _on_training_start(self) -> None:
        self._costs = EpisodeCosts()
        self._read_costs = CostReader(getattr(self.model, "cost_key", "cost"))

    def _on_step(self) -> bool:
        infos = self.locals["infos"]
        for over in self._costs.add(self._read_costs(infos), self.locals["dones"]):
            info = infos[over.env]
            score = 100 * info.get("driving", {}).get("driving_score", np.nan)
            total = info.get("episode", {}).get("r", np.nan)
            self.episodes.append(TrainingEpisode(self.num_timesteps, total, over.cost, score))
        return True

    def recent(self, count: int = 20) -> TrainingEpisode | None:
        """
        Average the latest episodes.

        :param count: how many at most
        :return: the means, None before the first episode has ended
        """
        latest = self.episodes[-count:]
        return TrainingEpisode(*np.mean(latest, axis=0)) if latest else None


class EpisodeProgressBar(ProgressBarCallback):
    """
    SB3's progress bar, which also shows the mean cost of the latest training episodes, and how well they went.

    ``history`` holds the episodes, as an :class:`EpisodeHistory`.

    :raises ImportError: if tqdm or rich is missing
    """

    def __init__(self) -> None:
        super().__init__()
        self.history = EpisodeHistory()

    def _init_callback(self) -> None:
        self.history.init_callback(self.model)

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self.history.on_training_start(self.locals, self.globals)

    def _on_step(self) -> bool:
        self.history.on_step()
        recent = self.history.recent()
        if recent is not None:
            driving = not np.isnan(recent.driving_score)
            success = f"driving score {recent.driving_score:.0f} %" if driving else f"return {recent.total_reward:.4g}"
            self.pbar.set_description(f"{success}, cost {recent.cost:.2f}", refresh=False)
        return super()._on_step()


class Deadline(BaseCallback):
    """
    Ends a training when its time is over, and lets its schedules end with it.

    SB3's schedules follow the share of the steps that have been made. On a machine that is too slow to make them all, the
    learning rate would still be high at the end; here the share of the time counts where it is the larger one.

    :param minutes: from the start of the training
    """

    def __init__(self, minutes: float) -> None:
        super().__init__()
        self.minutes = minutes

    def _on_training_start(self) -> None:
        self._start, self._wanted = time.monotonic(), self.model._total_timesteps

    def _on_step(self) -> bool:
        elapsed = (time.monotonic() - self._start) / (60 * self.minutes)
        share = min(max(self.num_timesteps / self._wanted, elapsed), 1.0)
        self.model._total_timesteps = round(self.num_timesteps / share)
        return elapsed < 1
