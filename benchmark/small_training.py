"""A training of seconds that tells its parent process how far it is, for ``benchmark/kills.py`` to disturb."""

import hashlib
import resource
import warnings
from collections.abc import Iterator
from ctypes import c_longlong
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback

from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.common.checkpoints import CHECKPOINT, RunCheckpointCallback
from sb3_esad.common.latent_algorithm import LatentAlgorithm

INTERVAL, ROLLOUT = 40, 8
"""Steps from one checkpoint to the next, and from one training round to the next."""
COMMON = {"batch_size": 4, "buffer_size": 2000, "learning_starts": 20, "train_freq": ROLLOUT, "seed": 0, "device": "cpu"}
MODEL_FREE: dict[str, Any] = {"policy_kwargs": {"net_arch": [16]}}
IMAGINING = {
    "policy_kwargs": {"net_arch": [16], "memory_channels": 8, "latent_channels": 4},
    **{"sequence_length": 8, "imagination_starts": 16, "imagination_horizon": 3, "pretrain_steps": 1},
}


class Drift(gym.Env):
    """Stay in the middle of a road on which one drifts at random; beyond its edges it costs."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.drift, self.steps = 0.0, float(self.np_random.normal()), 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.drift += 0.3 * float(self.np_random.normal())
        self.position += 0.1 * (float(action[0]) + self.drift)
        self.steps += 1
        off = abs(self.position) > 1
        return self._observe(), 1 - abs(self.position), off, self.steps >= 25, {"cost": float(off)}

    def _observe(self) -> np.ndarray:
        return np.array([self.position, self.drift], dtype=np.float32)


class Steps(BaseCallback):
    """
    Tells the parent from which step on a training goes, and how far it is.

    :param folder: of the run
    :param pipe: to the parent
    :param steps: where to count
    :param disk_gets_full: whether no file may grow as large as the first checkpoint once that is there
    """

    def __init__(self, folder: Path, pipe: Connection, steps: c_longlong, disk_gets_full: bool) -> None:
        super().__init__()
        self.checkpoint, self.pipe, self.steps, self.disk_gets_full = folder / CHECKPOINT, pipe, steps, disk_gets_full

    def _on_training_start(self) -> None:
        self.steps.value = self.num_timesteps
        self.pipe.send(self.num_timesteps)

    def _on_step(self) -> bool:
        self.steps.value = self.num_timesteps
        if self.disk_gets_full and self.checkpoint.exists():
            resource.setrlimit(resource.RLIMIT_FSIZE, (self.checkpoint.stat().st_size // 2, resource.RLIM_INFINITY))
        return True


def train(folder: Path, algo: str, total: int, pipe: Connection, steps: c_longlong, disk_gets_full: bool) -> None:
    """
    Begin a training, or go on with it, and send its outcome.

    :param folder: of the run
    :param algo: key of ``ALGORITHMS``
    :param total: steps
    :param pipe: to the parent
    :param steps: where to count
    :param disk_gets_full: see :class:`Steps`
    """
    th.set_num_threads(1)
    algorithm: Any = ALGORITHMS[algo]
    settings = {**COMMON, **(IMAGINING if issubclass(algorithm, LatentAlgorithm) else MODEL_FREE)}
    there = (folder / CHECKPOINT).exists()
    model = algorithm.resume(folder, Drift()) if there else algorithm("MlpPolicy", Drift(), **settings)
    callbacks = [Steps(folder, pipe, steps, disk_gets_full), RunCheckpointCallback(INTERVAL, folder)]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(total, callbacks)
    told = [str(warning.message) for warning in caught if "No checkpoint" in str(warning.message)]
    pipe.send((digest(model), told))


def digest(model: Any) -> str:
    """
    Describe a model by all its numbers.

    :param model: that was trained
    :return: counters, and a hash of networks, optimisers, multiplier and replay buffer
    """
    buffer = model.replay_buffer
    numbers = hashlib.sha256()
    for value in leaves([model.get_parameters(), buffer.actions, buffer.rewards, buffer.costs, buffer.dones]):
        numbers.update(np.asarray(value).tobytes())
    counters = f"{model.num_timesteps} steps, {model._n_updates} updates, {model._episode_num} episodes"
    return f"{counters}, {numbers.hexdigest()[:16]}"


def leaves(nested: Any) -> Iterator[Any]:
    """
    List what dictionaries and lists hold.

    :param nested: a value, or a dictionary or list of such
    :return: tensors, arrays and numbers
    """
    if isinstance(nested, dict | list | tuple):
        for each in nested.values() if isinstance(nested, dict) else nested:
            yield from leaves(each)
    elif isinstance(nested, th.Tensor | np.ndarray | float | int):
        yield nested
