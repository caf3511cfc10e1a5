"""Hyperparameter files: every key is an argument, every entry builds a model, every mistake is named."""

import inspect
from pathlib import Path
from typing import Any

import gymnasium as gym
import pytest
from conftest import CountingEnv
from stable_baselines3 import SAC
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad import ESADLEND, hyperparams
from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.hyperparams import RUN_KEYS, Hyperparams, check_keys, constructor_arguments, load_hyperparams, read_entries

FOLDER = hyperparams.hyperparams_folder()
ENTRIES = [(path.stem, env_id) for path in sorted(FOLDER.glob("*.yml")) for env_id in read_entries(path)]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(hyperparams, "hyperparams_folder", lambda: tmp_path)
    return tmp_path


def test_every_file_has_an_algorithm_and_a_default() -> None:
    assert {name for name, _ in ENTRIES} == set(ALGORITHMS)
    assert {name for name, env_id in ENTRIES if env_id == "default"} == set(ALGORITHMS)


@pytest.mark.parametrize(("name", "env_id"), ENTRIES)
def test_every_key_is_an_argument(name: str, env_id: str) -> None:
    entry = read_entries(FOLDER / f"{name}.yml")[env_id]
    check_keys(ALGORITHMS[name], {key: value for key, value in entry.items() if key not in RUN_KEYS}, name)
    assert env_id == "default" or env_id in gym.registry


@pytest.mark.parametrize(("name", "env_id"), ENTRIES)
def test_every_value_is_of_the_right_kind(name: str, env_id: str) -> None:
    """YAML takes 1e-3 for a word, and a word for a number fails late."""
    for key, value in read_entries(FOLDER / f"{name}.yml")[env_id].items():
        if isinstance(value, str) and not value.startswith("lin_"):
            assert key in ("policy", "ent_coef", "target_entropy", "cost_key"), f"{key} is the word {value!r}; write 1.0e-3"


@pytest.mark.parametrize(("name", "env_id"), [entry for entry in ENTRIES if entry[1] != "default"])
def test_every_entry_builds_a_model(name: str, env_id: str) -> None:
    n_timesteps, n_envs, arguments, _ = load_hyperparams(ALGORITHMS[name], name, env_id)
    model = ALGORITHMS[name](env=env_id, **arguments)
    assert n_timesteps > getattr(model, "learning_starts", 0) and n_envs >= 1
    for key, value in arguments.items():
        if key not in ("policy", "policy_kwargs", "replay_buffer_kwargs", "train_freq"):
            assert getattr(model, key) == value


@pytest.mark.parametrize("env_id", [env_id for name, env_id in ENTRIES if name == "ad_end"])
def test_ad_end_has_diffusion_everywhere(env_id: str) -> None:
    assert read_entries(FOLDER / "ad_end.yml")[env_id]["policy_kwargs"]["head_kwargs"] == {"diffusion_steps": 2}


@pytest.mark.parametrize(("name", "env_id"), ENTRIES)
def test_no_entry_repeats_a_default(name: str, env_id: str) -> None:
    for key, value in load_hyperparams(ALGORITHMS[name], name, env_id).arguments.items():
        defaults = [inspect.signature(each).parameters.get(key) for each in ALGORITHMS[name].__mro__]
        assert next(parameter for parameter in defaults if parameter is not None).default != value


def test_rates_as_rl_zoo_writes_them(folder: Path) -> None:
    (folder / "mine.yml").write_text(
        "A-v0: {learning_rate: lin_3.0e-4}\nB-v0: {learning_rate: 1e-3}\nC-v0: {learning_rate: lin}\n"
    )
    rate = load_hyperparams(SAC, "mine", "A-v0").arguments["learning_rate"]
    assert [rate(progress) for progress in (1.0, 0.5, 0.0)] == pytest.approx([3e-4, 1.5e-4, 0.0])
    for env_id, word in (("B-v0", "'1e-3'"), ("C-v0", "'lin'")):
        with pytest.raises(ValueError, match=f"{word}; choose a number such as 1.0e-3, or lin_0.001"):
            load_hyperparams(SAC, "mine", env_id)


