"""Callbacks that move the multiplier and that judge a model by its costs."""

import os
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, ConvertCallback, EvalCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import VecEnv, sync_envs_normalization

from sb3_esad.common.evaluation import evaluate_policy
from sb3_esad.common.log_keys import key_of
from sb3_esad.common.penalties import kept_limit
from sb3_esad.common.save_util import whole_file


def prepend(first: BaseCallback, callback: MaybeCallback) -> list[BaseCallback]:
    """
    Put a callback before those of the user, unless there is one of its kind among them.

    :param first: the callback that runs first
    :param callback: what ``learn`` accepts: nothing, a callback, a list of them or a function
    :return: all callbacks
    """
    given = callback if isinstance(callback, list) else [callback]
    others = [each if isinstance(each, BaseCallback) else ConvertCallback(each) for each in given]
    there = any(isinstance(each, type(first)) for other in others for each in all_callbacks(other))
    return others if there else [first, *others]


def all_callbacks(callback: BaseCallback) -> list[BaseCallback]:
    """
    List a callback and, if it is a list, those in it.

    :param callback: any
    :return: in the order in which they run
    """
    inner = callback.callbacks if isinstance(callback, CallbackList) else []
    return [callback, *(each for child in inner for each in all_callbacks(child))]


class LagrangeCallback(BaseCallback):
    """
    Shows the penalty the costs of every step of the policy and lets it move its multiplier once per collected rollout.

    The model has a ``penalty``, a ``replay_buffer`` that reads costs and a ``take_violation()`` that returns the mean of
    Gamma - d since its last call, or None if there was no update, and the number of updates since then. Everything that must
    be remembered is in the model and its penalty, and is saved with them.
    """

    model: Any

    def _on_training_start(self) -> None:
        if self.model._last_episode_starts.all():
            self.model.penalty.forget_unfinished()

    def _on_step(self) -> bool:
        dones, infos = self.locals["dones"], self.locals["infos"]
        # What random actions have cost says nothing about the policy
        if self.num_timesteps - len(dones) >= self.model.learning_starts:
            truncated = np.array([info.get("TimeLimit.truncated", False) for info in infos])
            self.model.penalty.observe(self.model.replay_buffer.read_costs(infos), dones, truncated)
        else:
            self.model.penalty.pass_over(dones)
        return True

    def _on_rollout_end(self) -> None:
        for name, value in self.model.penalty.update(*self.model.take_violation()).items():
            self.logger.record(key_of(name), value)


RESULTS = ("last_mean_reward", "last_mean_cost", "best_mean_reward", "best_mean_cost", "_best_score")
EVALUATIONS = tuple(f"evaluations_{name}" for name in ("timesteps", "results", "length", "successes", "costs"))
"""What evaluations have found, by the names of the attributes."""


