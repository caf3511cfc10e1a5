"""Every algorithm of the package, small and quick, for what Stable-Baselines3 promises of each of its own."""

from typing import Any

import gymnasium as gym
import pytest
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_esad import ESADLEND
from sb3_esad.algorithms import ALGORITHMS
from tests.conftest import TINY, CountingEnv

MODEL_FREE: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [8]},
    "learning_starts": 20,
    "train_freq": 4,
    "buffer_size": 1000,
    "batch_size": 8,
    "device": "cpu",
    "seed": 0,
}

every_algorithm = pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)

Algorithm = type[OffPolicyAlgorithm]


def imagines(algorithm: Algorithm) -> bool:
    """Whether it has a world model; the others are SB3's SAC with cost critics."""
    return issubclass(algorithm, ESADLEND)


def tiny(algorithm: Algorithm) -> dict[str, Any]:
    """Arguments that make it small and quick."""
    return TINY if imagines(algorithm) else MODEL_FREE


def make(algorithm: Algorithm, policy: str = "MlpPolicy", env: gym.Env | VecEnv | None = None, **kwargs: Any) -> Any:
    """A small model; ``policy_kwargs`` are those of small networks and what else is given."""
    settings = tiny(algorithm)
    policy_kwargs = {**settings["policy_kwargs"], **kwargs.pop("policy_kwargs", {})}
    return algorithm(policy, env or CountingEnv(), **{**settings, "policy_kwargs": policy_kwargs, **kwargs})
