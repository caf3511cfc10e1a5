"""SB3's contract: what every algorithm saves, loads and takes over."""

import io
import tempfile
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from tests.conftest import VECTOR, CountingEnv, RandomEnv, assert_same
from tests.contract import Algorithm, every_algorithm, make

SEEN = np.linspace(0.0, 1.0, 5, dtype=np.float32)[:, None]
"""Observations of :class:`CountingEnv` in five environments."""


def act(model: Any) -> np.ndarray:
    return model.predict(SEEN, deterministic=True)[0]


def parameters_of(model: Any) -> dict[str, Any]:
    """Of networks and dual variables, not of optimisers."""
    return {name: value for name, value in deepcopy(model.get_parameters()).items() if "optim" not in name}


@every_algorithm
def test_parameters_that_do_not_fit(algorithm: Algorithm) -> None:
    model = make(algorithm)
    parameters = deepcopy(model.get_parameters())
    for exact_match in (True, False):
        with pytest.raises(ValueError, match="stranger"):
            model.set_parameters({**parameters, "stranger": {}}, exact_match=exact_match)
    for name in parameters:
        with pytest.raises(ValueError, match="do not match"):
            model.set_parameters({key: value for key, value in parameters.items() if key != name}, exact_match=True)
    shortened = {**parameters, "policy": dict(list(parameters["policy"].items())[:-1])}
    with pytest.raises(RuntimeError, match="Missing key"):
        model.set_parameters(shortened, exact_match=True)


@every_algorithm
def test_random_parameters_are_taken_saved_and_loaded(algorithm: Algorithm, tmp_path: Path) -> None:
    """All but the last of each object, which keeps what it had; the model acts as before and learns on."""
    model = make(algorithm).learn(24)
    before = parameters_of(model)
    given = {name: dict(list(each.items())[:-1]) for name, each in before.items()}
    given = {name: {key: th.rand_like(value) for key, value in each.items()} for name, each in given.items()}
    model.set_parameters({**model.get_parameters(), **given}, exact_match=False)
    expected = {name: {**before[name], **given[name]} for name in before}
    assert_same(parameters_of(model), expected)
    actions = act(model)
    assert np.isfinite(actions).all()
    model.save(tmp_path / "model")
    loaded: Any = algorithm.load(tmp_path / "model", env=CountingEnv(), device="cpu")
    assert_same(parameters_of(loaded), expected)
    np.testing.assert_array_equal(act(loaded), actions)
    loaded.learn(24)
    assert loaded._n_updates > model._n_updates and np.isfinite(act(loaded)).all()


@every_algorithm
def test_a_compiled_policy(algorithm: Algorithm, tmp_path: Path) -> None:
    """It acts, learns and is saved as one that is not; nothing is compiled before somebody calls its ``forward``."""
    plain = make(algorithm).learn(24)
    model = make(algorithm)
    model.policy = th.compile(model.policy, backend="eager")
    model.learn(24)
    np.testing.assert_array_equal(act(model), act(plain))
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    np.testing.assert_array_equal(act(loaded), act(plain))


@every_algorithm
def test_environments_change(algorithm: Algorithm, tmp_path: Path) -> None:
    """Steps are counted on, and an episode goes on where it was unless a reset is asked for."""
    one, two = (DummyVecEnv([lambda start=start: CountingEnv(start=start)]) for start in (0, 100))  # type: ignore[misc]
    model = make(algorithm, env=one).learn(12)
    model.set_env(two)
    assert model._last_obs is None
    model.learn(8, reset_num_timesteps=False)
    model.set_env(two, force_reset=False)
    assert model._last_obs is not None
    model.learn(4, reset_num_timesteps=False)
    model.save(tmp_path / "model")
    goes_on: Any = algorithm.load(tmp_path / "model", env=two, force_reset=False).learn(4, reset_num_timesteps=False)
    afresh: Any = algorithm.load(tmp_path / "model", env=one).learn(4, reset_num_timesteps=False)
    assert model.num_timesteps == 24 and goes_on.num_timesteps == afresh.num_timesteps == 28
    seen = [each.replay_buffer.observations[:, 0, 0] for each in (model, goes_on, afresh)]
    assert seen[0][:24].tolist() == [*range(7), *range(5), *range(100, 107), *range(100, 105)]
    assert seen[1][:4].tolist() == [105, 106, 100, 101] and seen[2][:4].tolist() == [0, 1, 2, 3]
    with pytest.raises(AssertionError):
        model.set_env(DummyVecEnv([CountingEnv] * 2))
    assert algorithm.load(tmp_path / "model", env=DummyVecEnv([CountingEnv] * 2)).learn(4).n_envs == 2


