"""A run that was cut off goes on from its newest checkpoint, and ends as if nothing had happened."""

import resource
import shutil
import zipfile
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from kills import Training, endure, steps_of
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import (
    BaseCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_esad import ADEND, ESADLEND, SADLEN, WCSAC, SACLag
from sb3_esad.common.callbacks import CostEvalCallback
from sb3_esad.common.checkpoints import CHECKPOINT, MEMORY, RunCheckpointCallback
from sb3_esad.common.cost_aware_algorithm import CostAwareAlgorithm
from sb3_esad.common.schedules import HoldThenFall
from tests.conftest import PICTURE, TINY, VECTOR, CountingEnv, RandomEnv, assert_same

MODEL_FREE = {
    **{key: TINY[key] for key in ("learning_starts", "buffer_size", "batch_size", "device", "seed")},
    **{"policy_kwargs": {"net_arch": [16]}, "train_freq": 4},
}
pytestmark = pytest.mark.filterwarnings("ignore:Within save_freq")
IDLE = {**MODEL_FREE, "learning_starts": 10_000, "train_freq": 1}
"""Nothing is learned, only steps are made."""
TOTAL, INTERVAL, CUT = 48, 16, 34


class Cut(BaseCallback):
    """Keeps the checkpoint that there is when the run is cut off."""

    def __init__(self, folder: Path, kept: Path) -> None:
        super().__init__()
        self.folder, self.kept = folder, kept

    def _on_step(self) -> bool:
        if self.num_timesteps == CUT:
            shutil.copytree(self.folder, self.kept)
        return True


def random_env() -> Monitor:
    """An environment whose random numbers follow from the seed of its reset alone."""
    return Monitor(RandomEnv(deepcopy(VECTOR)))


def one() -> VecEnv:
    return DummyVecEnv([random_env])


def normalised() -> VecEnv:
    return VecNormalize(one())


def two_stacked() -> VecEnv:
    return VecFrameStack(DummyVecEnv([random_env, random_env]), 2)


def facts(model: CostAwareAlgorithm, evaluations: CostEvalCallback) -> dict[str, Any]:
    """All numbers of a model and of its run, but for the time."""
    steps = slice(model.replay_buffer.size())
    rows = {name: getattr(model.replay_buffer, name)[steps].tolist() for name in ("actions", "costs", "episode_starts")}
    counters = ("num_timesteps", "_n_updates", "_episode_num", "_total_timesteps", "_num_timesteps_at_start", "total_cost")
    return {
        "parameters": model.get_parameters(),
        "episodes": [(info["r"], info["l"], info["c"]) for info in model.ep_info_buffer or []],
        "counters": [getattr(model, name) for name in counters],
        "evaluations": evaluations.state_dict(),
        **rows,
    }


@pytest.mark.parametrize(
    ("algorithm", "settings", "make_env"),
    [
        (ESADLEND, {"ent_coef": "auto", "filter_start": 4, "random_hold": 3}, one),
        (SADLEN, {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))}, one),
        (ADEND, {}, one),
        (WCSAC, {}, normalised),
        (SACLag, {"ent_coef": 0.1}, two_stacked),
    ],
    ids=lambda each: getattr(each, "__name__", None),
)
def test_a_resumed_run_is_the_one_that_was_never_cut_off(
    algorithm: type[CostAwareAlgorithm], settings: dict[str, Any], make_env: Callable[[], VecEnv], tmp_path: Path
) -> None:
    kind = MODEL_FREE if issubclass(algorithm, WCSAC) else TINY
    settings = {**kind, "learning_rate": HoldThenFall(1e-3, 0.3), **settings}
    whole, kept = tmp_path / "whole", tmp_path / "kept"
    evaluating = [CostEvalCallback(make_env(), eval_freq=15, n_eval_episodes=1, verbose=0, warn=False) for _ in range(2)]
    model = algorithm("MlpPolicy", make_env(), **settings)
    model.learn(TOTAL, [RunCheckpointCallback(INTERVAL, whole), evaluating[0], Cut(whole, kept)])
    other = algorithm.resume(kept, make_env(), device="cpu")
    assert CUT - INTERVAL <= other.num_timesteps < CUT
    other.learn(TOTAL, [evaluating[1], RunCheckpointCallback(INTERVAL, kept)])
    assert other._n_updates > 2
    assert_same(facts(model, evaluating[0]), facts(other, evaluating[1]))
    assert steps_of(kept) == steps_of(whole), "checkpoints go on, too"
    assert len(list(kept.iterdir())) == 1


