"""The command line: what it prints and writes, and one sentence instead of a traceback."""

import json
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import pytest
from conftest import CountingEnv
from stable_baselines3 import SAC

from sb3_esad import ESADLEND, WCSAC, __version__, demo
from sb3_esad.__main__ import main
from sb3_esad.algorithms import ALGORITHMS, load_model
from sb3_esad.hyperparams import Hyperparams

TINY = {"net_arch": [8], "memory_channels": 4, "latent_channels": 2}
SHORT = "brief-highway-v0"
gym.register("counting-v0", CountingEnv)
gym.register(SHORT, "sb3_esad.envs.highway:Highway", disable_env_checker=True, kwargs={"config": {"duration": 2.0}})


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("models") / "model.zip"
    ESADLEND("CnnPolicy", SHORT, policy_kwargs=TINY, buffer_size=100, seed=0).save(path)
    return path


def test_evaluate_a_model(saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--env", SHORT, "--episodes", "3", "--seed", "4"]
    assert (
        main(
            [
                "evaluate",
                "--model",
                str(saved),
                *options,
                "--json",
                str(tmp_path / "a.json"),
                "--video",
                str(tmp_path / "a.mp4"),
            ]
        )
        == 0
    )
    printed = capsys.readouterr().out
    assert f"{SHORT}, 3 episodes with the seeds 4 to 6, deterministic" in printed
    assert "model.zip" in printed and "driving score DS [%]" in printed
    result = json.loads((tmp_path / "a.json").read_text())
    assert [record["seed"] for record in result["records"]] == [4, 5, 6]
    assert result["figures"]["DS_low"] <= result["figures"]["DS"] <= result["figures"]["DS_high"]
    assert (tmp_path / "a.mp4").stat().st_size > 1000


def test_evaluate_samples_reproducibly(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["evaluate", "--model", str(saved), "--env", SHORT, "--episodes", "2"]
    printed = []
    for options in ([], ["--stochastic"], ["--stochastic"]):
        main([*command, *options])
        printed.append(capsys.readouterr().out.split("\n", 1))
    assert printed[1] == printed[2]
    assert "stochastic" in printed[1][0] and printed[0][1] != printed[1][1]


def test_a_video_changes_no_figures(saved: Path, tmp_path: Path) -> None:
    command = ["evaluate", "--model", str(saved), "--env", SHORT, "--episodes", "2", "--stochastic"]
    main([*command, "--json", str(tmp_path / "plain.json")])
    main([*command, "--json", str(tmp_path / "filmed.json"), "--video", str(tmp_path / "a.mp4")])
    plain, filmed = (json.loads((tmp_path / name).read_text())["records"] for name in ("plain.json", "filmed.json"))
    assert (tmp_path / "a.mp4").exists() and len(plain) == 2
    assert filmed == plain


@pytest.mark.parametrize("driver", ["reference", "follower", "keeper", "random"])
def test_evaluate_a_driver(driver: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--driver", driver, "--env", SHORT, "--episodes", "2", "--video", str(tmp_path / "a.mp4")]) == 0
    assert driver in capsys.readouterr().out
    assert (tmp_path / "a.mp4").stat().st_size > 1000


@pytest.mark.parametrize("name", ALGORITHMS)
def test_evaluate_a_model_of_any_algorithm(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy_kwargs = TINY if issubclass(ALGORITHMS[name], ESADLEND) else {"net_arch": [8]}
    ALGORITHMS[name]("MlpPolicy", CountingEnv(), policy_kwargs=policy_kwargs, buffer_size=100).save(tmp_path / "model.zip")
    assert type(load_model(tmp_path / "model")) is ALGORITHMS[name]
    assert main(["evaluate", "--model", str(tmp_path / "model.zip"), "--env", "counting-v0", "--episodes", "2"]) == 0
    assert "| return ↑           | 28.0 [28.0, 28.0]" in capsys.readouterr().out


def test_a_model_that_saw_normalised_observations_is_not_judged_without(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "counting-v0_1"
    (run / "counting-v0").mkdir(parents=True)
    (run / "counting-v0" / "vecnormalize.pkl").touch()
    assert main(["evaluate", "--model", str(run / "best_model.zip"), "--env", "counting-v0"]) == 2
    said = capsys.readouterr().err
    assert "normalised" in said and "python -m sb3_esad enjoy" in said
    # Statistics of something else that lies about are no reason to refuse
    ESADLEND("MlpPolicy", CountingEnv(), policy_kwargs=TINY, buffer_size=100).save(run / "counting-v0" / "model.zip")
    assert type(load_model(run / "counting-v0" / "model.zip")) is ESADLEND


def test_without_a_world_model_there_is_nothing_to_film(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "model.zip"
    WCSAC("CnnPolicy", SHORT, policy_kwargs={"net_arch": [8]}, buffer_size=100).save(path)
    for command in (["evaluate", "--video", str(tmp_path / "a.mp4")], ["explain", "--out", str(tmp_path / "a.mp4")]):
        assert main([*command, "--model", str(path), "--env", SHORT]) == 2
        assert "WCSAC has no world model whose dreams could be filmed" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--model nothing.zip", "There is no file nothing.zip: give the zip that ESADLEND.save() has written."),
        ("--model text.zip --trusted", "text.zip is no zip file"),
        ("--model sac.zip", "sac.zip was not loaded: it has no member 'sb3_esad.json'"),
        ("--model sac.zip --trusted", "sac.zip holds no ESADLEND but a model with a policy of stable_baselines3.sac.policies"),
        ("--driver keeper --env nowhere-v0", "doesn't exist"),
        ("--driver keeper --env esad-highwy-v0", "Did you mean: `esad-highway`?"),
        ("--driver keeper --env counting-v0", "counting-v0 is no driving scenario"),
        ("--driver keeper --video a.gif", "a.gif is no MP4"),
        ("--driver keeper --env brief-highway-v0 --episodes 1 --json text.zip/a.json", "text.zip"),
    ],
)
def test_evaluate_says_what_is_wrong(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("text.zip").write_text("hello")
    SAC("MlpPolicy", CountingEnv(), policy_kwargs={"net_arch": [4]}, buffer_size=10).save("sac.zip")
    assert main(["evaluate", *words.split()]) == 2
    printed = capsys.readouterr().err
    assert message in printed and printed.startswith("sb3_esad evaluate: ") and printed.count("\n") == 1


@pytest.mark.parametrize("options", [[], ["--video", "a.mp4"]], ids=["plain", "filmed"])
@pytest.mark.parametrize("env_id", ["esad-highway-vector-v0", "esad-highway-dict-v0"])
def test_evaluate_refuses_a_model_of_another_scenario(
    env_id: str,
    options: list[str],
    saved: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", "--model", str(saved), "--env", env_id, *options]) == 2
    printed = capsys.readouterr().err
    assert printed.startswith(f"sb3_esad evaluate: Observations of {env_id} are ") and printed.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("", "required: COMMAND"),
        ("evaluate", "one of the arguments --model --driver is required"),
        ("evaluate --driver keeper --model a.zip", "not allowed with argument"),
        ("evaluate --driver pilot", "invalid choice: 'pilot'"),
        ("evaluate --driver keeper --episodes 0", "'0' is no whole number from 1 on"),
        ("evaluate --driver keeper --episodes x", "'x' is no whole number from 1 on"),
        ("evaluate --driver keeper --seed -1", "'-1' is no whole number from 0 on"),
        ("demo --timesteps 1.5", "'1.5' is no whole number from 1 on"),
        ("demo --minutes 0", "'0' is no number above 0"),
        ("demo --minutes nan", "'nan' is no number above 0"),
    ],
)
def test_wrong_options(words: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words.split())
    assert caught.value.code == 2
    assert message in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_demo(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = {"policy": "CnnPolicy", "policy_kwargs": TINY, "learning_starts": 30, "pretrain_steps": 1, "batch_size": 2}
    monkeypatch.setattr(demo, "load_hyperparams", lambda *_: Hyperparams(60, 2, {**arguments, "imagination_starts": 8}))
    monkeypatch.setattr(demo, "FIT_UPDATES", 2)
    folder = tmp_path / "new" / "demo"
    known_in_every_process = f"{__name__}:{SHORT}"
    brief = ["--env", known_in_every_process, "--timesteps", "60", "--episodes", "2"]
    assert main(["demo", "--out", str(folder), *brief, "--threads", "1", "--seed", "3"]) == 0
    files = {"esad_lend.zip", "learning_curve.png", "results.md", "episode.mp4"}
    assert {path.name for path in folder.iterdir()} == files
    printed, results = capsys.readouterr().out, (folder / "results.md").read_text()
    assert all(str(folder / name) in printed for name in files)
    assert "Trained for 64 steps" in results and "with seed 3" in results
    assert "seeds 1000000 to 1000001" in results
    table = [line for line in results.splitlines() if line.startswith("|")]
    assert "| ESAD-LEND" in table[0] and "\n".join(table) in printed
    assert ESADLEND.load(folder / "esad_lend.zip").num_timesteps == 64


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_demo_too_short_for_an_episode(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(demo.FEW_UPDATES, "train_freq", 1)
    assert main(["demo", "--out", str(tmp_path), "--timesteps", "1", "--threads", "1"]) == 2
    assert "train for more steps" in capsys.readouterr().err


def test_it_runs_as_a_module() -> None:
    command = [sys.executable, "-W", "error", "-m", "sb3_esad", "--version"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[1], check=False)
    assert (result.returncode, result.stdout, result.stderr) == (0, f"sb3_esad {__version__}\n", "")


@pytest.mark.parametrize(
    ("env_id", "reason"), [("CartPole-v1", "is no driving scenario"), ("esad-course-vector-v0", "has no image")]
)
def test_the_demo_refuses_what_it_could_not_film_before_it_trains(
    env_id: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["demo", "--env", env_id, "--out", str(tmp_path / "demo")]) == 2
    assert f"{env_id} {reason}" in capsys.readouterr().err
    assert not (tmp_path / "demo").exists()
