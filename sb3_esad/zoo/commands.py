"""What ``python -m sb3_esad`` does by means of RL Zoo's scripts."""

import os
import runpy
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from pathlib import Path
from subprocess import call
from tempfile import TemporaryDirectory
from typing import Any
from unittest import mock

from imageio_ffmpeg import get_ffmpeg_exe

from sb3_esad.zoo.hub import load_from_hub, push_to_hub
from sb3_esad.zoo.plots import all_plots, plot
from sb3_esad.zoo.resuming import train


def run(command: str, arguments: Sequence[str]) -> None:
    """
    Carry out a command.

    :param command: key of ``COMMANDS``
    :param arguments: words that follow it
    :raises ValueError: if RL Zoo finds that the user must change something
    """
    given, sys.argv = sys.argv, [f"sb3_esad {command}", *arguments]
    try:
        COMMANDS[command]()
    except AssertionError as error:
        if not str(error):
            raise
        raise ValueError(str(error)) from error  # RL Zoo asserts what users give it
    finally:
        sys.argv = given


def _call(module: str, function: str) -> None:
    getattr(import_module(module), function)()


def _optimize() -> None:
    sys.argv.append("--optimize-hyperparameters")
    _call("rl_zoo3.train", "train")


def _run_script(module: str) -> None:
    runpy.run_module(module, run_name="__main__")


def _record_training() -> None:
    with _ffmpeg_on_path(), mock.patch("subprocess.call", _call_or_record):
        _run_script("rl_zoo3.record_training")


def _call_or_record(command: Any, **kwargs: Any) -> int:
    """RL Zoo films by ``python -m rl_zoo3.record_video``: whichever python comes first, which knows none of our algorithms."""
    if list(command[1:3]) != ["-m", "rl_zoo3.record_video"]:
        return call(command, **kwargs)
    run("record_video", command[3:])
    return 0


@contextmanager
def _ffmpeg_on_path() -> Iterator[None]:
    """Let a script call ffmpeg where only the package that writes our videos has it."""
    with TemporaryDirectory() as folder:
        if shutil.which("ffmpeg") is None:
            Path(folder, "ffmpeg").symlink_to(get_ffmpeg_exe())
        with mock.patch.dict(os.environ, PATH=os.pathsep.join([folder, os.environ["PATH"]])):
            yield


COMMANDS: dict[str, Callable[[], None]] = {
    "train": train,
    "optimize": _optimize,
    "enjoy": partial(_call, "rl_zoo3.enjoy", "enjoy"),
    "record_video": partial(_run_script, "rl_zoo3.record_video"),
    "record_training": _record_training,
    "plot_train": partial(plot, "plot_train"),
    "all_plots": all_plots,
    "push_to_hub": push_to_hub,
    "load_from_hub": load_from_hub,
}