def test_evaluations_that_are_called_by_events_go_on_as_well(tmp_path: Path) -> None:
    whole, kept = tmp_path / "whole", tmp_path / "kept"
    settings = {"eval_freq": 1, "n_eval_episodes": 2, "deterministic": False, "verbose": 0, "warn": False}
    evaluating = [CostEvalCallback(one(), log_path=str(tmp_path / name), **settings) for name in ("first", "second")]
    model = WCSAC("MlpPolicy", one(), **MODEL_FREE)
    model.learn(TOTAL, [RunCheckpointCallback(INTERVAL, whole), EveryNTimesteps(15, evaluating[0]), Cut(whole, kept)])
    other = WCSAC.resume(kept, one(), device="cpu")
    other.learn(TOTAL, [EveryNTimesteps(15, evaluating[1]), RunCheckpointCallback(INTERVAL, kept)])
    assert evaluating[0].evaluations_timesteps == [15, 30, 45]
    assert_same(facts(model, evaluating[0]), facts(other, evaluating[1]))


def test_who_stops_a_training_goes_on_counting(tmp_path: Path) -> None:
    whole, kept = tmp_path / "whole", tmp_path / "kept"
    model = WCSAC("MlpPolicy", one(), **IDLE)
    model.learn(500, [RunCheckpointCallback(INTERVAL, whole), StopTrainingOnMaxEpisodes(10), Cut(whole, kept)])
    other = WCSAC.resume(kept, one(), device="cpu")
    other.learn(500, [RunCheckpointCallback(INTERVAL, kept), StopTrainingOnMaxEpisodes(10)])
    assert CUT < model.num_timesteps == other.num_timesteps < 500


def test_names_of_what_callbacks_remember_are_those_of_sb3() -> None:
    stops = StopTrainingOnMaxEpisodes(1), StopTrainingOnNoModelImprovement(1), EveryNTimesteps(1, Remembers())
    known = {name for each in (*stops, CostEvalCallback(one())) for name in vars(each)}
    assert set(MEMORY) <= known


def test_pictures_and_a_buffer_that_is_full(tmp_path: Path) -> None:
    settings = {**MODEL_FREE, "buffer_size": 10, "learning_starts": 1000}
    WCSAC("CnnPolicy", RandomEnv(PICTURE), **settings).learn(13, RunCheckpointCallback(12, tmp_path))
    buffer = WCSAC.resume(tmp_path, RandomEnv(PICTURE), device="cpu").replay_buffer
    assert buffer.full and buffer.pos == 2 and len(buffer.observations) == len(buffer.actions) == 10


