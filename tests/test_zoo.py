"""RL Zoo drives our algorithms: its commands, its files, its searches, and what stands in for what is wrong with it."""

import os
import subprocess
import sys
import warnings
from argparse import Namespace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import optuna
import pytest
import yaml
from conftest import TINY, CountingEnv
from rl_zoo3 import exp_manager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS, get_saved_hyperparams
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_esad.zoo
from sb3_esad import ESADLEND
from sb3_esad.__main__ import ZOO_COMMANDS, main
from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.common.callbacks import CostEvalCallback
from sb3_esad.hyperparams import hyperparams_folder
from sb3_esad.zoo import commands
from sb3_esad.zoo.manager import CostAwareManager
from sb3_esad.zoo.trials import ConstrainedTrialCallback

ENV = "zoo-highway-v0"
COUNTING = "zoo-counting-v0"
BRIEF = {"observation": "vector", "config": {"duration": 2.0}}
gym.register(ENV, "sb3_esad.envs.highway:Highway", disable_env_checker=True, kwargs=BRIEF)
gym.register(COUNTING, CountingEnv)
SMALL = {key: value for key, value in TINY.items() if key not in ("device", "seed")}


def settings(**changes: Any) -> list[str]:
    """Words of the command line that make a model small and quick."""
    run = {"policy": "MlpPolicy", "n_envs": 1, "train_freq": 8, "gradient_steps": 1, "pretrain_gradient_steps": 0}
    return ["-params", *(f"{key}:{value!r}" for key, value in {**SMALL, **run, **changes}.items())]


def train(folder: Path, *words: str, env: str = ENV, **changes: Any) -> int:
    agent = ["--algo", "esad_lend", "--env", env, "-f", str(folder), "--device", "cpu", "--seed", "1"]
    return main(["train", *agent, *words, *settings(**changes)])


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    assert train(folder, "-n", "60", "--eval-freq", "20", "--eval-episodes", "2", "--save-freq", "40") == 0
    return folder


@pytest.fixture
def run_folder(logs: Path) -> Path:
    return logs / "esad_lend" / f"{ENV}_1"


def test_training_writes_what_rl_zoo_writes_and_costs(run_folder: Path) -> None:
    names = {path.name for path in run_folder.iterdir()}
    assert {f"{ENV}.zip", "best_model.zip", "evaluations.npz", "0.monitor.csv", "rl_model_40_steps.zip"} <= names
    with np.load(run_folder / "evaluations.npz") as evaluations:
        assert evaluations["costs"].shape == evaluations["results"].shape == (3, 2)
        assert list(evaluations["timesteps"]) == [20, 40, 60]
    assert ESADLEND.load(run_folder / f"{ENV}.zip").num_timesteps == 64, "the last rollout is finished"
    config = get_saved_hyperparams(str(run_folder / ENV))[0]
    assert config["n_timesteps"] == 20_000, "from our file"


