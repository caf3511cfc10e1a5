"""The replay buffer of single steps: SB3's, with costs, and with every frame stored once."""

import io
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_esad.common.cost_buffers import CostReplayBuffer
from sb3_esad.common.type_aliases import CostReplaySamples
from tests.conftest import CountingEnv

EPISODE = 7


class DictEnv(CountingEnv):
    """Two views of the number of the step."""

    observation_space = spaces.Dict({"picture": spaces.Box(0, 255, (1, 4, 4), np.uint8), "odd": spaces.Discrete(2)})

    def _observe(self) -> Any:
        return {"picture": np.full((1, 4, 4), self.count, dtype=np.uint8), "odd": self.count % 2}


def make_env(n_envs: int = 1, env_class: type[CountingEnv] = CountingEnv, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda i=i: env_class(start=1000 * i, **kwargs) for i in range(n_envs)])  # type: ignore[misc]


def make_buffer(env: VecEnv, size: int = 60) -> CostReplayBuffer:
    return CostReplayBuffer(size, env.observation_space, env.action_space, "cpu", n_envs=env.num_envs)


def collect(env: VecEnv, buffers: list[ReplayBuffer], n_steps: int) -> None:
    """Store steps as OffPolicyAlgorithm does: the last frame of an episode takes the place of the reset one."""
    obs: Any = env.reset()
    for _ in range(n_steps):
        actions = np.array([env.action_space.sample() for _ in range(env.num_envs)])
        new_obs, rewards, dones, infos = env.step(actions)
        next_obs: Any = {key: part.copy() for key, part in new_obs.items()} if isinstance(new_obs, dict) else new_obs.copy()
        for i in np.flatnonzero(dones):
            last = infos[i]["terminal_observation"]
            for key in next_obs if isinstance(next_obs, dict) else ():
                next_obs[key][i] = last[key]
            if not isinstance(next_obs, dict):
                next_obs[i] = last
        for buffer in buffers:
            buffer.add(obs, next_obs, actions, rewards, dones, infos)
        obs = new_obs


def draw(buffer: ReplayBuffer, env: VecNormalize | None = None) -> Any:
    """The same batch from every buffer."""
    np.random.seed(1)
    return buffer.sample(64, env=env)


@pytest.mark.parametrize("env_class", [CountingEnv, DictEnv])
@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_steps", [1, 13, 30, 77])
def test_samples_are_those_of_sb3(env_class: type[CountingEnv], n_envs: int, n_steps: int) -> None:
    """Young, full and wrapped, the same numbers are drawn and mean the same steps."""
    env = make_env(n_envs, env_class, episode_length=EPISODE, time_limit=5)
    kind = DictReplayBuffer if env_class is DictEnv else ReplayBuffer
    theirs = kind(30 * n_envs, env.observation_space, env.action_space, "cpu", n_envs=n_envs)  # type: ignore[arg-type]
    ours = make_buffer(env, size=30 * n_envs)
    collect(env, [ours, theirs], n_steps)
    mine, known = draw(ours), draw(theirs)
    for name in ("observations", "actions", "next_observations", "dones", "rewards"):
        th.testing.assert_close(getattr(mine, name), getattr(known, name), rtol=0, atol=0)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_cost_stays_with_its_step(n_envs: int) -> None:
    """The reward is the number of the step that is reached, and every third step costs."""
    env = make_env(n_envs, episode_length=EPISODE)
    buffer = make_buffer(env, size=30 * n_envs)
    collect(env, [buffer], 77)
    samples: CostReplaySamples = draw(buffer)
    assert samples.costs.shape == samples.rewards.shape == samples.dones.shape == (64, 1)
    assert (samples.costs == (samples.rewards % 3 == 0).float()).all() and samples.costs.any()


def test_the_last_frame_of_an_episode_is_there() -> None:
    env = make_env(2, episode_length=EPISODE)
    buffer = make_buffer(env)
    collect(env, [buffer], 77)
    samples: CostReplaySamples = draw(buffer)
    assert (samples.next_observations % 1000 == samples.rewards).all()  # type: ignore[operator]
    assert ((samples.rewards == EPISODE) == (samples.dones == 1)).all() and samples.dones.any()
    assert not hasattr(buffer, "next_observations"), "each frame is stored once"


def test_normalisation_leaves_costs_alone() -> None:
    env = VecNormalize(make_env(2, episode_length=EPISODE))
    buffer = make_buffer(env)
    collect(env.venv, [buffer], 40)
    for _ in range(40):
        env.step(np.zeros((2, 1)))
    raw, normalised = draw(buffer), draw(buffer, env)
    assert not th.equal(normalised.observations, raw.observations) and not th.equal(normalised.rewards, raw.rewards)
    assert th.equal(normalised.costs, raw.costs) and normalised.rewards.dtype == th.float32


@pytest.mark.parametrize("n_steps", [10, 77])
def test_pickling(n_steps: int) -> None:
    env = make_env(2, episode_length=EPISODE)
    buffer = make_buffer(env)
    collect(env, [buffer], n_steps)
    file = io.BytesIO()
    save_to_pkl(file, buffer)
    file.seek(0)
    loaded = load_from_pkl(file)
    for _ in range(2):
        for one, other in zip(draw(loaded), draw(buffer), strict=True):
            assert th.equal(one, other)
        collect(env, [loaded, buffer], 30)  # both go on


def test_memory_optimisation_would_lose_crashes() -> None:
    env = make_env()
    with pytest.raises(ValueError, match="optimize_memory_usage=True would lose"):
        CostReplayBuffer(10, env.observation_space, env.action_space, optimize_memory_usage=True)
