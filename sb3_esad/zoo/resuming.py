"""Trainings of RL Zoo that go on after they were cut off."""

import argparse
import sys
from argparse import Namespace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.common.checkpoints import CHECKPOINT, RunCheckpointCallback
from sb3_esad.common.checks import require
from sb3_esad.common.save_util import whole_file
from sb3_esad.zoo.manager import CostAwareManager

RUN = "run.yml"
"""File in the folder of an experiment: its settings, as RL Zoo reads them, and how it was started."""


def train() -> None:
    """
    Train by RL Zoo's script, whose options are those of the command line but for two.

    :raises ValueError: if there is no training to go on with, or none that can be saved
    """
    parser = argparse.ArgumentParser(prog=sys.argv[0], add_help=False, allow_abbrev=False)
    parser.add_argument("--checkpoint-freq", type=int, metavar="N", help="save all that is needed to go on, every N steps")
    parser.add_argument("--resume", type=Path, metavar="DIR", help="go on with the experiment in this folder")
    own, words = parser.parse_known_args()
    if {"-h", "--help"} & set(words):
        print(f"{parser.format_help()}\nand those of RL Zoo:\n")
    freq = own.checkpoint_freq
    if own.resume is not None:
        run = _read_run(own.resume)
        words = [*run["command"], "--conf-file", str(own.resume / RUN), *words]
        freq = run["checkpoint_freq"] if freq is None else freq
    sys.argv[1:] = words
    script: Any = import_module("rl_zoo3.train")
    manager = script.ExperimentManager if freq is None else partial(ResumableManager, checkpoint_freq=freq, folder=own.resume)
    with mock.patch.object(script, "ExperimentManager", manager):
        script.train()


def _read_run(folder: Path) -> dict[str, Any]:
    try:
        return yaml.safe_load((folder / RUN).read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        what = "give the folder of an experiment that was started with --checkpoint-freq, such as logs/esad_lend/ENV_1"
        raise ValueError(f"{folder} has no {RUN}: {what}.") from error


class ResumableManager(CostAwareManager):
    """
    A manager whose experiment can go on after it was cut off.

    :param args: of the command line
    :param algo: name of the algorithm
    :param rest: see :class:`CostAwareManager`
    :param checkpoint_freq: steps from one checkpoint to the next
    :param folder: of an experiment to go on with; None to begin one
    :param kwargs: see :class:`CostAwareManager`
    :raises ValueError: if the algorithm cannot be resumed
    """

    def __init__(
        self, args: Namespace, algo: str, *rest: Any, checkpoint_freq: int, folder: Path | None = None, **kwargs: Any
    ) -> None:
        require(algo in ALGORITHMS, "--algo", algo, f"one of {', '.join(ALGORITHMS)}, which have checkpoints")
        super().__init__(args, algo, *rest, **kwargs)
        self.checkpoint_freq = checkpoint_freq
        self.is_new = folder is None
        if folder is not None:
            self.save_path, self.params_path = str(folder), str(folder / self.env_name)
        # A run that was cut off before its first checkpoint begins anew
        self.goes_on = folder is not None and (folder / CHECKPOINT).exists()
        self.continue_training = self.continue_training or self.goes_on

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """
        Read the settings, and note those of a new experiment.

        :return: the settings, twice
        :raises ValueError: if they cannot be noted
        """
        hyperparams, saved_hyperparams = super().read_hyperparameters()
        if self.is_new:
            self._save_run(saved_hyperparams)
        return hyperparams, saved_hyperparams

    def _preprocess_hyperparams(self, hyperparams: dict[str, Any]) -> Any:
        processed = super()._preprocess_hyperparams(hyperparams)
        if self.goes_on:
            self.monitor_kwargs = {**self.monitor_kwargs, "override_existing": False}
        return processed

    def create_callbacks(self) -> None:
        """Add the checkpoints to RL Zoo's callbacks."""
        super().create_callbacks()
        checkpoints = RunCheckpointCallback(self.checkpoint_freq, self.save_path, self.verbose)
        self.callbacks += [MonitorRecords(Path(self.save_path)), checkpoints]

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if not self.goes_on:
            return super()._load_pretrained_agent(hyperparams, env)
        model: Any = ALGORITHMS[self.algo]
        model = model.resume(self.save_path, env, self.device)
        print(f"Going on after {model.num_timesteps} steps of {self.n_timesteps}")
        return model

    def _save_run(self, saved_hyperparams: dict[str, Any]) -> None:
        command = [*sys.argv[1:], "--seed", str(self.seed)]  # which RL Zoo has drawn unless it was given
        run = {"command": command, "checkpoint_freq": self.checkpoint_freq, self.env_name.gym_id: dict(saved_hyperparams)}
        try:
            text = yaml.safe_dump(run, sort_keys=False)
        except yaml.YAMLError as error:
            raise ValueError(f"The settings have {error.args[-1]!r}, which no file can hold; give plain values.") from error
        with whole_file(Path(self.save_path, RUN)) as path:
            path.write_text(text, encoding="utf-8")


class MonitorRecords(BaseCallback):
    """
    Lets the records of the monitors go on where a checkpoint was taken; what was written after it happens once more.

    :param folder: of the records
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.folder = folder

    def _on_step(self) -> bool:
        return True

    def state_dict(self) -> dict[str, Any]:
        """
        Give the records.

        :return: the text of each file by its name
        """
        return {path.name: path.read_text(encoding="utf-8") for path in self.folder.glob("*.monitor.csv")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Write the records of a checkpoint over those that are there; the monitors append to them.

        :param state: what :meth:`state_dict` gave
        """
        for name, text in state.items():
            (self.folder / name).write_text(text, encoding="utf-8")