def test_watching(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["--algo", "esad_lend", "--env", ENV, "-f", str(logs), "-n", "25"]
    assert main(["enjoy", *command, "--no-render"]) == 0
    assert "2 Episodes" in capsys.readouterr().out
    assert main(["enjoy", *command, "--no-render", "--load-best"]) == 0


def test_filming(logs: Path, run_folder: Path, tmp_path: Path) -> None:
    command = ["--algo", "esad_lend", "--env", ENV, "-f", str(logs), "-n", "5", "-o", str(tmp_path)]
    assert main(["record_video", *command]) == 0
    assert next(tmp_path.glob("final-model-*.mp4")).stat().st_size > 1000
    assert main(["record_training", *command]) == 0
    assert (tmp_path / "training.mp4").stat().st_size > 1000
    films = {path.name.split("-zoo")[0] for path in tmp_path.glob("*-to-step-5.mp4")}
    assert films == {"final-model-esad_lend", "best-model-esad_lend", "checkpoint-40-esad_lend"}


def test_plots(logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["plot_train", "-a", "esad_lend", "-e", ENV, "-f", str(logs), "-w", "2"]) == 0
    assert main(["all_plots", "-a", "esad_lend", "-e", ENV, "-f", str(logs), "-k", "costs", "-o", "costs"]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {
        "Training_Episodic_Reward.png",
        f"Results_{ENV}.png",
        "costs.pkl",
    }
    assert f"it is in Results_{ENV}.png" in capsys.readouterr().out


def test_what_was_never_evaluated_is_not_plotted_as_costs_of_zero(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["all_plots", "-a", "esad_lend", "wcsac", "-e", ENV, "-f", str(logs), "-k", "costs"]) == 2
    said = capsys.readouterr().err
    assert "holds 0 evaluations of wcsac" in said and "leave it out" in said


def test_going_on(logs: Path, run_folder: Path, tmp_path: Path) -> None:
    words = ["-n", "40", "--eval-freq", "-1", "-i", str(run_folder / f"{ENV}.zip")]
    assert train(tmp_path, *words, gamma=0.5) == 0
    assert ESADLEND.load(tmp_path / "esad_lend" / f"{ENV}_1" / f"{ENV}.zip").gamma == 0.5


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_algorithm_is_known(algo: str) -> None:
    sb3_esad.zoo.register()  # twice is as good as once
    assert ALGOS[algo] is ALGORITHMS[algo]
    assert (hyperparams_folder() / f"{algo}.yml").is_file()
    trial = optuna.create_study().ask()
    arguments = HYPERPARAMS_SAMPLER[algo](trial, 2, 1, {})
    ALGORITHMS[algo]("MlpPolicy", CountingEnv(), buffer_size=100, **arguments)
    written = HYPERPARAMS_CONVERTER[algo](trial.params)
    assert yaml.safe_load(yaml.safe_dump(written)) == written, "as it would stand in our files"
    read = CostAwareManager._preprocess_schedules(dict(written))
    assert read.keys() == arguments.keys()
    assert all(read[key] == arguments[key] for key in read if key != "learning_rate")
    assert read["learning_rate"](1.0) == arguments["learning_rate"](1.0) == trial.params["learning_rate"]


def test_searches_differ_by_what_an_algorithm_has() -> None:
    drawn = {}
    for algo in ("esad_lend", "sac_lag"):
        trial = optuna.create_study().ask()
        HYPERPARAMS_SAMPLER[algo](trial, 2, 1, {})
        drawn[algo] = set(trial.params)
    assert drawn["esad_lend"] - drawn["sac_lag"] == {"sequence_length", "imagination_horizon"}
    assert not drawn["esad_lend"] & {"cost_limit", "risk_level"}


def search(folder: Path, **changes: Any) -> int:
    """Three trials of 16 steps, each evaluated twice in episodes that cost 2."""
    agent = ["--algo", "esad_lend", "--env", COUNTING, "-f", str(folder), "--device", "cpu", "--seed", "1"]
    trials = ["-n", "16", "--n-trials", "3", "--n-evaluations", "2", "--eval-episodes", "1", "--no-optim-plots"]
    storage = ["--storage", str(folder / "study.log"), "--study-name", "search"]
    return main(["optimize", *agent, *trials, *storage, *settings(**changes)])


def load_study(folder: Path) -> optuna.Study:
    backend = optuna.storages.journal.JournalFileBackend(str(folder / "study.log"))
    return optuna.load_study(study_name="search", storage=optuna.storages.JournalStorage(backend))


@pytest.mark.parametrize(("limit", "excess"), [(2.0, 0.0), (1.5, 0.5), (None, None)])
def test_a_search_is_constrained(
    limit: float | None, excess: float | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wins = excess is None or excess <= 0
    assert search(tmp_path, cost_limit=limit) == (0 if wins else 2)
    told = "sb3_esad optimize: None of 3 trials came to its end and kept the cost limit; they are in "
    assert (told in capsys.readouterr().err) is not wins
    study = load_study(tmp_path)
    assert [trial.constraints for trial in study.trials] == [{} if excess is None else {"cost": excess}] * 3
    assert all(trial.value == 28.0 for trial in study.trials), "1 + ... + 7"
    if wins:
        assert study.best_trial.value == 28.0
    reports = list((tmp_path / "esad_lend").glob("report_*.csv" if wins else "trials_*.csv"))
    assert len(reports) == 1 and len(reports[0].read_text().splitlines()) == 4


@pytest.mark.parametrize(("limit", "judged"), [(2.0, True), (None, True), (1.9, False)])
def test_the_pruner_judges_what_keeps_the_limit(limit: float | None, judged: bool) -> None:
    study = optuna.create_study(direction="maximize", pruner=optuna.pruners.MedianPruner(n_startup_trials=0))
    for value in (100.0, 101.0):
        better = study.ask()
        better.report(value, 1)
        study.tell(better, value)
    trial = study.ask()
    callback = ConstrainedTrialCallback(DummyVecEnv([CountingEnv]), trial, eval_freq=1, n_eval_episodes=1, warn=False)
    model = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "cost_limit": limit}).learn(3, callback)
    assert callback.is_pruned == judged, "a return of 28 is less than others had"
    assert model.num_timesteps == (1 if judged else 4)
    assert study.trials[-1].intermediate_values == ({1: 28.0} if judged else {})


def make_manager(tmp_path: Path, algo: str = "esad_lend", env: str = ENV, **kwargs: Any) -> exp_manager.ExperimentManager:
    args = Namespace(env_kwargs=None, seed=0)
    return exp_manager.ExperimentManager(args, algo, env, str(tmp_path), n_eval_episodes=1, verbose=0, **kwargs)


def test_rl_zoo_uses_our_manager_and_callbacks(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        assert isinstance(make_manager(tmp_path), CostAwareManager)
        assert Path(make_manager(tmp_path).config) == hyperparams_folder() / "esad_lend.yml"
        assert make_manager(tmp_path, config="mine.yml").config == "mine.yml"
        assert Path(make_manager(tmp_path, algo="ppo").config).parts[-3:] == ("rl_zoo3", "hyperparams", "ppo.yml")
    assert issubclass(exp_manager.EvalCallback, CostEvalCallback)
    assert exp_manager.TrialEvalCallback is ConstrainedTrialCallback


def test_others_need_no_costs(tmp_path: Path) -> None:
    words = ["--algo", "sac", "--env", "Pendulum-v1", "-n", "8", "--eval-freq", "4", "--eval-episodes", "1"]
    with warnings.catch_warnings():
        assert main(["train", *words, "-f", str(tmp_path), "-params", "buffer_size:100", "learning_starts:100"]) == 0
    with np.load(tmp_path / "sac" / "Pendulum-v1_1" / "evaluations.npz") as evaluations:
        assert not evaluations["costs"].any()


def write_settings(path: Path, **settings: Any) -> str:
    plain = {"policy": "MlpPolicy", "n_timesteps": 9, "learning_starts": 100, "buffer_size": 100, **settings}
    path.write_text(yaml.safe_dump({"default": plain}))
    return str(path)


def env_kwargs_of(owner: type[exp_manager.ExperimentManager], path: Path) -> tuple[Any, Any, Any]:
    """Those of training, evaluation and videos, if a file of hyperparameters asks for a time limit of 3 steps."""
    args = Namespace(env_kwargs=None)
    config = write_settings(path / "mine.yml", env_kwargs={"time_limit": 3})
    made = owner(args, "esad_lend", COUNTING, str(path), config=config, verbose=0)
    model, _ = made.setup_experiment()
    model.env.close()
    return made.env_kwargs, made.eval_env_kwargs, args.env_kwargs


def test_env_kwargs_of_a_file_reach_evaluation_and_videos(tmp_path: Path) -> None:
    assert env_kwargs_of(CostAwareManager, tmp_path) == ({"time_limit": 3},) * 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("train --algo esad_lend --env {env} -f {folder} -params gama:0.9", "no argument of ESADLEND; did you mean 'gamma'?"),
        ("train --algo esad_lend --env {env} -f {folder} -params learning_rate:'fast'", "choose a number such as 1.0e-3"),
        ("train --algo esad_lend --env esad-highwy-v0 -f {folder}", "not found in gym registry, you maybe meant esad-highway"),
        ("enjoy --algo esad_lend --env {env} -f {folder}", "folder was not found"),
        ("plot_train -a esad_lend -e {env} -f {folder}", "No such file or directory"),
    ],
)
def test_mistakes_are_named(words: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(words.format(env=ENV, folder=tmp_path).split()) == 2
    error = capsys.readouterr().err
    assert message in error and error.startswith("sb3_esad ") and error.count("\n") == 1


def test_without_rl_zoo(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sb3_esad.__main__.find_spec", lambda name: None if name in ("rl_zoo3", "seaborn") else name)
    assert main(["train"]) == 2
    sentence = "sb3_esad train: RL Zoo's commands need rl_zoo3, seaborn: pip install 'sb3_esad[zoo]'.\n"
    assert capsys.readouterr().err == sentence


def test_all_commands_are_listed() -> None:
    assert set(ZOO_COMMANDS) == set(commands.COMMANDS)


def test_faults_of_programs_are_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail() -> None:
        raise AssertionError

    monkeypatch.setitem(commands.COMMANDS, "train", fail)
    with pytest.raises(AssertionError):
        main(["train"])


@pytest.fixture
def hooked(tmp_path: Path) -> Path:
    """A folder with the one line by which RL Zoo's own commands know our algorithms."""
    (tmp_path / "custom_envs.py").write_text("import sb3_esad.zoo\n")
    return tmp_path


def run_rl_zoo(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-W", "error::UserWarning", "-m", *words]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    return subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment, check=False)


def test_rl_zoo_itself_with_the_hook(hooked: Path) -> None:
    env = "esad-highway-vector-v0"
    words = ["-n", "48", "--eval-freq", "24", "--eval-episodes", "1", "--device", "cpu"]
    run = run_rl_zoo(hooked, "rl_zoo3.train", "--algo", "esad_lend", "--env", env, *words, *settings())
    assert run.returncode == 0, run.stderr
    assert f"Loading hyperparameters from: {hyperparams_folder() / 'esad_lend.yml'}" in run.stdout
    with np.load(hooked / "logs" / "esad_lend" / f"{env}_1" / "evaluations.npz") as evaluations:
        assert evaluations["costs"].shape == (2, 1)


def test_rl_zoo_knows_us_whatever_it_imports_first(hooked: Path) -> None:
    run = run_rl_zoo(hooked, "rl_zoo3.record_video", "--algo", "esad_lend", "--env", "esad-highway-v0")
    assert "AssertionError: The rl-trained-agents/esad_lend folder was not found" in run.stderr
