"""Agents go to the Hub and come back the same; nothing that comes from there is run, and no token is left anywhere."""

import base64
import io
import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cloudpickle
import cv2
import gymnasium as gym
import numpy as np
import pytest
import yaml
from huggingface_hub import ModelCard, constants
from test_zoo import ENV, settings, train

from sb3_esad import ADEND, ESADLEND
from sb3_esad.__main__ import main
from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.report import summarise_any
from sb3_esad.zoo.agents import Agent, EnvironmentName
from sb3_esad.zoo.card import model_card
from tests.local_hub import LocalHub, serving

pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")  # of the Hub's client to its own
TOKEN = "hf_thisIsSecret"
REPOSITORY = f"me/esad_lend-{ENV}"
AGENT = ["--algo", "esad_lend", "--env", ENV]
IMAGES = "zoo-images-v0"
gym.register(IMAGES, "sb3_esad.envs.highway:Highway", disable_env_checker=True, kwargs={"config": {"duration": 2.0}})


@contextmanager
def reached_by_its_client(cache: Path) -> Iterator[LocalHub]:
    """A stand-in for the Hub that takes its place."""
    with serving(TOKEN) as hub, pytest.MonkeyPatch.context() as patch:
        patch.setattr(constants, "ENDPOINT", hub.url)
        patch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", hub.url + "/{repo_id}/resolve/{revision}/{filename}")
        patch.setattr(constants, "HF_HUB_DISABLE_XET", True)  # a protocol of its own for large files
        patch.setattr(constants, "HF_HUB_CACHE", str(cache))
        patch.setenv("HF_TOKEN", TOKEN)
        yield hub


@pytest.fixture
def hub(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LocalHub]:
    with reached_by_its_client(tmp_path_factory.mktemp("cache")) as hub:
        yield hub


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("logs")
    assert train(folder, "-n", "40", "--eval-freq", "20", "--eval-episodes", "2") == 0
    return folder


def push(logs: Path, *words: str) -> int:
    return main(["push_to_hub", *AGENT, "-f", str(logs), "-orga", "me", "--episodes", "3", *words])


def pull(folder: Path, *words: str) -> int:
    return main(["load_from_hub", *AGENT, "-f", str(folder), "-orga", "me", *words])