class Taken(RunCheckpointCallback):
    """Notes when checkpoints are taken."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.taken: list[int] = []

    def _save(self) -> None:
        super()._save()
        self.taken.append(self.model.num_timesteps)


@pytest.mark.parametrize(
    ("length", "save_freq", "taken"),
    [
        (7, 28, [21, 42, 63]),  # an episode has just ended
        (7, 20, [20, 40, 60]),  # none ends from step 15 to step 20
        (1000, 30, [30, 60]),
    ],
)
def test_checkpoints_wait_for_the_end_of_an_episode(length: int, save_freq: int, taken: list[int], tmp_path: Path) -> None:
    callback = Taken(save_freq, tmp_path)
    model = WCSAC("MlpPolicy", CountingEnv(length), **IDLE).learn(64, callback)
    assert callback.taken == taken
    seen = model.replay_buffer.observations[:64, 0, 0]
    assert all(seen[step] == 0 and model.replay_buffer.episode_starts[step] for step in taken), "new episodes begin"


def test_all_environments_begin_anew(tmp_path: Path) -> None:
    envs = DummyVecEnv([lambda: CountingEnv(7), lambda: CountingEnv(5)])
    model = ESADLEND("MlpPolicy", envs, **{**TINY, "learning_starts": 1000, "train_freq": 1})
    model.learn(32, RunCheckpointCallback(24, tmp_path))
    starts = model.replay_buffer.episode_starts[:16]
    assert np.flatnonzero(starts[:, 0]).tolist() == [0, 7, 10] and np.flatnonzero(starts[:, 1]).tolist() == [0, 5, 10, 15]
    assert steps_of(tmp_path) == 20, "10 steps of each: the first end of an episode from 18 on"
    other = ESADLEND.resume(tmp_path, DummyVecEnv([CountingEnv, CountingEnv]), device="cpu").learn(32)
    assert other.num_timesteps == 32 and not other.replay_buffer.full


def test_a_full_disk_is_told_once_and_costs_nothing(tmp_path: Path) -> None:
    model = WCSAC("MlpPolicy", CountingEnv(), **IDLE).learn(25, RunCheckpointCallback(20, tmp_path))
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.warns(UserWarning, match=r"No checkpoint in .*File too large.* the checkpoint before it stays") as told:
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))
            model.learn(100, RunCheckpointCallback(20, tmp_path), reset_num_timesteps=False)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert sum("No checkpoint" in str(each.message) for each in told) == 1 and model.num_timesteps == 125
    assert [path.name for path in tmp_path.iterdir()] == [CHECKPOINT]
    assert steps_of(tmp_path) == 20
    model.learn(100, RunCheckpointCallback(20, tmp_path), reset_num_timesteps=False)
    assert steps_of(tmp_path) > 200, "as soon as there is room"


def test_steps_count_from_where_the_run_began(tmp_path: Path) -> None:
    model = WCSAC("MlpPolicy", CountingEnv(), **IDLE).learn(10)
    model.learn(50, RunCheckpointCallback(20, tmp_path), reset_num_timesteps=False)
    resumed = WCSAC.resume(tmp_path, CountingEnv(), device="cpu")
    assert 10 < resumed.num_timesteps < 60
    resumed.learn(50)
    assert (resumed.num_timesteps, resumed._total_timesteps) == (60, 60)
    resumed.learn(5)
    assert resumed.num_timesteps == 5, "only the first time"


def test_killed_again_and_again(tmp_path: Path) -> None:
    """Real processes and SIGKILL; benchmark/kills.py does so 20 times."""
    undisturbed, _ = Training(tmp_path / "undisturbed", "wcsac", 200).end()
    outcome = endure(tmp_path / "killed", "wcsac", 200, kills=3, longest=0.3)
    assert outcome.resumed == outcome.kills == 3 and outcome.lost == 0 and outcome.repeated <= 48
    assert outcome.digest == undisturbed


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    WCSAC("MlpPolicy", CountingEnv(), **IDLE).learn(25, RunCheckpointCallback(20, folder))
    return folder


@pytest.mark.parametrize(
    ("resume", "message"),
    [
        (lambda folder: WCSAC.resume(folder / "none", CountingEnv()), r"There is no .*none/checkpoint\.zip: give a folder"),
        (lambda folder: ESADLEND.resume(folder, CountingEnv()), "is of WCSAC: resume it by that class, not by ESADLEND"),
        (lambda folder: SACLag.resume(folder, CountingEnv()), "is of WCSAC: resume it by that class, not by SACLag"),
        (lambda folder: WCSAC.resume(folder, DummyVecEnv([CountingEnv] * 2)), "1 environments, .* the model needs .* 2 envir"),
        (lambda folder: WCSAC.resume(folder, RandomEnv(VECTOR)), "Observation spaces do not match"),
        (lambda folder: WCSAC.resume(folder, VecNormalize(DummyVecEnv([CountingEnv]))), "the run had none around its envir"),
    ],
)
def test_what_cannot_be_resumed(resume: Callable[[Path], Any], message: str, folder: Path) -> None:
    with pytest.raises(ValueError, match=message):
        resume(folder)


@pytest.mark.parametrize("content", [b"no zip at all", None], ids=["no zip", "another zip"])
def test_what_is_no_checkpoint(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / CHECKPOINT
    if content is None:
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("a", "b")
    else:
        path.write_bytes(content)
    with pytest.raises(ValueError, match="is no checkpoint, or damaged"):
        WCSAC.resume(tmp_path, CountingEnv())


def test_a_folder_with_another_run_is_refused(folder: Path) -> None:
    before = steps_of(folder)
    with pytest.raises(ValueError, match=r"holds the checkpoint\.zip of another run: resume that one, choose another folder"):
        WCSAC("MlpPolicy", CountingEnv(), **IDLE).learn(10, RunCheckpointCallback(5, folder))
    assert steps_of(folder) == before


def test_intervals_that_are_shorter_than_episodes_are_told(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="Within save_freq=20 steps of 1 environments no episode has ended"):
        WCSAC("MlpPolicy", CountingEnv(1000), **IDLE).learn(64, RunCheckpointCallback(20, tmp_path))


def test_statistics_of_rewards_alone(tmp_path: Path) -> None:
    envs = [VecNormalize(one(), norm_obs=False) for _ in range(2)]
    WCSAC("MlpPolicy", envs[0], **IDLE).learn(25, RunCheckpointCallback(20, tmp_path))
    WCSAC.resume(tmp_path, envs[1], device="cpu")
    assert envs[1].ret_rms.count > 10


class Remembers(BaseCallback):
    """Has something that no file can hold."""

    def _on_step(self) -> bool:
        return True

    def state_dict(self) -> dict[str, Any]:
        return {"array": np.zeros(2)}


def test_what_callbacks_remember(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="What Remembers remembers cannot be saved"):
        WCSAC("MlpPolicy", CountingEnv(), **IDLE).learn(5, [RunCheckpointCallback(20, tmp_path), Remembers()])
    settings = {"eval_freq": 10, "n_eval_episodes": 1, "verbose": 0, "warn": False}
    WCSAC("MlpPolicy", one(), **IDLE).learn(25, [RunCheckpointCallback(20, tmp_path), EvalCallback(one(), **settings)])
    resumed = EvalCallback(one(), **settings)
    WCSAC.resume(tmp_path, one(), device="cpu").learn(25, resumed)
    assert resumed.best_mean_reward > -np.inf and resumed.n_calls == 25


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="save_freq is 0; choose a number of steps >= 1"):
        RunCheckpointCallback(0, tmp_path)
    with pytest.raises(ValueError, match="SAC cannot be resumed; use SB3's CheckpointCallback instead"):
        SAC("MlpPolicy", CountingEnv(), buffer_size=10).learn(10, RunCheckpointCallback(5, tmp_path))
    with pytest.raises(ValueError, match="use_sde=True: gSDE draws before a run can be resumed; leave it False"):
        WCSAC("MlpPolicy", CountingEnv(), **IDLE, use_sde=True).learn(10, RunCheckpointCallback(5, tmp_path))


def test_what_a_killed_process_left_is_removed(tmp_path: Path) -> None:
    (tmp_path / f".1.{CHECKPOINT}").write_bytes(b"PK")
    WCSAC("MlpPolicy", CountingEnv(), **IDLE).learn(3, RunCheckpointCallback(20, tmp_path))
    assert not list(tmp_path.iterdir())