@every_algorithm
def test_what_is_saved_can_be_chosen(algorithm: Algorithm, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = make(algorithm, gamma=0.5, stats_window_size=3)
    model.save(tmp_path / "model", exclude=["gamma", "_stats_window_size"], include=["_stats_window_size"])
    custom = {"learning_rate": 2e-5, "stranger": 1.0}
    loaded: Any = algorithm.load(tmp_path / "model", custom_objects=custom, print_system_info=True)
    assert loaded.gamma != 0.5 and loaded._stats_window_size == 3
    assert loaded.learning_rate == loaded.lr_schedule(0.3) == 2e-5 and not hasattr(loaded, "stranger")
    assert "SAVED MODEL SYSTEM INFO" in capsys.readouterr().out


@every_algorithm
def test_networks_are_not_changed_by_loading(algorithm: Algorithm, tmp_path: Path) -> None:
    model = make(algorithm)
    model.save(tmp_path / "model")
    algorithm.load(tmp_path / "model", policy_kwargs=model.policy_kwargs)
    with pytest.raises(ValueError, match="policy kwargs do not equal"):
        algorithm.load(tmp_path / "model", policy_kwargs={"net_arch": [3]})
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        algorithm.load(tmp_path / "model", env=RandomEnv(VECTOR))
    make(algorithm, policy_kwargs={"net_arch": None}).save(tmp_path / "usual")
    assert algorithm.load(tmp_path / "usual").policy.net_arch == [256, 256]  # type: ignore[attr-defined]


@every_algorithm
def test_a_schedule_gives_plain_numbers(algorithm: Algorithm, tmp_path: Path) -> None:
    """Else numpy's would be in the saved optimisers."""
    model = make(algorithm, learning_rate=lambda remaining: np.float64(1e-3) * remaining)
    model.save(tmp_path / "model")
    for each in (model, algorithm.load(tmp_path / "model")):
        assert type(each.lr_schedule(1.0)) is float and each.lr_schedule(0.5) == 5e-4  # type: ignore[attr-defined]


@every_algorithm
def test_files_are_closed_unless_they_are_the_users(algorithm: Algorithm, tmp_path: Path) -> None:
    """Warnings are errors here, those of files that are never closed included."""
    model = make(algorithm).learn(8)
    for path in (tmp_path / "one", str(tmp_path / "other")):
        model.save(path)
        algorithm.load(path)
        model.save_replay_buffer(path)
        model.load_replay_buffer(path)
    with tempfile.TemporaryFile() as file, tempfile.TemporaryFile() as buffer:
        model.save(file)
        algorithm.load(file)
        model.save_replay_buffer(buffer)
        buffer.seek(0)
        model.load_replay_buffer(buffer)
        assert not file.closed and not buffer.closed


@every_algorithm
def test_a_replay_buffer_comes_back(algorithm: Algorithm) -> None:
    """To a model that has given up its own, too; what it holds can be added again, step by step."""
    model = make(algorithm).learn(24)
    buffer, file = model.replay_buffer, io.BytesIO()
    model.save_replay_buffer(file)
    model.replay_buffer = None
    file.seek(0)
    model.load_replay_buffer(file)
    loaded = model.replay_buffer
    assert type(loaded) is type(buffer) and loaded.device == model.device
    names = ("observations", "actions", "rewards", "costs", "dones", "timeouts")
    for name in names:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(buffer, name))
    steps = slice(24)
    ends = zip(buffer.timeouts[steps], buffer.costs[steps, 0], strict=True)
    infos = [[{"TimeLimit.truncated": late, "cost": cost}] for late, cost in ends]
    done = (getattr(buffer, name)[steps] for name in ("actions", "rewards", "dones"))
    loaded.extend(buffer.observations[steps], buffer.observations[steps] + 1, *done, infos)
    for name in names:
        np.testing.assert_array_equal(getattr(loaded, name)[24:48], getattr(buffer, name)[steps])
    model.learn(8, reset_num_timesteps=False)


@every_algorithm
def test_to_go_on_warns_of_nothing(algorithm: Algorithm) -> None:
    model = make(algorithm, buffer_size=30).learn(24)
    model.learn(12, reset_num_timesteps=False)
    assert model.num_timesteps == 36 and model.replay_buffer.full
    assert model.learn(8).num_timesteps == 8


@every_algorithm
def test_a_policy_alone(algorithm: Algorithm, tmp_path: Path) -> None:
    model = make(algorithm)
    policy = model.policy
    policy.load_state_dict({name: th.rand_like(value) for name, value in policy.state_dict().items()})
    policy.save(tmp_path / "policy.pkl")
    loaded = type(policy).load(tmp_path / "policy.pkl", device="cpu")
    assert_same(dict(loaded.state_dict()), dict(policy.state_dict()))
    np.testing.assert_array_equal(act(loaded), act(policy))


@every_algorithm
def test_checkpoints(algorithm: Algorithm, tmp_path: Path) -> None:
    """Model, replay buffer and statistics of the normalisation."""
    env = VecNormalize(DummyVecEnv([CountingEnv]))
    callback = CheckpointCallback(24, str(tmp_path), save_replay_buffer=True, save_vecnormalize=True)
    model = make(algorithm, env=env).learn(24, callback=callback)
    other: Any = algorithm.load(tmp_path / "rl_model_24_steps.zip", device="cpu")
    other.load_replay_buffer(tmp_path / "rl_model_replay_buffer_24_steps.pkl")
    restored = VecNormalize.load(str(tmp_path / "rl_model_vecnormalize_24_steps.pkl"), DummyVecEnv([CountingEnv]))
    np.testing.assert_array_equal(restored.normalize_obs(SEEN), env.normalize_obs(SEEN))
    assert other.replay_buffer.size() == 23, "the step of the checkpoint is stored after it"
    np.testing.assert_array_equal(other.replay_buffer.costs[:23], model.replay_buffer.costs[:23])
