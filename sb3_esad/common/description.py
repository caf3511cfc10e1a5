"""The member of a saved model that says in plain JSON what SB3 pickles: class, policy, spaces, schedules, versions."""

import inspect
import json
import platform
import zipfile
from contextlib import suppress
from importlib import resources
from inspect import Parameter
from pathlib import Path
from typing import IO, Any

import gymnasium as gym
import stable_baselines3 as sb3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.cost_buffers import CostReplayBuffer
from sb3_esad.common.plain_values import from_plain, to_plain

DESCRIPTION = "sb3_esad.json"
"""Name of the member, which SB3's own ``load`` leaves alone."""


def is_pickled(saved: Any) -> bool:
    """
    Tell what SB3's ``load`` would unpickle.

    :param saved: a value in the member ``data``
    :return: whether it is a pickle
    """
    return isinstance(saved, dict) and ":serialized:" in saved


def settings_of(model: OffPolicyAlgorithm) -> dict[str, Any]:
    """
    List the attributes that a model is built from: its spaces, and what its constructors take.

    :param model: of any algorithm; its networks need not be there yet
    :return: their names and annotations
    """
    annotations: dict[str, Any] = {}
    constructors = [vars(each)["__init__"] for each in reversed(type(model).__mro__) if "__init__" in vars(each)]
    for constructor in constructors:
        for name, parameter in inspect.signature(constructor).parameters.items():
            annotations[name] = object if parameter.annotation in (Parameter.empty, Any) else parameter.annotation
    named = vars(model).keys() - set(model._excluded_save_params())
    given = {name: annotation for name, annotation in annotations.items() if name in named}
    return {**given, "policy_class": type, "observation_space": spaces.Space, "action_space": spaces.Space, "n_envs": int}


def add_description(file: IO[bytes], model: OffPolicyAlgorithm) -> None:
    """
    Add to a saved model the plain form of its settings.

    :param file: the zip that SB3 has written, open for reading and writing
    :param model: what was saved
    """
    with zipfile.ZipFile(file, "a") as archive:
        data = json.loads(archive.read("data"))
        settings = {}
        for name in settings_of(model):
            # What has no plain form is left out, and asked for when the model is loaded without trust
            with suppress(AttributeError, LookupError, TypeError, ValueError):
                if is_pickled(data.get(name)):
                    settings[name] = _describe(getattr(model, name), named_classes(type(model)))
        description = {"class": type(model).__name__, "settings": settings, "versions": _versions()}
        archive.writestr(DESCRIPTION, json.dumps(description, indent=4))


def _describe(value: Any, classes: dict[str, type]) -> Any:
    if isinstance(value, type):
        return {"class": {each: name for name, each in classes.items()}[value]}
    return to_plain(value)


def read_setting(plain: Any, algorithm: type[OffPolicyAlgorithm]) -> Any:
    """
    Make a setting of its description.

    :param plain: by anyone
    :param algorithm: that it is a setting of
    :return: the value
    :raises ValueError: if it is of no known kind
    """
    if isinstance(plain, dict) and plain.keys() == {"class"}:
        return named_classes(algorithm)[plain["class"]]
    return from_plain(plain)


def described_class(path: Path) -> str:
    """
    Tell which algorithm a saved model is of.

    :param path: its zip; ``.zip`` may be left out
    :return: name of the class; empty if the file does not say, or is none of ours
    """
    with suppress(OSError, LookupError, TypeError, ValueError, zipfile.BadZipFile):
        with zipfile.ZipFile(path if path.is_file() else f"{path}.zip") as archive:
            return str(json.loads(archive.read(DESCRIPTION))["class"])
    return ""


def named_classes(algorithm: type[OffPolicyAlgorithm]) -> dict[str, type]:
    """
    List the classes that a description may name.

    :param algorithm: that is described
    :return: its policies by their aliases, and the replay buffers
    """
    return {**algorithm.policy_aliases, **{each.__name__: each for each in (SequenceReplayBuffer, CostReplayBuffer)}}


def _versions() -> dict[str, str]:
    return {
        "sb3_esad": resources.files("sb3_esad").joinpath("version.txt").read_text().strip(),
        "stable_baselines3": sb3.__version__,
        "gymnasium": gym.__version__,
        "torch": th.__version__,
        "python": platform.python_version(),
    }
