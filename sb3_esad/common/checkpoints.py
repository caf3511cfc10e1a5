"""Checkpoints of a run: all that it needs to go on after it was cut off, in one file that is whole or not there at all."""

import io
import json
import os
import pickle
import time
import warnings
import zipfile
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EventCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecNormalize

from sb3_esad.common.callbacks import EVALUATIONS, all_callbacks
from sb3_esad.common.checks import require
from sb3_esad.common.save_util import whole_file

CHECKPOINT = "checkpoint.zip"
"""Name of the newest checkpoint in the folder of a run."""
MODEL, BUFFER, STATISTICS, PROGRESS = "model.zip", "replay_buffer.pkl", "vecnormalize.pkl", "progress.json"
MEMORY = (
    *("last_time_trigger", "n_episodes", "no_improvement_evals"),
    *("best_mean_reward", "last_best_mean_reward", "last_mean_reward"),
    *EVALUATIONS,
)
"""What SB3's own callbacks remember, by the names of the attributes."""
PATIENCE = 0.25
"""Share of the interval, its last, in which a checkpoint waits for the end of an episode."""

Algorithm = TypeVar("Algorithm", bound=OffPolicyAlgorithm)


class Progress(NamedTuple):
    """
    What a checkpoint holds beside the model, its replay buffer and the statistics of ``VecNormalize``.

    :param algorithm: name of its class
    :param seed: of all random numbers that follow
    :param n_envs: number of environments
    :param elapsed: time that the run has taken, in ns
    :param callbacks: name of the class, number of calls and state of each callback
    """

    algorithm: str
    seed: int
    n_envs: int
    elapsed: int
    callbacks: list[tuple[str, int, dict[str, Any]]]


class RunCheckpointCallback(BaseCallback):
    """
    Saves, again and again, all that a run needs to go on after it was cut off; each checkpoint replaces the one before it.

    The state of an environment cannot be saved in general. Hence after each checkpoint all environments begin new episodes,
    and all random numbers start from a new seed, which is saved: on one thread a resumed run is the one that was never cut
    off. So that hardly an episode is left unfinished, a checkpoint is taken where one has just ended, in the last quarter of
    the interval, and in the midst of one only if none ends there.

    Callbacks go on with their ``n_calls``, those of SB3 with their evaluations, and those that have the methods ``state_dict``
    and ``load_state_dict`` with what these hold, in values that JSON has. If a checkpoint cannot be written, as on a full
    disk, there is a warning, the one before it stays, and training goes on.

    :param save_freq: steps of all environments together, from one checkpoint to the next at most, up to the next rollout
    :param save_path: folder of the run, where the checkpoint is ``checkpoint.zip``
    :param verbose: 0 silent, 1 tells of each checkpoint
    :raises ValueError: if ``save_freq`` is no number of steps, the algorithm none that can be resumed, or the folder that of
        another run
    """

    model: Any

    def __init__(self, save_freq: int, save_path: str | Path, verbose: int = 0) -> None:
        super().__init__(verbose)
        require(save_freq >= 1, "save_freq", save_freq, "a number of steps >= 1")
        self.save_freq = save_freq
        self.save_path = Path(save_path)

    def _init_callback(self) -> None:
        if not hasattr(self.model, "begin_anew"):
            raise ValueError(f"{type(self.model).__name__} cannot be resumed; use SB3's CheckpointCallback instead.")
        if self.model.use_sde:
            raise ValueError(
                "use_sde=True: gSDE draws before a run can be resumed; leave it False, or use CheckpointCallback."
            )
        for unfinished in self.save_path.glob(f".*.{CHECKPOINT}"):
            unfinished.unlink()  # of a process that was killed

    def _on_training_start(self) -> None:
        if self.num_timesteps == 0 and (self.save_path / CHECKPOINT).exists():
            remedy = "resume that one, choose another folder or delete the file"
            raise ValueError(f"{self.save_path} holds the {CHECKPOINT} of another run: {remedy}.")
        for each in _all_with_events(self.locals["callback"]):
            _describe(each)  # refuses what cannot be saved, now and not after the first interval
        self._saved_at = self.num_timesteps
        self._episode_ended = self._any_ended = self._warned = self._warned_of_cuts = False

    def _on_step(self) -> bool:
        self._episode_ended |= bool(np.any(self.locals["dones"]))
        self._any_ended |= self._episode_ended
        return True

    def _on_rollout_start(self) -> None:
        # Here nothing is under way but episodes
        enough = (1 - PATIENCE) * self.save_freq if self._episode_ended else self.save_freq
        if self.model.num_timesteps - self._saved_at >= enough:
            self._warn_of_cuts()
            self._save()
            self._saved_at, self._any_ended = self.model.num_timesteps, False
        self._episode_ended = False

    def _save(self) -> None:
        progress = Progress(
            algorithm=type(self.model).__name__,
            seed=np.random.randint(2**31 - 1),
            n_envs=self.model.n_envs,
            elapsed=time.time_ns() - self.model.start_time,
            callbacks=[_describe(each) for each in _all_with_events(self.locals["callback"])],
        )
        try:
            write_checkpoint(self.save_path, self.model, progress)
        except OSError as error:
            self._warn(error)
            return
        self._warned = False
        self.model.begin_anew(progress.seed)
        _seed_evaluations(self.locals["callback"], progress)
        if self.verbose >= 1:
            print(f"Checkpoint of {self.model.num_timesteps} steps in {self.save_path}")

    def _warn_of_cuts(self) -> None:
        if not self._any_ended and not self._warned_of_cuts:
            self._warned_of_cuts = True
            what = f"Within save_freq={self.save_freq} steps of {self.model.n_envs} environments no episode has ended"
            warnings.warn(f"{what}, so a checkpoint cuts all of them off: choose a larger save_freq.", stacklevel=2)

    def _warn(self, error: OSError) -> None:
        if not self._warned:
            remedy = "training goes on, and the checkpoint before it stays. Make room on the disk"
            warnings.warn(f"No checkpoint in {self.save_path} ({error}): {remedy}.", stacklevel=2)
        self._warned = True


