"""RL Zoo's experiments, with what they lack for ours."""

import time
import warnings
from argparse import Namespace
from pathlib import Path
from typing import Any

from optuna import Study, Trial
from optuna.trial import FrozenTrial, TrialState
from rl_zoo3.exp_manager import ExperimentManager

from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.hyperparams import check_keys, hyperparams_folder, read_rate

NOISE_KEYS = ("noise_type", "noise_std")
"""Settings of which RL Zoo makes an ``action_noise``."""


class CostAwareManager(ExperimentManager):
    """
    RL Zoo's manager that reads our files of hyperparameters, hands ``env_kwargs`` on and keeps the trials of a failed search.

    :param args: of the command line
    :param algo: name of the algorithm
    :param rest: see RL Zoo's ``ExperimentManager``
    :param kwargs: likewise; without ``config``, a file of hyperparameters, it is ours, or RL Zoo's where we have none
    """

    def __init__(self, args: Namespace, algo: str, *rest: Any, **kwargs: Any) -> None:
        ours = hyperparams_folder() / f"{algo}.yml"
        if kwargs.get("config") is None and ours.is_file():
            kwargs["config"] = str(ours)
        if algo not in ALGORITHMS:
            # One that knows of no costs is evaluated like ours, and may drive where there are none
            warnings.filterwarnings("ignore", "No cost", UserWarning)
        super().__init__(args, algo, *rest, **kwargs)
        self._study: Study | None = None

    @staticmethod
    def _preprocess_schedules(hyperparams: dict[str, Any]) -> dict[str, Any]:
        rate = hyperparams.get("learning_rate")
        if not isinstance(rate, str):
            return ExperimentManager._preprocess_schedules(hyperparams)
        # RL Zoo's own schedule is negative when the last rollout goes on beyond the end
        others = {key: value for key, value in hyperparams.items() if key != "learning_rate"}
        return {**ExperimentManager._preprocess_schedules(others), "learning_rate": read_rate(rate, "the hyperparameters")}

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        processed = super()._preprocess_hyperparams(hyperparams)
        # Those of a file would reach the training alone: neither its evaluation, nor the videos, which look into args.yml
        if self._eval_env_kwargs_args is None:
            self.eval_env_kwargs = self.env_kwargs
        self.args.env_kwargs = self.env_kwargs
        if self.algo in ALGORITHMS:
            arguments = {key: value for key, value in processed[0].items() if key not in NOISE_KEYS}
            check_keys(ALGORITHMS[self.algo], arguments, f"{self.config} or --hyperparams")
        return processed

    def objective(self, trial: Trial) -> float:
        """
        Train with the settings of a trial.

        :param trial: that draws the settings
        :return: mean reward of the last evaluation
        """
        self._study = trial.study
        return super().objective(trial)

    def hyperparameters_optimization(self) -> None:
        """
        Search for the settings with the highest reward among those that keep the cost limit.

        :raises ValueError: if none of them does; the trials are written all the same
        """
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if self._study is None or _winners(self._study):
                raise
            path = Path(self.log_folder, self.algo, f"trials_{self.env_name}_{int(time.time())}.csv")
            path.parent.mkdir(parents=True, exist_ok=True)
            self._study.trials_dataframe().to_csv(path)
            found = f"None of {len(self._study.trials)} trials came to its end and kept the cost limit; they are in {path}"
            raise ValueError(f"{found}. Train for more steps, or allow a higher cost_limit.") from error


def _winners(study: Study) -> list[FrozenTrial]:
    completed = study.get_trials(states=[TrialState.COMPLETE])
    return [trial for trial in completed if all(excess <= 0 for excess in trial.constraints.values())]