class CostEvalCallback(EvalCallback):
    """
    SB3's ``EvalCallback`` that prefers a feasible model to any infeasible one.

    Among feasible models the best has the highest reward, among infeasible ones the lowest cost; ``best_mean_reward`` is
    that of the best feasible one, minus infinity before there is one. ``evaluations.npz`` gets an array ``costs``, shaped
    like ``results``. It and ``best_model.zip`` are replaced at once, never half-written.

    :param eval_env: environment to evaluate in
    :param cost_limit: undiscounted cost allowed per episode; None takes the limit that the model keeps, if it keeps one,
        and a model without a limit is always feasible
    :param cost_key: key of the cost in the info dict; None for that of the model, or "cost" if it has none
    :param kwargs: see SB3's ``EvalCallback``
    """

    def __init__(
        self, eval_env: gym.Env | VecEnv, cost_limit: float | None = None, cost_key: str | None = None, **kwargs: Any
    ) -> None:
        super().__init__(eval_env, **kwargs)
        self.cost_limit = cost_limit
        self.cost_key = cost_key
        self.evaluations_costs: list[list[float]] = []
        self.last_mean_cost = np.inf
        self.best_mean_cost = np.inf
        self._best_score = (False, -np.inf)

    def _init_callback(self) -> None:
        super()._init_callback()
        if self.cost_limit is None:
            self.cost_limit = kept_limit(self.model)

    def _on_step(self) -> bool:
        if self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return True
        rewards, lengths, costs = self._evaluate()
        self._save_evaluations(rewards, lengths, costs)
        score = self._score(float(np.mean(rewards)), float(np.mean(costs)))
        self._log_evaluation(rewards, lengths, costs, feasible=score[0])
        continue_training = True
        if score > self._best_score:
            self._best_score = score
            continue_training = self._on_new_best()
        if self.callback is not None:
            continue_training = continue_training and self._on_event()
        return continue_training

    def state_dict(self) -> dict[str, Any]:
        """
        Give what a resumed run must know of the evaluations before it.

        :return: values that JSON has
        """
        return {name: getattr(self, name) for name in (*RESULTS, *EVALUATIONS)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Go on after the evaluations of a run that was cut off.

        :param state: what :meth:`state_dict` gave
        """
        vars(self).update(state, _best_score=tuple(state["_best_score"]))

    def _evaluate(self) -> tuple[list[float], list[int], list[float]]:
        if self.model.get_vec_normalize_env() is not None:
            sync_envs_normalization(self.training_env, self.eval_env)
        self._is_success_buffer = []
        rewards, lengths, costs = evaluate_policy(
            self.model,
            self.eval_env,
            n_eval_episodes=self.n_eval_episodes,
            render=self.render,
            deterministic=self.deterministic,
            return_episode_rewards=True,
            warn=self.warn,
            callback=self._log_success_callback,
            cost_key=self.cost_key,
        )
        self.last_mean_reward, self.last_mean_cost = float(np.mean(rewards)), float(np.mean(costs))
        return rewards, lengths, costs  # type: ignore[return-value]

    def _score(self, reward: float, cost: float) -> tuple[bool, float]:
        """Order of the models: a feasible one beats any infeasible one."""
        feasible = self.cost_limit is None or cost <= self.cost_limit
        return feasible, reward if feasible else -cost

    def _save_evaluations(self, rewards: list[float], lengths: list[int], costs: list[float]) -> None:
        if self.log_path is None:
            return
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(rewards)
        self.evaluations_length.append(lengths)
        self.evaluations_costs.append(costs)
        arrays: dict[str, Any] = {
            "timesteps": self.evaluations_timesteps,
            "results": self.evaluations_results,
            "ep_lengths": self.evaluations_length,
            "costs": self.evaluations_costs,
        }
        if self._is_success_buffer:
            self.evaluations_successes.append(self._is_success_buffer)
            arrays["successes"] = self.evaluations_successes
        with whole_file(self.log_path, ".npz") as target:
            np.savez(target, **arrays)

    def _log_evaluation(self, rewards: list[float], lengths: list[int], costs: list[float], feasible: bool) -> None:
        logs = {
            "mean_reward": self.last_mean_reward,
            "mean_ep_length": float(np.mean(lengths)),
            "mean_ep_cost": self.last_mean_cost,
            "feasible": float(feasible),
        }
        if self._is_success_buffer:
            logs["success_rate"] = float(np.mean(self._is_success_buffer))
        for name, value in logs.items():
            self.logger.record(f"eval/{name}", value)
        if self.verbose >= 1:
            print(f"Eval num_timesteps={self.num_timesteps}, episode_reward={np.mean(rewards):.2f} +/- {np.std(rewards):.2f}")
            print(f"Episode cost: {np.mean(costs):.2f} +/- {np.std(costs):.2f}")
            print(f"Episode length: {np.mean(lengths):.2f} +/- {np.std(lengths):.2f}")
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)

    def _on_new_best(self) -> bool:
        feasible, _ = self._best_score
        # SB3's callbacks that stop a training expect a reward that only rises, and that counts
        self.best_mean_reward = self.last_mean_reward if feasible else -np.inf
        self.best_mean_cost = self.last_mean_cost
        if self.verbose >= 1:
            print("New best model!")
        if self.best_model_save_path is not None:
            with whole_file(os.path.join(self.best_model_save_path, "best_model.zip")) as target:
                self.model.save(target)
        return self.callback_on_new_best is None or self.callback_on_new_best.on_step()