def test_an_entry_is_preferred_to_the_default(folder: Path) -> None:
    (folder / "mine.yml").write_text(
        "default: {gamma: 0.5}\nA-v0: {n_timesteps: 7, n_envs: 3, frame_stack: 4, policy: MlpPolicy}\n"
    )
    assert load_hyperparams(SAC, "mine", "A-v0") == (7, 3, {"policy": "MlpPolicy"}, 4)
    assert load_hyperparams(SAC, "mine", "B-v0") == (100_000, 1, {"gamma": 0.5}, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("default: {gama: 0.9}", r"'gama' in .*mine\.yml is no argument of SAC; did you mean 'gamma'\?"),
        ("default: {cost_limit: 0.9}", r"'cost_limit' in .*mine\.yml is no argument of SAC; did you mean"),
        ("default: {1: 0.9}", r"'1' in .*mine\.yml is no argument of SAC"),
        ("A-v0: {gamma: 0.9}", r"mine\.yml has neither an entry 'B-v0' nor a 'default'"),
        ("default: 3", "neither an entry 'B-v0' nor a 'default'"),
        ("default: {gamma: [}", r"mine\.yml is no valid YAML: .*line 1"),
        ("", "holds no settings by environment id"),
        ("- gamma", "holds no settings by environment id"),
    ],
)
def test_mistakes_are_named(folder: Path, text: str, message: str) -> None:
    (folder / "mine.yml").write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        load_hyperparams(SAC, "mine", "B-v0")
    assert "\n" not in str(caught.value)


def test_environments_of_a_training() -> None:
    env = Hyperparams(7, 3, {}, frame_stack=4).make_env("esad-highway-v0")
    assert env.num_envs == 3 and env.observation_space.shape == (12, 64, 64)
    env.close()


def test_missing_files_are_named(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"There is no file .*mine\.yml; there are none"):
        load_hyperparams(SAC, "mine", "A-v0")
    (folder / "other.yml").touch()
    with pytest.raises(ValueError, match=r"there are other\."):
        load_hyperparams(SAC, "mine", "A-v0")


def test_the_installed_folder_comes_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "sb3_esad"
    package.mkdir()
    monkeypatch.setattr(hyperparams, "__file__", str(package / "hyperparams.py"))
    assert hyperparams.hyperparams_folder() == tmp_path / "hyperparams"
    (package / "hyperparams").mkdir()
    assert hyperparams.hyperparams_folder() == package / "hyperparams"


def test_constructor_arguments() -> None:
    arguments = constructor_arguments(ESADLEND)
    assert {"policy", "cost_limit", "imagination_horizon", "learning_rate", "seed"} <= arguments
    assert not arguments & {"env", "self", "kwargs", "unknown", "_init_setup_model"}

    class Child(SAC):
        def __init__(self, *args: Any, bonus: float = 1.0, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)

    assert constructor_arguments(Child) == constructor_arguments(SAC) | {"bonus"}


@pytest.mark.parametrize(
    "key",
    [
        "use_sde",
        "sde_sample_freq",
        "use_sde_at_warmup",
        "n_steps",
        "sde_support",
        "support_multi_env",
        "monitor_wrapper",
        "supported_action_spaces",
    ],
)
def test_what_the_constructor_refuses_is_refused(key: str) -> None:
    assert key in inspect.signature(OffPolicyAlgorithm).parameters, "an argument of SB3"
    with pytest.raises((TypeError, ValueError), match=key):
        ESADLEND("MlpPolicy", CountingEnv(), **{key: 1})
    with pytest.raises(ValueError, match=f"'{key}' in mine is no argument of ESADLEND; did you mean"):
        check_keys(ESADLEND, {key: 1}, "mine")
