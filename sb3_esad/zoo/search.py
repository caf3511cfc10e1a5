"""Where Optuna looks for better settings."""

from typing import Any, NamedTuple

from optuna import Trial
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_esad.hyperparams import constructor_arguments, read_rate


class Range(NamedTuple):
    """
    Numbers between two bounds, which differ by factors rather than by steps.

    :param low: smallest
    :param high: largest
    """

    low: float
    high: float

    def suggest(self, trial: Trial, name: str) -> float:
        """
        Draw a number.

        :param trial: that draws
        :param name: of the setting
        :return: the number
        """
        return trial.suggest_float(name, self.low, self.high, log=True)


class Choice(NamedTuple):
    """
    A few values.

    :param values: all of them
    """

    values: tuple[Any, ...]

    def suggest(self, trial: Trial, name: str) -> Any:
        """
        Draw a value.

        :param trial: that draws
        :param name: of the setting
        :return: the value
        """
        return trial.suggest_categorical(name, self.values)


SPACE: dict[str, Range | Choice] = {
    "learning_rate": Range(1e-4, 2e-2),
    "gamma": Choice((0.95, 0.97, 0.98, 0.99)),
    "cost_gamma": Choice((0.8, 0.9, 0.95, 0.97)),
    "tau": Range(0.005, 0.05),
    "ent_coef": Choice(("auto_0.01", "auto_0.03", "auto_0.1")),
    "sequence_length": Choice((8, 16, 32)),
    "imagination_horizon": Choice((5, 10, 15)),
    "lagrangian_multiplier_init": Range(0.5, 20.0),
    "lambda_lr": Range(1e-3, 0.1),
    "penalty_coef": Range(0.1, 10.0),
}
"""
Settings by the name of their argument; an algorithm's search is over those that its constructor has.

What is wanted, ``cost_limit`` and ``risk_level``, is nothing to be searched for.
"""


def sample(
    algorithm: type[BaseAlgorithm], trial: Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Draw the arguments of a trial.

    :param algorithm: class that will be constructed
    :param trial: that draws
    :param n_actions: ignored; all arguments of RL Zoo's samplers but the first
    :param n_envs: ignored
    :param additional_args: ignored
    :return: arguments of the constructor
    """
    names = constructor_arguments(algorithm)
    settings = convert({name: each.suggest(trial, name) for name, each in SPACE.items() if name in names})
    return {**settings, "learning_rate": read_rate(settings["learning_rate"], "the search")}


def convert(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    Turn what was drawn into settings as they stand in the files of ``hyperparams/``.

    :param sampled_params: of a trial
    :return: the settings; the learning rate falls to zero, as all do that were found to be good
    """
    return {**sampled_params, "learning_rate": f"lin_{sampled_params['learning_rate']}"}
