"""
What a training survives: ``python benchmark/kills.py --kills 20``.

A small training on one thread is killed (SIGKILL) again and again, every other time in the midst of a save, and resumed each
time until it ends; then another one has a disk that is full after its first checkpoint, and is resumed. Prints what came of
it, and ends with exit code 1 unless each kill was followed by a run that went on from the newest checkpoint, no checkpoint was
lost, no more than an interval and a rollout had to be made again, and both ended as the training that nobody disturbed.
"""

import argparse
import io
import json
import multiprocessing
import random
import sys
import time
import zipfile
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

from small_training import INTERVAL, ROLLOUT, train

from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.common.checkpoints import CHECKPOINT, MODEL

SAVE = 0.05
"""Seconds that a save takes at least."""


class Training:
    """
    A training in a process of its own.

    :param folder: of the run
    :param algo: key of ``ALGORITHMS``
    :param total: steps
    :param disk_gets_full: see :class:`small_training.Steps`
    """

    def __init__(self, folder: Path, algo: str, total: int, disk_gets_full: bool = False) -> None:
        # Each process is forked from one that has done nothing but import, also what torch's optimisers do late
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload(["sb3_esad", "torch._dynamo"])
        self.folder = folder
        self.pipe, theirs = context.Pipe()
        self.steps = context.RawValue("q", 0)
        self.process = context.Process(target=train, args=(folder, algo, total, theirs, self.steps, disk_gets_full))
        self.process.start()
        theirs.close()
        self.start = self.pipe.recv()

    def kill(self, in_a_save: bool, longest: float) -> None:
        """
        Kill it.

        :param in_a_save: wait until it saves
        :param longest: else wait for a part of these seconds
        """
        while in_a_save and self.process.is_alive() and not is_saving(self.folder):
            time.sleep(0.001)
        time.sleep(random.uniform(0, SAVE if in_a_save else longest))
        self.process.kill()
        self.process.join()

    def end(self) -> tuple[str, list[str]]:
        """
        Wait until it has ended.

        :return: its digest and what it has warned of
        """
        outcome = self.pipe.recv()
        self.process.join()
        return outcome


def is_saving(folder: Path) -> bool:
    """
    Tell whether a checkpoint is being written, or was when the process was killed.

    :param folder: of the run
    :return: whether there is an unfinished one
    """
    return any(folder.glob(f".*.{CHECKPOINT}"))


def steps_of(folder: Path) -> int:
    """
    Read the newest checkpoint.

    :param folder: of the run
    :return: its steps, -1 if there is none or if it is damaged
    """
    try:
        with zipfile.ZipFile(folder / CHECKPOINT) as archive:
            if archive.testzip() is not None:
                return -1
            with zipfile.ZipFile(io.BytesIO(archive.read(MODEL))) as model:
                return json.loads(model.read("data"))["num_timesteps"]
    except (FileNotFoundError, zipfile.BadZipFile):
        return -1


class Outcome(NamedTuple):
    """
    What came of a training that was killed again and again.

    :param kills: how often
    :param in_a_save: how many of these left an unfinished checkpoint behind
    :param resumed: after how many it went on from the newest checkpoint
    :param lost: how many checkpoints were lost
    :param repeated: steps that had to be made again after a kill, at most
    :param digest: of the model in the end
    """

    kills: int
    in_a_save: int
    resumed: int
    lost: int
    repeated: int
    digest: str


def endure(folder: Path, algo: str, total: int, kills: int, longest: float) -> Outcome:
    """
    Kill a training again and again, and let it end.

    :param folder: of the run
    :param algo: key of ``ALGORITHMS``
    :param total: steps
    :param kills: how often; every other one waits for a save
    :param longest: seconds until the others, at most
    :return: what came of it
    """
    in_a_save = resumed = lost = repeated = newest = 0
    training = Training(folder, algo, total)
    for number in range(kills):
        training.kill(number % 2 == 1, longest)
        in_a_save += is_saving(folder)
        there = max(steps_of(folder), 0)
        lost += there < newest
        newest = there
        repeated = max(repeated, training.steps.value - there)
        training = Training(folder, algo, total)
        resumed += training.start == there
    return Outcome(kills, in_a_save, resumed, lost, repeated, training.end()[0])


def main() -> None:
    """Kill, fill the disk, and say what came of it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=20, help="how often (default: %(default)s)")
    parser.add_argument("--algo", choices=ALGORITHMS, default="esad_lend", help="default: %(default)s")
    args = parser.parse_args()
    total = (args.kills + 5) * INTERVAL
    with TemporaryDirectory() as name:
        folders = [Path(name, each) for each in ("undisturbed", "killed", "full")]
        training, start = Training(folders[0], args.algo, total), time.monotonic()
        undisturbed, _ = training.end()
        interval = (time.monotonic() - start) * INTERVAL / total
        print(f"undisturbed: {undisturbed}, {interval:.2f} s from one checkpoint to the next", flush=True)
        outcome = endure(folders[1], args.algo, total, args.kills, longest=2 * interval)
        print(f"{outcome.kills} kills, {outcome.in_a_save} of them in a save: {outcome.resumed} resumed, {outcome.lost} lost")
        print(f"at most {outcome.repeated} steps made again; in the end: {outcome.digest}", flush=True)
        _, told = Training(folders[2], args.algo, total, disk_gets_full=True).end()
        kept = steps_of(folders[2])
        after, _ = Training(folders[2], args.algo, total).end()
    print(f"full disk: {len(told)} warning, the checkpoint of {kept} steps stayed; in the end: {after}")
    unharmed = outcome.resumed == outcome.kills and outcome.lost == 0 and outcome.repeated <= INTERVAL + ROLLOUT
    if not unharmed or len(told) != 1 or not undisturbed == outcome.digest == after:
        sys.exit("That is not what should have come of it.")


if __name__ == "__main__":
    main()
