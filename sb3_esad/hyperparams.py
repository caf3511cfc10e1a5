"""Hyperparameters that differ from the constructor's defaults, from plain YAML files that RL Zoo reads as well."""

import difflib
import inspect
import re
from inspect import Parameter
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack

from sb3_esad.common.recurrent_algorithm import RecurrentOffPolicyAlgorithm

RUN_KEYS = ("n_timesteps", "n_envs", "frame_stack")
"""Keys of RL Zoo that concern the training and not the algorithm."""

NAMED = (Parameter.POSITIONAL_OR_KEYWORD, Parameter.KEYWORD_ONLY)


class Hyperparams(NamedTuple):
    """
    Settings of a training.

    :param n_timesteps: environment steps
    :param n_envs: environments side by side
    :param arguments: of the algorithm's constructor
    :param frame_stack: frames shown at once
    """

    n_timesteps: int
    n_envs: int
    arguments: dict[str, Any]
    frame_stack: int = 1

    def make_env(self, env_id: str, **kwargs: Any) -> VecEnv:
        """
        Build the environments of the training.

        :param env_id: environment
        :param kwargs: see SB3's ``make_vec_env``
        :return: the environments, their frames stacked if need be
        """
        env = make_vec_env(env_id, self.n_envs, **kwargs)
        return VecFrameStack(env, self.frame_stack) if self.frame_stack > 1 else env


def load_hyperparams(algorithm: type[BaseAlgorithm], name: str, env_id: str) -> Hyperparams:
    """
    Look up the settings for an environment, or those under ``default``.

    :param algorithm: class that shall be constructed
    :param name: of the file, without ``.yml``
    :param env_id: environment
    :return: its settings
    :raises ValueError: if the file is missing or no valid YAML, or if it has a key that the constructor does not know
    """
    path = hyperparams_folder() / f"{name}.yml"
    entries = read_entries(path)
    entry = entries.get(env_id, entries.get("default"))
    if not isinstance(entry, dict):
        raise ValueError(f"{path} has neither an entry '{env_id}' nor a 'default'; add one of them.")
    arguments = {key: value for key, value in entry.items() if key not in RUN_KEYS}
    check_keys(algorithm, arguments, path)
    if "learning_rate" in arguments:
        arguments["learning_rate"] = read_rate(arguments["learning_rate"], path)
    return Hyperparams(
        n_timesteps=int(entry.get("n_timesteps", 100_000)),
        n_envs=int(entry.get("n_envs", 1)),
        arguments=arguments,
        frame_stack=int(entry.get("frame_stack", 1)),
    )


def hyperparams_folder() -> Path:
    """
    Find the YAML files, which an installed package holds and a clone has beside the package.

    :return: their folder
    """
    package = Path(__file__).parent
    installed = package / "hyperparams"
    return installed if installed.is_dir() else package.parent / "hyperparams"


def read_entries(path: Path) -> dict[str, Any]:
    """
    Read a YAML file of settings by environment id.

    :param path: of the file
    :return: its content
    :raises ValueError: if it is missing or no mapping in valid YAML
    """
    try:
        entries = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"There is no file {path}; there are {', '.join(_names(path.parent)) or 'none'}.") from error
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is no valid YAML: {' '.join(str(error).split())}.") from error
    if not isinstance(entries, dict):
        raise ValueError(f"{path} holds no settings by environment id; see {hyperparams_folder() / 'esad_lend.yml'}.")
    return entries


def read_rate(rate: Any, source: object) -> Any:
    """
    Understand a learning rate as RL Zoo does.

    :param rate: a number, or ``"lin_x"`` for one that falls from x to 0 in a straight line
    :param source: where it comes from, for the message
    :return: the number, or the function of the remaining progress
    :raises ValueError: if it is any other word
    """
    if not isinstance(rate, str):
        return rate
    linear = re.fullmatch(r"lin_(\d+(?:\.\d+)?(?:e-?\d+)?)", rate)
    if linear is None:
        raise ValueError(f"learning_rate in {source} is {rate!r}; choose a number such as 1.0e-3, or lin_0.001.")
    return LinearSchedule(float(linear[1]), end=0.0, end_fraction=1.0)


def _names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.yml"))


def check_keys(algorithm: type[BaseAlgorithm], arguments: dict[str, Any], source: object) -> None:
    """
    Refuse settings that are no arguments of a constructor.

    :param algorithm: class that shall be constructed
    :param arguments: the settings
    :param source: where they come from, for the message
    :raises ValueError: at an unknown key; the message names the nearest argument
    """
    known = constructor_arguments(algorithm)
    for key in arguments:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.0)[0]
            raise ValueError(f"'{key}' in {source} is no argument of {algorithm.__name__}; did you mean '{near}'?")


def constructor_arguments(algorithm: type[BaseAlgorithm]) -> set[str]:
    """
    List the arguments of a constructor, those it passes on to its base classes included.

    :param algorithm: class
    :return: their names, without ``env`` and private ones
    """
    names: set[str] = set()
    for each in algorithm.__mro__:
        if "__init__" not in vars(each):
            continue
        parameters = inspect.signature(each).parameters.values()
        names |= {parameter.name for parameter in parameters if parameter.kind in NAMED}
        passes_on = any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters)
        if not passes_on or each is RecurrentOffPolicyAlgorithm:  # which refuses what it does not name
            break
    return {name for name in names if name != "env" and not name.startswith("_")}
