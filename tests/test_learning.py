"""It learns: the short road where costs do not matter, the long one where they do."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from scipy.stats import binom
from stable_baselines3.common.monitor import Monitor

from sb3_esad import ESADLEND
from sb3_esad.common.evaluation import evaluate_policy
from sb3_esad.common.schedules import HoldThenFall

EPISODES = 100
SLIP = 0.3
"""
Standard deviation of what the wheel adds to the choice. Without it only actions near 0 would differ from their neighbours, and
an actor that follows gradients would learn from a few samples in a hundred (docs/experiments.md, section 29).
"""


class TwoRoads(gym.Env):
    """
    A junction, and two roads to the same place: a short one of three steps that costs, a long one of six that does not.

    The choice is made by the first action of an episode, and nothing that is done afterwards matters. Each step has a
    reward of -1. With an action of -1 one in two thousand episodes takes the short road.

    :param chance: of a cost of 1 in the midst of the short road
    """

    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, chance: float) -> None:
        self.chance = chance
        self.road, self.steps_left = 0, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.road = self.steps_left = 0
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if self.road == 0:
            self.road, self.steps_left = (1, 3) if action[0] > SLIP * self.np_random.standard_normal() else (-1, 6)
        self.steps_left -= 1
        midway = self.road == 1 and self.steps_left == 1
        cost = float(midway and self.np_random.random() < self.chance)
        return self._observe(), -1.0, self.steps_left == 0, False, {"cost": cost}

    def _observe(self) -> np.ndarray:
        return np.array([self.road == 0, self.road, self.steps_left / 6], dtype=np.float32)


def make_env(chance: float) -> Monitor[Any, Any]:
    """Two roads whose luck is the same in every run of the tests."""
    env = Monitor(TwoRoads(chance))
    env.reset(seed=0)
    return env


def learn(cost_limit: float | None, chance: float, seed: int) -> ESADLEND:
    return ESADLEND(
        "MlpPolicy",
        make_env(chance),
        cost_limit=cost_limit,
        learning_rate=HoldThenFall(5e-3, hold=0.5),
        learning_starts=200,
        pretrain_steps=30,
        train_freq=8,
        batch_size=8,
        sequence_length=8,
        imagination_horizon=4,
        imagination_starts=384,  # a few in a hundred are at the junction with an action that makes a difference
        uniform_action_prob=0.5,
        tau=0.05,
        ent_coef=0.2,
        lagrangian_multiplier_init=1.0,
        lambda_lr=0.1,
        penalty_warmup=20,
        buffer_size=10_000,
        policy_kwargs={
            "net_arch": [32],
            "memory_channels": 32,
            "latent_channels": 4,
            "features_extractor_kwargs": {"features_dim": 32},
        },
        seed=seed,
        device="cpu",
    ).learn(1500)


@pytest.mark.parametrize(("chance", "seed"), [(1.0, 0), (0.5, 1)])
def test_a_limit_makes_it_take_the_long_road(chance: float, seed: int) -> None:
    limit = 0.2 * chance
    model = learn(limit, chance, seed)
    # The limit is that of the worst half, so that all episodes may cost half as much; more than this in 1 % of cases then
    often = binom.ppf(0.99, EPISODES, limit / 2)
    _, _, costs = evaluate_policy(model, make_env(chance), EPISODES, deterministic=False, return_episode_rewards=True)
    assert np.sum(costs) <= often
    reward, _, _ = evaluate_policy(model, make_env(chance), EPISODES)
    assert reward < -5.9


def test_without_a_limit_it_takes_the_short_road() -> None:
    model = learn(cost_limit=None, chance=0.5, seed=1)
    reward, _, _ = evaluate_policy(model, make_env(0.5), EPISODES)
    assert reward > -3.1
