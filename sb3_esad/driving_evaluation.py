"""Evaluation on chosen seeds: every episode is driven once and to its end, whoever drives."""

from collections import deque
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_esad.common.costs import CostReader
from sb3_esad.envs.drivers import DRIVERS
from sb3_esad.envs.episode import Record
from sb3_esad.envs.scenario import scenario_of


class SeededEpisodes(gym.Wrapper[Any, Any, Any, Any]):
    """
    Plays one episode for each seed, notes what came of it in ``records``, and then stands still.

    A record holds ``seed``, ``return``, ``cost`` and ``steps``, and all of ``info["driving"]`` if there is such a thing.

    :param env: environment
    :param seeds: of the episodes, in their order
    :param cost_key: key of the cost in the info dict
    """

    def __init__(self, env: gym.Env[Any, Any], seeds: Sequence[int], cost_key: str = "cost") -> None:
        super().__init__(env)
        self.records: list[Record] = []
        self.seed = 0
        self._running = False
        self._waiting = deque(seeds)
        self._read_costs = CostReader(cost_key)
        self._at_reset: tuple[Any, dict[str, Any]] = (None, {})

    @property
    def finished(self) -> bool:
        """Whether all episodes are over."""
        return not self._running and not self._waiting

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Start the next episode.

        :param seed: ignored
        :param options: passed on
        :return: its first observation and info; the previous ones again if there is none left
        """
        self._running = bool(self._waiting)
        if self._running:
            self.seed = self._waiting.popleft()
            self._sums = {"return": 0.0, "cost": 0.0, "steps": 0.0}
            self._at_reset = self.env.reset(seed=self.seed, options=options)
        return self._at_reset

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        Step the environment, or stand still if all episodes are over.

        :param action: passed on
        :return: what the environment returns
        """
        if not self._running:
            return self._at_reset[0], 0.0, False, False, {}
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._sums["return"] += float(reward)
        self._sums["cost"] += float(self._read_costs([info])[0])
        self._sums["steps"] += 1
        if terminated or truncated:
            self.records.append({"seed": self.seed, **info.get("driving", {}), **self._sums})
            self._running = False
        return observation, reward, terminated, truncated, info


def evaluate_model(
    model: BaseAlgorithm,
    env_id: str,
    seeds: Sequence[int],
    deterministic: bool = True,
    n_envs: int = 20,
    env_kwargs: Mapping[str, Any] | None = None,
) -> list[Record]:
    """
    Let a model drive several environments side by side.

    Environment k plays every ``n_envs``-th seed from the k-th on; that short episodes end first makes no difference.

    :param model: recurrent or not; observations are normalised as its ``VecNormalize`` does, if its environment is one, and
        stacked if it was shown stacked frames
    :param env_id: environment
    :param seeds: of the episodes
    :param deterministic: take the best action, not a sampled one
    :param n_envs: number of environments, at most one for each seed
    :param env_kwargs: further arguments of the environment
    :return: one record for each seed, in their order
    :raises ValueError: if there are no seeds, or if the model was trained on other observations or actions
    """
    if not seeds:
        raise ValueError("There are no seeds to evaluate; give at least one.")
    n_envs = min(n_envs, len(seeds))
    make = partial(_make, env_id, cost_key=getattr(model, "cost_key", "cost"), env_kwargs=env_kwargs)
    dummy_env = DummyVecEnv([partial(make, seeds[first::n_envs]) for first in range(n_envs)])
    envs: list[Any] = dummy_env.envs
    vec_env = stack_frames(BaseAlgorithm._wrap_env(dummy_env, monitor_wrapper=False), model.observation_space)
    check_spaces(model, vec_env, env_id)
    observations, state, starts = vec_env.reset(), None, np.ones(n_envs, dtype=bool)
    while not all(env.finished for env in envs):
        actions, state = model.predict(normalised(model, observations), state, starts, deterministic)
        observations, _, starts, _ = vec_env.step(actions)
    vec_env.close()
    return [envs[index % n_envs].records[index // n_envs] for index in range(len(seeds))]


def normalised(model: BaseAlgorithm, observations: Any) -> Any:
    """
    Show observations as a model knows them.

    :param model: whose environment may be a ``VecNormalize``
    :param observations: of an environment that is none
    :return: the observations, normalised as in the model's training
    """
    normalization = model.get_vec_normalize_env()
    return normalization.normalize_obs(observations) if normalization else observations


def stack_frames(env: VecEnv, space: spaces.Space) -> VecEnv:
    """
    Show as many frames at once as a space holds.

    :param env: environments
    :param space: of the observations wanted
    :return: the environments, which show stacked frames if that gives the space
    """
    n_frames = get_flattened_obs_dim(space) // get_flattened_obs_dim(env.observation_space)
    stacked = VecFrameStack(env, n_frames) if n_frames > 1 else env
    return stacked if stacked.observation_space == space else env


def evaluate_driver(name: str, env_id: str, seeds: Sequence[int]) -> list[Record]:
    """
    Let a scripted driver drive.

    :param name: key of ``DRIVERS``
    :param env_id: driving scenario
    :param seeds: of the episodes
    :return: one record for each seed, in their order
    :raises ValueError: if the environment is no driving scenario
    """
    env = _make(env_id, seeds)
    scenario = scenario_of(env)
    while not env.finished:
        env.reset()
        driver, done = DRIVERS[name](scenario, env.seed), False
        while not done:
            _, _, terminated, truncated, _ = env.step(driver(env))
            done = terminated or truncated
    env.close()
    return env.records


def check_spaces(model: BaseAlgorithm, env: VecEnv | gym.Env[Any, Any], env_id: str) -> None:
    """
    Refuse an environment whose observations or actions the model does not know.

    :param model: trained model
    :param env: environment or environments, images channel-first
    :param env_id: its name
    :raises ValueError: if the spaces differ
    """
    for kind, known, found in (
        ("Observations", model.observation_space, env.observation_space),
        ("Actions", model.action_space, env.action_space),
    ):
        if known != found:
            raise ValueError(
                f"{kind} of {env_id} are {found}, but the model was trained on {known}; give the id that it knows."
            )


def _make(
    env_id: str, seeds: Sequence[int], cost_key: str = "cost", env_kwargs: Mapping[str, Any] | None = None
) -> SeededEpisodes:
    return SeededEpisodes(gym.make(env_id, **(env_kwargs or {})), seeds, cost_key)
