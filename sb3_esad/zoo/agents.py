"""Agents in the folders of RL Zoo and in those of the Hub, whose files have the names that RL Zoo gives them."""

import re
import shutil
import zipfile
import zlib
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from huggingface_sb3 import EnvironmentName, ModelName
from rl_zoo3.utils import get_model_path, get_saved_hyperparams
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.hyperparams import RUN_KEYS, constructor_arguments

CONFIG, ARGUMENTS, ENV_KWARGS, CURVES = "config.yml", "args.yml", "env_kwargs.yml", "train_eval_metrics.zip"
EXPRESSIONS = ("policy_kwargs", "replay_buffer_class", "replay_buffer_kwargs")
"""Settings that RL Zoo takes for Python where they are words."""
LARGEST_CURVE = 2**26
"""Bytes of a learning curve at most."""

Settings = dict[str, Any]


class Agent(NamedTuple):
    """
    A trained model and where it comes from.

    :param algo: key of ``ALGORITHMS``
    :param env: environment
    :param model: its zip
    :param curves: folder with ``evaluations.npz`` and the records of the monitors
    :param config: settings of the training
    :param env_kwargs: arguments of the environment
    """

    algo: str
    env: EnvironmentName
    model: Path
    curves: Path
    config: Settings
    env_kwargs: Settings


def find_agent(args: Namespace) -> Agent:
    """
    Look up an agent that RL Zoo has trained on this machine.

    :param args: ``algo``, ``env``, ``folder``, ``exp_id`` and ``load_best``, as RL Zoo's scripts have them
    :return: the agent
    :raises AssertionError: if there is no such folder
    :raises ValueError: if there is no such model, or if a stranger would have to run code to use it
    """
    _, model, log_path = get_model_path(args.exp_id, args.folder, args.algo, args.env, args.load_best)
    settings = Path(log_path, args.env)
    config, _ = get_saved_hyperparams(str(settings))
    if not config["normalize"]:
        del config["normalize"]  # which RL Zoo adds
    config.pop("env_kwargs", None)
    # Written by RL Zoo on this machine, or by load_from_hub in plain values
    arguments = yaml.load((settings / ARGUMENTS).read_text(encoding="utf-8"), yaml.UnsafeLoader)
    env_kwargs = arguments["env_kwargs"] or {}
    check_settings(config, args.algo, settings / CONFIG)
    return Agent(args.algo, args.env, Path(model), Path(log_path), config, env_kwargs)


def check_settings(settings: Mapping[str, Any], algo: str, source: object) -> None:
    """
    Refuse settings that name code to run, as wrappers, callbacks and RL Zoo's expressions in Python do.

    :param settings: of a training
    :param algo: key of ``ALGORITHMS``
    :param source: where they come from, for the message
    :raises ValueError: if there is anything but plain arguments of the algorithm
    """
    algorithm = ALGORITHMS[algo]
    shared = {*constructor_arguments(algorithm), *RUN_KEYS}
    named = {key for key in EXPRESSIONS if isinstance(settings.get(key), str)}
    foreign = [str(key) for key in settings if key not in shared or key in named]
    if foreign:
        what = f"only plain arguments of {algorithm.__name__} and {', '.join(RUN_KEYS)} are shared"
        raise ValueError(f"{source} has {', '.join(foreign)}; {what}, for others may name code to run.")


def pack(folder: Path, agent: Agent) -> None:
    """
    Write the files by which others can use an agent.

    :param folder: where to
    :param agent: trained on this machine
    :raises ValueError: if its settings are no plain values
    """
    shutil.copy(agent.model, folder / ModelName(agent.algo, agent.env).filename)
    _write_settings(folder, agent)
    with zipfile.ZipFile(folder / CURVES, "w", zipfile.ZIP_DEFLATED) as archive:
        for path in sorted(agent.curves.iterdir()):
            if _is_curve(path.name):
                archive.write(path, path.name)


def _write_settings(folder: Path, agent: Agent) -> None:
    arguments = {"algo": agent.algo, "env": agent.env.gym_id, "env_kwargs": agent.env_kwargs}
    for name, content in ((CONFIG, agent.config), (ARGUMENTS, arguments), (ENV_KWARGS, agent.env_kwargs)):
        try:
            text = yaml.safe_dump(dict(content), sort_keys=False)
        except yaml.YAMLError as error:
            raise ValueError(f"{name} has {error.args[-1]!r}, which only a program can read; give plain values.") from error
        (folder / name).write_text(text, encoding="utf-8")


def unpack(folder: Path, algo: str, env: EnvironmentName, target: Path, trusted: bool) -> None:
    """
    Lay an agent of the Hub where RL Zoo looks for it.

    Nothing of it is taken as it is: the model is loaded and saved anew, settings are read as plain values and written anew,
    for RL Zoo would run what code they hold.

    :param folder: what was downloaded
    :param algo: key of ``ALGORITHMS``
    :param env: environment
    :param target: folder of the experiment, which must not exist
    :param trusted: let the model run what code it holds
    :raises ValueError: if a file is missing, or holds more than plain values
    """
    config, env_kwargs = (_read_settings(folder / name) for name in (CONFIG, ENV_KWARGS))
    check_settings(config, algo, CONFIG)
    model = load_shared(algo, folder / ModelName(algo, env).filename, trusted)
    (target / env).mkdir(parents=True)
    model.save(target / f"{env}.zip")
    _write_settings(target / env, Agent(algo, env, target / f"{env}.zip", target, config, env_kwargs))
    if (folder / CURVES).exists():
        _unpack_curves(folder / CURVES, target)


def load_shared(algo: str, path: Path, trusted: bool) -> OffPolicyAlgorithm:
    """
    Load a model that anyone may have made.

    :param algo: key of ``ALGORITHMS``
    :param path: its zip
    :param trusted: let it run what code it holds
    :return: the model
    :raises ValueError: if it is missing, or holds code although it is not trusted
    """
    return ALGORITHMS[algo].load(path, trusted=trusted)


def _read_settings(path: Path) -> Settings:
    try:
        settings = yaml.safe_load(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise ValueError(f"The repository has no {path.name}; give one that push_to_hub has made.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path.name} holds more than plain values ({' '.join(str(error).split())}).") from error
    if not isinstance(settings, dict):
        raise ValueError(f"{path.name} holds {settings!r} instead of settings by their names.")
    return settings


def _unpack_curves(path: Path, target: Path) -> None:
    try:
        with zipfile.ZipFile(path) as archive:
            for name in filter(_is_curve, archive.namelist()):
                with archive.open(name) as member:
                    content = member.read(LARGEST_CURVE + 1)
                if len(content) > LARGEST_CURVE:
                    raise ValueError(f"{name} in {path.name} is larger than {LARGEST_CURVE >> 20} MiB.")
                (target / name).write_bytes(content)
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise ValueError(f"{path.name} is cut off or damaged ({error}).") from error


def _is_curve(name: str) -> bool:
    return name == "evaluations.npz" or re.fullmatch(r"\d+\.monitor\.csv", name) is not None