@pytest.fixture(scope="module")
def shared(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Files of the agent as it is shared."""
    with reached_by_its_client(tmp_path_factory.mktemp("cache")) as hub:
        assert push(logs, "--no-render") == 0
        return hub.files[REPOSITORY]


@pytest.fixture
def pushed(hub: LocalHub, shared: dict[str, bytes]) -> dict[str, bytes]:
    """The same on a hub of their own, where they can be changed."""
    hub.files[REPOSITORY] = dict(shared)
    return hub.files[REPOSITORY]


def actions(path: Path) -> list[list[float]]:
    """What a model does in three given situations."""
    model, state = ESADLEND.load(path), None
    model.observation_space.seed(0)
    done = []
    for _ in range(3):
        action, state = model.predict(model.observation_space.sample(), state, deterministic=True)
        done.append(action.tolist())
    return done


def test_there_and_back(hub: LocalHub, logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert push(logs, "-m", "First try") == 0
    assert pull(tmp_path / "pulled") == 0
    shown = []
    for folder in (logs, tmp_path / "pulled"):
        capsys.readouterr()
        assert main(["enjoy", *AGENT, "-f", str(folder), "--no-render", "-n", "25"]) == 0
        shown.append(capsys.readouterr().out.split("Episode Reward", 1)[1])
    assert shown[0] == shown[1]
    ours, theirs = (folder / "esad_lend" / f"{ENV}_1" for folder in (logs, tmp_path / "pulled"))
    assert actions(ours / f"{ENV}.zip") == actions(theirs / f"{ENV}.zip")
    for name in ("evaluations.npz", "0.monitor.csv"):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes()
    assert [path.name for path in (tmp_path / "pulled" / "esad_lend").iterdir()] == [f"{ENV}_1"], "and nothing unfinished"
    (tmp_path / "replay.mp4").write_bytes(hub.files[REPOSITORY]["replay.mp4"])
    frames = cv2.VideoCapture(str(tmp_path / "replay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT)
    assert frames == json.loads(hub.files[REPOSITORY]["results.json"])["records"][0]["steps"], "the first of the evaluation"


def test_no_token_is_left_anywhere(hub: LocalHub, logs: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert push(logs, "--no-render") == 0 and pull(tmp_path) == 0
    assert any(request.authorization == f"Bearer {TOKEN}" for request in hub.requests), "it is used"
    assert not any(TOKEN in request.path for request in hub.requests)
    printed = capfd.readouterr()
    written = [path.read_bytes() for folder in (logs, tmp_path) for path in folder.rglob("*") if path.is_file()]
    for content in (printed.out.encode(), printed.err.encode(), *hub.files[REPOSITORY].values(), *written):
        assert TOKEN.encode() not in content


def test_the_card(pushed: dict[str, bytes]) -> None:
    card = ModelCard(pushed["README.md"].decode())
    figures = json.loads(pushed["results.json"])["figures"]
    results = {result.metric_type: result.metric_value for result in card.data.eval_results}
    assert (card.data.model_name, card.data.library_name) == ("esad_lend", "stable-baselines3")
    assert results["mean_cost"].startswith(f"{figures['cost']:.2f} [") and {"mean_reward", "driving_score"} <= set(results)
    for text in (
        f"# ESADLEND in {ENV}",
        "3 episodes with the seeds 1000000 to 1000002",
        "| driving score DS [%] ↑",
        "`cost_limit` allows 0.05 with `risk_level` 0.5",
        f"python -m sb3_esad load_from_hub --algo esad_lend --env {ENV} -orga me -name esad_lend-{ENV} -f logs",
        "40 steps by `python -m sb3_esad train",
        "train_freq: 8",
        "torch 2.",
    ):
        assert text in card.text


@pytest.mark.parametrize(
    ("limit", "costs", "sentence"),
    [
        (0.05, [0] * 100, "0.000 [0.000, 0.037]; `cost_limit` allows 0.05 with `risk_level` 0.5: kept."),
        (0.05, [0] * 10, "0.000 [0.000, 0.369]; `cost_limit` allows 0.05 with `risk_level` 0.5: open,"),
        (0.05, [1] * 10, "1.000 [0.480, 1.839]; `cost_limit` allows 0.05 with `risk_level` 0.5: exceeded."),
        (None, [0] * 10, "0.000 [0.000, 0.369], without any limit."),
    ],
)
def test_the_card_claims_no_more_than_the_episodes_show(limit: float | None, costs: list[int], sentence: str) -> None:
    model = ESADLEND("MlpPolicy", "Pendulum-v1", cost_limit=limit, buffer_size=100)
    figures = summarise_any([{"return": 1.0, "cost": cost, "steps": 5.0} for cost in costs])
    agent = Agent("esad_lend", EnvironmentName("Pendulum-v1"), Path("a.zip"), Path(), {}, {"g": 9.8})
    card = model_card(agent, model, figures, range(len(costs)), "me/mine")
    assert f"An episode cost {sentence}" in card and "driving_score" not in card
    assert "env_kwargs:\n  g: 9.8" in card


def test_the_card_knows_that_ad_end_keeps_no_limit() -> None:
    model = ADEND("MlpPolicy", "Pendulum-v1", buffer_size=100)
    agent = Agent("ad_end", EnvironmentName("Pendulum-v1"), Path("a.zip"), Path(), {}, {})
    figures = summarise_any([{"return": 1.0, "cost": 1.0, "steps": 5.0}])
    assert "without any limit." in model_card(agent, model, figures, range(1), "me/mine")


def test_stacked_frames_are_shared(hub: LocalHub, tmp_path: Path) -> None:
    agent = ["--algo", "wcsac", "--env", IMAGES, "-f", str(tmp_path)]
    small = settings(policy="CnnPolicy", policy_kwargs={"net_arch": [8]}, frame_stack=2, buffer_size=100)
    latent = ("sequence_length", "imagination_starts", "imagination_horizon", "pretrain_steps", "pretrain_gradient_steps")
    words = [word for word in small if not word.startswith(latent)]
    assert main(["train", *agent, "-n", "10", "--eval-freq", "-1", "--device", "cpu", *words]) == 0
    assert main(["push_to_hub", *agent, "-orga", "me", "--episodes", "2"]) == 0
    assert main(["load_from_hub", *agent, "-orga", "me"]) == 0
    assert main(["enjoy", *agent, "--no-render", "-n", "5"]) == 0
    assert hub.files[f"me/wcsac-{IMAGES}"]["replay.mp4"]


def test_nothing_is_replaced_unasked(pushed: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = tmp_path / "esad_lend" / f"{ENV}_1" / "mine"
    kept.parent.mkdir(parents=True)
    kept.touch()
    assert pull(tmp_path, "--exp-id", "1") == 2
    assert "is there already; replace it by --force, or leave out --exp-id." in capsys.readouterr().err
    assert kept.exists()
    assert pull(tmp_path) == 0 and (tmp_path / "esad_lend" / f"{ENV}_2").is_dir()
    assert pull(tmp_path, "--exp-id", "1", "--force") == 0 and not kept.exists()


class Intruder:
    """Leaves a mark where it is unpickled."""

    def __init__(self, mark: Path) -> None:
        self.mark = mark

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.mark,)


def with_intruder(archive: bytes, mark: Path) -> bytes:
    """The same model, with a pickle as its ``gamma``."""
    changed = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(archive)) as source, zipfile.ZipFile(changed, "w") as target:
        for name in source.namelist():
            content = source.read(name)
            if name == "data":
                pickled = base64.b64encode(cloudpickle.dumps(Intruder(mark))).decode()
                content = json.dumps({**json.loads(content), "gamma": {":type:": "float", ":serialized:": pickled}}).encode()
            target.writestr(name, content)
    return changed.getvalue()


def test_code_in_a_model_is_not_run(pushed: dict[str, bytes], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mark, model = tmp_path / "mark", f"esad_lend-{ENV}.zip"
    pushed[model] = with_intruder(pushed[model], mark)
    assert pull(tmp_path) == 2
    assert "'gamma'" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["esad_lend"] and not list((tmp_path / "esad_lend").iterdir())


def test_whoever_is_trusted_may_run_code(pushed: dict[str, bytes], tmp_path: Path) -> None:
    mark, model = tmp_path / "mark", f"esad_lend-{ENV}.zip"
    pushed[model] = with_intruder(pushed[model], mark)
    pull(tmp_path, "--trusted")
    assert mark.exists(), "or the tests of the intruder would show nothing"


def of_zip(**members: bytes) -> bytes:
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return archive.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("config.yml", b"env_wrapper: {os.system: {}}", "config.yml has env_wrapper; only plain arguments of ESADLEND and"),
        ("config.yml", b"policy_kwargs: __import__('os').getcwd()", "config.yml has policy_kwargs; only plain arguments"),
        ("config.yml", b"normalize: print(1)", "config.yml has normalize; only"),
        ("config.yml", b"a: !!python/object/apply:os.getcwd []", "config.yml holds more than plain values"),
        ("env_kwargs.yml", b"!!python/object/apply:os.getcwd []", "env_kwargs.yml holds more than plain values"),
        ("env_kwargs.yml", b"[1]", "env_kwargs.yml holds [1] instead of settings by their names"),
        ("config.yml", b"\xff", "config.yml holds more than plain values"),
        ("config.yml", None, "The repository has no config.yml; give one that push_to_hub has made"),
        ("train_eval_metrics.zip", b"text", "train_eval_metrics.zip is cut off or damaged (File is not a zip file)"),
        ("train_eval_metrics.zip", of_zip(**{"evaluations.npz": bytes(2**26 + 1)}), "is larger than 64 MiB"),
        (f"esad_lend-{ENV}.zip", b"text", "zip"),
        (f"esad_lend-{ENV}.zip", None, "zip"),
    ],
)
def test_strange_repositories_are_refused(
    name: str,
    content: bytes | None,
    message: str,
    pushed: dict[str, bytes],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if content is None:
        del pushed[name]
    else:
        pushed[name] = content
    capsys.readouterr()
    assert pull(tmp_path) == 2
    sentence = capsys.readouterr().err.splitlines()[-1]
    assert sentence.startswith("sb3_esad load_from_hub: ") and message in sentence
    assert not list((tmp_path / "esad_lend").iterdir())


def test_curves_stay_in_their_folder(pushed: dict[str, bytes], tmp_path: Path) -> None:
    names = ("../0.monitor.csv", "/tmp/1.monitor.csv", "a/2.monitor.csv", "harmless.py", "3.monitor.csv")
    pushed["train_eval_metrics.zip"] = of_zip(**dict.fromkeys(names, b"1"))
    assert pull(tmp_path) == 0
    files = {path.name for path in (tmp_path / "esad_lend" / f"{ENV}_1").iterdir()}
    assert files == {ENV, f"{ENV}.zip", "3.monitor.csv"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda config: {**config, "normalize": True}, "config.yml has normalize, normalize_kwargs; only plain"),
        (lambda config: {**config, "callback": "a.B"}, "config.yml has callback; only"),
        (
            lambda config: {**config, "policy_kwargs": {"activation_fn": complex}},
            "which only a program can read",
        ),
    ],
)
def test_what_others_could_not_load_is_not_shared(
    change: Callable[[dict[str, Any]], dict[str, Any]],
    message: str,
    hub: LocalHub,
    logs: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = logs / "esad_lend" / f"{ENV}_1" / ENV / "config.yml"
    written = path.read_text()
    try:
        path.write_text(yaml.dump(change(yaml.unsafe_load(written))))
        assert push(logs) == 2
    finally:
        path.write_text(written)
    assert message in capsys.readouterr().err
    assert not hub.files


def test_what_the_hub_says_is_told(
    hub: LocalHub, logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HF_TOKEN", "hf_another")
    for command, status in ((lambda: push(logs, "--no-render"), "401"), (lambda: pull(tmp_path), "404")):
        assert command() == 2
        said = capsys.readouterr()
        line = said.err.splitlines()[-1]
        assert f"{REPOSITORY}: " in line and status in line and "hf auth login" in line and "hf_another" not in line
        assert "Evaluating" not in said.out, "which takes minutes, for nothing"


def test_no_hub_within_reach(hub: LocalHub, logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hub.shutdown()
    hub.server_close()
    for command in (lambda: push(logs, "--no-render"), lambda: pull(tmp_path)):
        assert command() == 2
        assert f"_hub: {REPOSITORY}: " in capsys.readouterr().err.splitlines()[-1]


def test_senseless_numbers_are_refused(logs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert push(logs, "--episodes", "0") == 2
    assert capsys.readouterr().err == "sb3_esad push_to_hub: episodes is 0; choose a number >= 1.\n"


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_model_can_be_loaded_without_trust(algo: str, tmp_path: Path) -> None:
    ALGORITHMS[algo]("MlpPolicy", "Pendulum-v1", buffer_size=100).save(tmp_path / "model")
    model = ALGORITHMS[algo].load(tmp_path / "model.zip", trusted=False)
    assert not hasattr(model, "trusted") and isinstance(model, ALGORITHMS[algo])
    assert np.isfinite(model.predict(model.observation_space.sample())[0]).all()
