"""Trials of a search that must keep the cost limit."""

from typing import Any

from optuna import Trial
from stable_baselines3.common.vec_env import VecEnv

from sb3_esad.common.callbacks import CostEvalCallback


class ConstrainedTrialCallback(CostEvalCallback):
    """
    Reports the evaluations of an Optuna trial, and how far the last of them exceeded the cost limit.

    The excess is a constraint of the trial: Optuna prefers trials that keep the limit to any that do not. The pruner compares
    the rewards of models that keep it; one that does not, or not yet, would win by what it should not do.

    :param eval_env: environment to evaluate in
    :param trial: to report to
    :param verbose: 0 silent, 1 info
    :param kwargs: see :class:`CostEvalCallback`
    """

    def __init__(self, eval_env: VecEnv, trial: Trial, verbose: int = 0, **kwargs: Any) -> None:
        super().__init__(eval_env, verbose=verbose, **kwargs)
        self.trial = trial
        self.is_pruned = False

    def _on_step(self) -> bool:
        continue_training = super()._on_step()
        if self.eval_freq > 0 and self.n_calls % self.eval_freq == 0:
            self._report(step=self.n_calls // self.eval_freq)
        return continue_training and not self.is_pruned

    def _report(self, step: int) -> None:
        feasible, _ = self._score(self.last_mean_reward, self.last_mean_cost)
        if feasible:
            self.trial.report(self.last_mean_reward, step)
            self.is_pruned = self.trial.should_prune()

    def _on_training_end(self) -> None:
        if self.cost_limit is not None:
            self.trial.set_constraint("cost", self.last_mean_cost - self.cost_limit)
