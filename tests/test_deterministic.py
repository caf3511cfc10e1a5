"""The same seed gives the same actions and rewards."""

from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise

from sb3_esad import ESADLEND
from tests.conftest import SPACES, TINY, RandomEnv


def run(policy: str, seed: int, **kwargs: Any) -> tuple[list[np.ndarray], np.ndarray]:
    """Learn, then act; what was done, and what it has brought."""
    env = make_vec_env(RandomEnv, 2, seed=seed, env_kwargs={"observation_space": SPACES[policy]})
    model = ESADLEND(policy, env, **{**TINY, "seed": seed, **kwargs}).learn(48)
    env.seed(seed)
    observation: Any = env.reset()
    state, actions, rewards = None, [], []
    for step in range(10):
        action, state = model.predict(observation, state, deterministic=step % 2 == 0)
        observation, reward, _, _ = env.step(action)
        actions.append(action)
        rewards.append(reward)
    return [model.replay_buffer.actions[:24], *actions], np.array(rewards)


@pytest.mark.parametrize("policy", SPACES)
def test_same_seed_same_actions_and_rewards(policy: str) -> None:
    (actions, rewards), (same_actions, same_rewards) = (run(policy, seed=3) for _ in range(2))
    for one, other in zip(actions, same_actions, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(rewards, same_rewards)


def test_another_seed_gives_something_else() -> None:
    noise = NormalActionNoise(np.zeros(1), np.ones(1))
    (actions, rewards), (others, other_rewards) = (run("MlpPolicy", seed, action_noise=noise) for seed in (3, 4))
    assert not any(np.allclose(one, other) for one, other in zip(actions, others, strict=True))
    assert not np.allclose(rewards, other_rewards)