def _all_with_events(callback: BaseCallback) -> list[BaseCallback]:
    """A callback, those in it if it is a list, and those that they call."""
    found = []
    for each in all_callbacks(callback):
        children = (each.callback, getattr(each, "callback_on_new_best", None)) if isinstance(each, EventCallback) else ()
        found += [each, *(other for child in children if child is not None for other in _all_with_events(child))]
    return found


def _describe(callback: BaseCallback) -> tuple[str, int, dict[str, Any]]:
    name, plain = type(callback).__name__, vars(callback)
    remembers: Any = getattr(callback, "state_dict", lambda: {key: plain[key] for key in MEMORY if key in plain})
    state = remembers()
    try:
        return name, callback.n_calls, json.loads(json.dumps(state, default=np.generic.item))
    except (TypeError, ValueError) as error:
        raise ValueError(f"What {name} remembers cannot be saved ({error}): give its state_dict plain values.") from error


def _seed_evaluations(callback: BaseCallback, progress: Progress) -> None:
    for each in _all_with_events(callback):
        if isinstance(each, EvalCallback):
            each.eval_env.seed(progress.seed + progress.n_envs)


def resume_callbacks(callback: BaseCallback, progress: Progress) -> None:
    """
    Let callbacks go on where those of a run that was cut off have stopped.

    :param callback: of the run that goes on; each takes the place of the next former one of the same class
    :param progress: of the run that was cut off
    """
    former = list(progress.callbacks)
    for each in _all_with_events(callback):
        found = next((state for state in former if state[0] == type(each).__name__), None)
        if found is None:
            continue
        former.remove(found)
        each.n_calls = found[1]
        if hasattr(each, "load_state_dict"):
            each.load_state_dict(found[2])
        else:
            vars(each).update(found[2])
    _seed_evaluations(callback, progress)


def write_checkpoint(folder: Path, model: OffPolicyAlgorithm, progress: Progress) -> None:
    """
    Replace the checkpoint of a run, at once.

    :param folder: of the run
    :param model: as it is
    :param progress: what is not in the model
    :raises OSError: if it cannot be written; the former checkpoint is still there
    """
    normalize = model.get_vec_normalize_env()
    with whole_file(folder / CHECKPOINT) as path, path.open("wb") as file:
        with zipfile.ZipFile(file, "w") as archive:
            with archive.open(MODEL, "w", force_zip64=True) as member:
                model.save(member)  # type: ignore[arg-type]
            # SB3 takes none but Python's own files
            with io.BufferedWriter(archive.open(BUFFER, "w", force_zip64=True)) as buffered:
                model.save_replay_buffer(buffered)
            if normalize is not None:
                archive.writestr(STATISTICS, pickle.dumps(_statistics(normalize)))
            archive.writestr(PROGRESS, json.dumps(progress._asdict()))
        file.flush()
        os.fsync(file.fileno())  # lest a power failure leaves the new name without the new content


def read_checkpoint(
    folder: Path, algorithm: type[Algorithm], env: GymEnv, device: th.device | str
) -> tuple[Algorithm, Progress]:
    """
    Load the newest checkpoint of a run.

    :param folder: of the run
    :param algorithm: of the run
    :param env: environment to go on with
    :param device: where to compute
    :return: the model, and what is not in it
    :raises ValueError: if there is none, or if it is one of another algorithm or of other environments
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        raise ValueError(f"There is no {path}: give a folder that a RunCheckpointCallback has saved to, or start anew.")
    try:
        with zipfile.ZipFile(path) as archive:
            progress = Progress(**json.loads(archive.read(PROGRESS)))
            if progress.algorithm != algorithm.__name__:
                raise ValueError(f"{path} is of {progress.algorithm}: resume it by that class, not by {algorithm.__name__}.")
            model = algorithm.load(io.BytesIO(archive.read(MODEL)), env, device)
            with io.BufferedReader(archive.open(BUFFER)) as buffered:  # type: ignore[type-var]
                model.load_replay_buffer(buffered)
            _read_statistics(archive, model)
    except (zipfile.BadZipFile, KeyError, EOFError) as error:
        raise ValueError(f"{path} is no checkpoint, or damaged ({error}).") from error
    return model, progress


def _read_statistics(archive: zipfile.ZipFile, model: OffPolicyAlgorithm) -> None:
    normalize, saved = model.get_vec_normalize_env(), STATISTICS in archive.namelist()
    if saved != (normalize is not None):
        remedy = "wrap the environment in VecNormalize as in the run" if saved else "the run had none around its environment"
        raise ValueError(f"{archive.filename} and the environment differ in VecNormalize: {remedy}.")
    if normalize is not None:
        vars(normalize).update(pickle.loads(archive.read(STATISTICS)))


def _statistics(normalize: VecNormalize) -> dict[str, Any]:
    """Those that there are: SB3 has none of observations that it does not normalise."""
    return {name: vars(normalize)[name] for name in ("obs_rms", "ret_rms") if name in vars(normalize)}
