"""Evaluation of a policy with its costs."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common import evaluation
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from sb3_esad.common.costs import CostReader

StepCallback = Callable[[dict[str, Any], dict[str, Any]], None]


class EpisodeCostCollector:
    """
    Callback of SB3's ``evaluate_policy`` that sums the costs of each episode it counts.

    :param cost_key: key of the cost in the info dict
    :param callback: called after it with the same arguments
    """

    def __init__(self, cost_key: str = "cost", callback: StepCallback | None = None) -> None:
        self.episode_costs: list[float] = []
        self._read_costs = CostReader(cost_key)
        self._callback = callback
        self._running: dict[int, float] = {}

    def __call__(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        env, info = locals_["i"], locals_["info"]
        self._running[env] = self._running.get(env, 0.0) + float(self._read_costs([info])[0])
        # A Monitor tells the end of an episode from the loss of a life, see SB3's evaluate_policy.
        if locals_["done"] and ("episode" in info or not locals_["is_monitor_wrapped"]):
            self.episode_costs.append(self._running.pop(env))
        if self._callback is not None:
            self._callback(locals_, globals_)


def evaluate_policy(
    model: PolicyPredictor,
    env: gym.Env | VecEnv,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    render: bool = False,
    callback: StepCallback | None = None,
    reward_threshold: float | None = None,
    return_episode_rewards: bool = False,
    warn: bool = True,
    cost_key: str | None = None,
) -> tuple[float, float, float] | tuple[list[float], list[int], list[float]]:
    """
    SB3's ``evaluate_policy`` with the cost of the episodes as a third result.

    :param model: anything with a ``predict`` method
    :param env: environment to evaluate in
    :param n_eval_episodes: number of episodes
    :param deterministic: take the best action, not a sampled one
    :param render: show the environment
    :param callback: called after each step of each environment with ``locals()`` and ``globals()``
    :param reward_threshold: mean return below which the evaluation fails
    :param return_episode_rewards: return lists with one entry per episode
    :param warn: warn if the environment has no ``Monitor``
    :param cost_key: key of the cost in the info dict; None for that of the model, or "cost" if it has none
    :return: mean and standard deviation of the return and mean cost of an episode, or the lists of returns, lengths
        and costs of all episodes
    """
    key: str = getattr(model, "cost_key", "cost") if cost_key is None else cost_key
    collector = EpisodeCostCollector(key, callback)
    rewards, lengths = evaluation.evaluate_policy(
        model, env, n_eval_episodes, deterministic, render, collector, return_episode_rewards=True, warn=warn
    )
    mean_reward = float(np.mean(rewards))
    if reward_threshold is not None and mean_reward <= reward_threshold:
        raise AssertionError(f"Mean reward below threshold: {mean_reward:.2f} < {reward_threshold:.2f}")
    if return_episode_rewards:
        return rewards, lengths, collector.episode_costs  # type: ignore[return-value]
    return mean_reward, float(np.std(rewards)), float(np.mean(collector.episode_costs))
