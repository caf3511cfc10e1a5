"""Costs reach the algorithms through the info dict of the environment, and only here."""

import warnings
from typing import Any, NamedTuple, NoReturn

import numpy as np


class CostReader:
    """
    Reads the cost of a step from the info dicts of all environments.

    A missing cost counts as zero, with one warning for each reader.

    :param cost_key: key of the cost in the info dict; its value is a bool or a number in [0, 1]
    """

    def __init__(self, cost_key: str = "cost") -> None:
        self.cost_key = cost_key
        self._warned = False

    def __call__(self, infos: list[dict[str, Any]]) -> np.ndarray:
        """
        Read one cost for each environment.

        :param infos: info dicts of one step, one for each environment
        :return: (n_envs,) float32
        :raises ValueError: if a cost is not one number in [0, 1]
        """
        return np.array([self._read(info) for info in infos], dtype=np.float32)

    def _read(self, info: dict[str, Any]) -> float:
        if self.cost_key not in info:
            self._warn_missing(info)
            return 0.0
        given = info[self.cost_key]
        # NumPy refuses lists of uneven lists by a sentence of its own
        cost = np.asarray(given, dtype=object if isinstance(given, list | tuple) else None)
        if cost.ndim > 0 or cost.dtype.kind not in "biuf" or not np.isfinite(cost) or cost < 0:
            self._refuse(info, "a cost must be one number from 0 to 1, or a bool")
        if np.float32(cost) > 1:
            self._refuse(info, "a cost must not exceed 1: divide all costs and cost_limit by the largest possible cost")
        return float(cost)

    def _refuse(self, info: dict[str, Any], reason: str) -> NoReturn:
        raise ValueError(f'info["{self.cost_key}"] is {info[self.cost_key]!r}; {reason}.')

    def _warn_missing(self, info: dict[str, Any]) -> None:
        if self._warned:
            return
        self._warned = True
        known = 'there is a "crashed": pass cost_key="crashed" to use it'
        remedy = known if "crashed" in info else "pass the cost_key that has it, or cost_limit=None and ignore this"
        warnings.warn(f'No cost: the info dict has no "{self.cost_key}", so the cost counts as 0; {remedy}.', stacklevel=2)


class FinishedEpisode(NamedTuple):
    """
    What an episode has cost.

    :param env: index of its environment
    :param cost: undiscounted sum
    :param length: in steps
    """

    env: int
    cost: float
    length: int


class EpisodeCosts:
    """Running sums of the episodes under way."""

    def __init__(self) -> None:
        self.clear()

    def clear(self) -> None:
        """Drop the episodes under way, for the environments have been reset."""
        self._start(0)

    def _start(self, n_envs: int) -> None:
        self._costs = np.zeros(n_envs)
        self._lengths = np.zeros(n_envs, dtype=np.int64)

    def add(self, costs: np.ndarray, dones: np.ndarray) -> list[FinishedEpisode]:
        """
        Add one step of all environments; another number of environments than before starts afresh.

        :param costs: (n_envs,)
        :param dones: (n_envs,) bool, the step was the last of its episode
        :return: the episodes that ended with this step
        """
        if len(costs) != len(self._costs):
            self._start(len(costs))
        self._costs += costs
        self._lengths += 1
        return [self._finish(int(env)) for env in np.flatnonzero(dones)]

    def _finish(self, env: int) -> FinishedEpisode:
        episode = FinishedEpisode(env, float(self._costs[env]), int(self._lengths[env]))
        self._costs[env] = self._lengths[env] = 0
        return episode
