"""A training of RL Zoo that was killed goes on, and all that it has written is what it would have been."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_esad import WCSAC
from sb3_esad.__main__ import main
from sb3_esad.common.checkpoints import CHECKPOINT
from tests.conftest import assert_same

ENV, ROOT = "Pendulum-v1", Path(__file__).parents[1]
STEPS = 304
SETTINGS = "policy:'MlpPolicy' buffer_size:1000 learning_starts:100 train_freq:8 policy_kwargs:dict(net_arch=[16])"


def words(folder: Path) -> list[str]:
    agent = f"train --algo wcsac --env {ENV} -n {STEPS} --device cpu --num-threads 1 --eval-freq 150 --eval-episodes 1"
    return [*agent.split(), "-f", str(folder), "--checkpoint-freq", "60", "-params", *SETTINGS.split()]


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a training that was killed after its second checkpoint."""
    logs = tmp_path_factory.mktemp("killed")
    folder = logs / "wcsac" / f"{ENV}_1"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1"}
    command = [sys.executable, "-m", "sb3_esad", *words(logs)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=environment, text=True) as process:
        assert process.stdout is not None
        checkpoints = (line for line in process.stdout if line.startswith("Checkpoint of"))
        assert len([next(checkpoints), next(checkpoints)]) == 2
        process.kill()
    assert (folder / CHECKPOINT).is_file() and not (folder / f"{ENV}.zip").exists()
    return folder


def seed_of(folder: Path) -> str:
    """The seed that RL Zoo has drawn."""
    lines = (folder / "run.yml").read_text().splitlines()
    return lines[lines.index("- --seed") + 1].removeprefix("- ").strip("'")


@pytest.mark.filterwarnings("ignore:Within save_freq")
def test_nothing_but_the_folder_is_asked_for(
    killed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([*words(tmp_path), "--seed", seed_of(killed)]) == 0
    whole = tmp_path / "wcsac" / f"{ENV}_1"
    capsys.readouterr()
    assert main(["train", "--resume", str(killed)]) == 0
    said = capsys.readouterr().out
    assert f"steps of {STEPS}" in said and "Going on after" in said
    compare(whole, killed)
    (killed / CHECKPOINT).unlink()  # as if it had been killed before the first one
    assert main(["train", "--resume", str(killed)]) == 0
    compare(whole, killed)


def compare(whole: Path, resumed: Path) -> None:
    models = [WCSAC.load(folder / f"{ENV}.zip", device="cpu") for folder in (whole, resumed)]
    assert models[0].num_timesteps == models[1].num_timesteps == STEPS
    assert_same(models[0].get_parameters(), models[1].get_parameters())
    with np.load(whole / "evaluations.npz") as one, np.load(resumed / "evaluations.npz") as other:
        assert one["timesteps"].tolist() == [150, 300]
        assert all(np.array_equal(one[name], other[name]) for name in one)
    episodes = [
        [line.rsplit(",", 1)[0] for line in (folder / "0.monitor.csv").read_text().splitlines()[1:]]
        for folder in (whole, resumed)
    ]
    assert episodes[0] == episodes[1]
    assert {path.name for path in resumed.iterdir()} == {path.name for path in whole.iterdir()}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--resume {folder}", "has no run.yml: give the folder of an experiment that was started with --checkpoint-freq"),
        ("--algo sac --env Pendulum-v1 -f {folder} --checkpoint-freq 10", "--algo is 'sac'; choose one of esad_lend"),
        ("--algo wcsac --env Pendulum-v1 -f {folder} --checkpoint-freq 0", "save_freq is 0; choose a number of steps >= 1"),
        (
            "--algo wcsac --env Pendulum-v1 -f {folder} --checkpoint-freq 10 -params policy_kwargs:dict(net_arch=range(3))",
            "The settings have range(0, 3), which no file can hold; give plain values.",
        ),
    ],
)
def test_mistakes_are_named(arguments: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["train", *arguments.format(folder=tmp_path).split()]) == 2
    assert message in capsys.readouterr().err


def test_help_tells_of_both(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["train", "--help"])
    told = capsys.readouterr().out
    assert "--resume DIR" in told and "--trained-agent" in told
