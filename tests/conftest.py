"""Fixtures and worlds with known answers."""

import resource
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_esad import ESADLEND
from sb3_esad.common.policies import LatentPolicy

TINY: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [16], "memory_channels": 8, "latent_channels": 4},
    "learning_rate": 1e-3,
    "learning_starts": 20,
    "buffer_size": 1000,
    "batch_size": 4,
    "sequence_length": 8,
    "imagination_starts": 16,
    "imagination_horizon": 3,
    "pretrain_steps": 1,
    "device": "cpu",
    "seed": 0,
}
"""Arguments that make a model small and quick."""


@pytest.fixture(autouse=True)
def same_numbers() -> Iterator[None]:
    """The same random numbers and threads for every test, whichever ran before."""
    set_random_seed(0)
    th.set_num_threads(1)
    yield


class CountingEnv(gym.Env):
    """
    The observation is the number of the step, and multiples of 3 cost 1.

    :param episode_length: steps of an episode, which ends in a terminal state
    :param time_limit: steps after which the episode is truncated instead
    :param start: first observation, to tell environments apart
    """

    observation_space: spaces.Space = spaces.Box(0.0, 1e6, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, episode_length: int = 7, time_limit: int = 1000, start: int = 0) -> None:
        self.episode_length = episode_length
        self.time_limit = time_limit
        self.start = start
        self.count = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.count = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.count += 1
        terminated = self.count >= self.episode_length
        truncated = self.count >= self.time_limit
        info = {"cost": float(self.count % 3 == 0)}
        return self._observe(), float(self.count), terminated, truncated, info

    def _observe(self) -> Any:
        return np.array([self.start + self.count], dtype=np.float32)


class RandomEnv(gym.Env):
    """
    Random observations of any space; a step costs with a chance of 1 in 5 and rewards the first entry of the action.

    :param observation_space: what is observed
    :param action_space: what is done
    :param episode_length: steps until the time limit
    """

    def __init__(
        self, observation_space: spaces.Space, action_space: spaces.Space = CountingEnv.action_space, episode_length: int = 9
    ) -> None:
        self.observation_space, self.action_space = observation_space, action_space
        self.episode_length = episode_length
        self.count = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.count = 0
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), f"{action!r} is not in {self.action_space}"
        self.count += 1
        info = {"cost": float(self.np_random.random() < 0.2)}
        return self.observation_space.sample(), float(np.ravel(action)[0]), False, self.count >= self.episode_length, info


VIEWS = spaces.Dict(
    {
        "front": spaces.Box(0, 255, (3, 24, 20), np.uint8),
        "map": spaces.Box(0, 255, (1, 16, 16), np.uint8),
        "speed": spaces.Box(-np.inf, np.inf, (2,), np.float32),
        "gear": spaces.Discrete(3),
    }
)
PICTURE = spaces.Box(0, 255, (36, 40, 3), np.uint8)
VECTOR = spaces.Box(-1.0, 1.0, (3,), np.float32)
SPACES: dict[str, spaces.Space] = {"MlpPolicy": VECTOR, "CnnPolicy": PICTURE, "MultiInputPolicy": VIEWS}
"""An observation space for each policy."""


def make_env(policy: str = "MlpPolicy", n_envs: int = 1) -> DummyVecEnv:
    return DummyVecEnv([lambda: RandomEnv(SPACES[policy])] * n_envs)


def actions_of(model: BaseAlgorithm) -> np.ndarray:
    """What the model does in some fixed situation, two steps long."""
    model.observation_space.seed(0)
    first, second = model.observation_space.sample(), model.observation_space.sample()
    one, state = model.predict(first, deterministic=True)
    other, _ = model.predict(second, state, deterministic=True)
    return np.concatenate([one, other])


def assert_same(one: Any, other: Any) -> None:
    """Equality of nested dictionaries and lists of tensors."""
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_same(one[key], other[key])
    elif isinstance(one, list | tuple):
        for each in zip(one, other, strict=True):
            assert_same(*each)
    elif isinstance(one, th.Tensor):
        assert th.equal(one, other)
    else:
        assert one == other


@pytest.fixture(scope="module")
def trace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where code leaves a trace if it is run."""
    return tmp_path_factory.mktemp("bombs") / "exploded"


@pytest.fixture(scope="module")
def nothing_else_happens(trace: Path) -> Iterator[None]:
    """No code is run, no class is changed and no memory is filled by what the tests of a module open."""
    watched = (*ESADLEND.__mro__, *LatentPolicy.__mro__, th.nn.Parameter, th.optim.Optimizer, th.FloatStorage, OrderedDict)
    names = {each: set(dir(each)) for each in watched}
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    assert not trace.exists()
    assert {name for each in watched for name in names[each] ^ set(dir(each))} <= {"__slotnames__"}  # a note of copyreg's
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory < 500_000  # kB
