"""What is saved comes back: networks, optimisers, dual variables, statistics and the replay buffer."""

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_esad import ESADLEND
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.policies import LatentPolicy
from tests.conftest import PICTURE, SPACES, TINY, VECTOR, CountingEnv, RandomEnv, actions_of, assert_same, make_env


def multiplier_of(model: ESADLEND) -> th.Tensor:
    assert isinstance(model.penalty, AugmentedLagrangian)
    return model.penalty.multiplier


def train(policy: str = "MlpPolicy", n_envs: int = 1, steps: int = 32, **kwargs: Any) -> ESADLEND:
    return ESADLEND(policy, make_env(policy, n_envs), **{**TINY, "penalty_warmup": 0, **kwargs}).learn(steps)


@pytest.mark.parametrize("policy", SPACES)
def test_everything_comes_back(policy: str, tmp_path: Path) -> None:
    """Parameters, optimisers, multiplier, entropy coefficient, return scale and image background."""
    model = train(policy, ent_coef="auto")
    multiplier_of(model).fill_(7.0)
    model.policy.critic.scale.fill_(3.0)
    model.save(tmp_path / "model")
    loaded = ESADLEND.load(tmp_path / "model", device="cpu")
    saved, restored = model.get_parameters(), loaded.get_parameters()
    assert {"policy", "penalty", "entropy", "entropy.optimizer", "policy.world_model.optimizer"} <= saved.keys()
    assert_same(saved, restored)
    assert multiplier_of(loaded).item() == 7.0 and loaded.policy.critic.scale.item() == 3.0
    assert loaded.entropy().item() == model.entropy().item() != 1.0
    assert loaded.num_timesteps == 32 and loaded._n_updates == model._n_updates
    if policy == "CnnPolicy":
        assert restored["policy"]["world_model.observations.observation.background"].abs().sum() > 0
    np.testing.assert_array_equal(actions_of(loaded), actions_of(model))


def test_random_parameters_survive(tmp_path: Path) -> None:
    """As SB3's tests fill all parameters and buffers, with numbers from 0 to 1; all of them are floats."""
    model = train(ent_coef="auto")
    for module in (model.policy, model.penalty, model.entropy):
        before = {name: value.clone() for name, value in module.state_dict().items()}
        module.load_state_dict({name: th.rand_like(value) for name, value in before.items()})
        assert all(value.dtype == th.float32 for value in before.values())
    expected = actions_of(model)
    model.save(tmp_path / "model")
    loaded = ESADLEND.load(tmp_path / "model", env=make_env("MlpPolicy"), device="cpu")
    for name, value in loaded.get_parameters().items():
        assert_same(value, model.get_parameters()[name])
    np.testing.assert_array_equal(actions_of(loaded), expected)
    loaded.learn(32)


@pytest.mark.parametrize("ent_coef", [0.1, "auto_0.5"])
def test_training_goes_on(ent_coef: str | float, tmp_path: Path) -> None:
    model = train(ent_coef=ent_coef)
    model.save(tmp_path / "model")
    loaded = ESADLEND.load(tmp_path / "model", env=make_env("MlpPolicy"), device="cpu")
    penalty = loaded.penalty
    loaded.learn(16, reset_num_timesteps=False)
    assert loaded._n_updates == model._n_updates, "a few steps are not enough to learn from"
    loaded.learn(24, reset_num_timesteps=False)
    assert loaded.num_timesteps == 72 and loaded._n_updates == model._n_updates + 6
    assert loaded.penalty is penalty and loaded.replay_buffer.size() == 40
    assert all(parameter.isfinite().all() for parameter in loaded.policy.parameters())


@pytest.mark.parametrize(("before", "after"), [(1, 3), (3, 1), (2, 4)])
def test_another_number_of_environments(before: int, after: int, tmp_path: Path) -> None:
    model = train(n_envs=before, steps=48)
    model.save(tmp_path / "model")
    loaded = ESADLEND.load(tmp_path / "model", env=make_env("MlpPolicy", after), device="cpu")
    assert loaded.n_envs == loaded.replay_buffer.n_envs == after
    loaded.learn(24)
    assert loaded._last_latent is not None and len(loaded._last_latent.memory) == after


def test_memory_of_the_environment_is_not_saved(tmp_path: Path) -> None:
    """Nothing of the run itself is pickled, and what is kept in torch's own format is not kept twice."""
    model = train()
    model.save(tmp_path / "model")
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert data is not None
    runs = {"_last_latent", "_random_actions", "_episode_costs", "_images", "_violations", "last_risk", "_selections"}
    scratch = {*runs, "replay_buffer"}
    assert not data.keys() & {*scratch, "policy", "penalty", "entropy"}
    assert {"cost_limit", "ent_coef", "imagination_horizon", "total_cost"} <= data.keys()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ESADLEND.load(tmp_path / "model", device="cpu")._last_latent is None


def test_arguments_that_do_not_fit_the_saved_networks(tmp_path: Path) -> None:
    train(ent_coef="auto_0.5").save(tmp_path / "model")
    with pytest.raises(ValueError, match="model was saved by another version of sb3_esad, or the arguments given to load"):
        ESADLEND.load(tmp_path / "model", device="cpu", ent_coef=0.1)


@pytest.mark.parametrize(("saved", "loaded"), [(0.3, None), (None, 0.3), (0.3, 0.1)])
def test_a_limit_may_come_and_go(saved: float | None, loaded: float | None, tmp_path: Path) -> None:
    """The multiplier of a limit is kept under another one, and begins anew where there was none."""
    model = train(cost_limit=saved)
    for value in model.penalty.state_dict().values():
        value.fill_(1.5)
    model.save(tmp_path / "model")
    other = ESADLEND.load(tmp_path / "model", device="cpu", cost_limit=loaded, lagrangian_multiplier_init=3.0)
    multiplier = other.penalty.state_dict().get("multiplier")
    assert (None if multiplier is None else multiplier.item()) == {(0.3, None): None, (None, 0.3): 3.0}.get(
        (saved, loaded), 1.5
    )


def test_the_reason_is_the_first_error(tmp_path: Path) -> None:
    """SB3 takes a ValueError for an old version's, and stumbles."""
    train(ent_coef="auto_0.5").save(tmp_path / "model")
    with pytest.raises(ValueError, match="entropy"):
        ESADLEND.load(tmp_path / "model", device="cpu", ent_coef=0.1)


def test_file_objects_need_not_be_rewound() -> None:
    file = io.BytesIO()
    train().save(file)
    assert ESADLEND.load(file, device="cpu").num_timesteps == 32


def test_arguments_survive(tmp_path: Path) -> None:
    """``load`` builds a model of the defaults first; what was asked for must take its place."""
    settings = {"cost_limit": 0.3, "risk_level": 0.9, "lagrangian_multiplier_init": 2.0, "cost_gamma": 0.5, "ent_coef": 0.2}
    model = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, **settings, "cost_key": "crashed", "replay_cost_critic_coef": 0.7})
    model.save(tmp_path / "model")
    loaded = ESADLEND.load(tmp_path / "model", device="cpu")
    assert {name: getattr(loaded, name) for name in settings} == settings
    assert loaded.penalty.cost_limit == 0.3 and multiplier_of(loaded).item() == 2.0
    assert loaded.entropy().item() == pytest.approx(0.2)
    assert loaded.replay_buffer.sequence_length == 8 and loaded.replay_buffer.read_costs.cost_key == "crashed"
    assert loaded.replay_cost_critic_coef == 0.7


@pytest.mark.parametrize("cost_limit", [None, 0.0])
def test_limits_that_are_false_survive(cost_limit: float | None, tmp_path: Path) -> None:
    ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "cost_limit": cost_limit}).save(tmp_path / "model")
    loaded = ESADLEND.load(tmp_path / "model", device="cpu")
    assert loaded.cost_limit == cost_limit
    assert type(loaded.penalty).__name__ == ("NoPenalty" if cost_limit is None else "AugmentedLagrangian")


def test_other_learning_rate(tmp_path: Path) -> None:
    model = train(learning_rate=lambda remaining: 1e-3 * remaining)
    model.save(tmp_path / "model")
    custom = {"learning_rate": 2e-5, "lr_schedule": lambda _: 2e-5}
    loaded = ESADLEND.load(tmp_path / "model", env=make_env("MlpPolicy"), device="cpu", custom_objects=custom)
    loaded.learn(32)
    assert {optimizer.param_groups[0]["lr"] for optimizer in loaded._optimizers().values()} == {2e-5}


def test_exclude_and_include(tmp_path: Path) -> None:
    model = train()
    model.save(tmp_path / "model", exclude=["total_cost", "cost_limit"], include=["_random_actions"])
    data, _, _ = load_from_zip_file(tmp_path / "model")
    assert data is not None and "_random_actions" in data
    assert "total_cost" not in data and "cost_limit" not in data


def test_file_objects(tmp_path: Path) -> None:
    model = train()
    memory = io.BytesIO()
    model.save(memory)
    memory.seek(0)
    np.testing.assert_array_equal(actions_of(ESADLEND.load(memory, device="cpu")), actions_of(model))
    with (tmp_path / "model.zip").open("wb") as file:
        model.save(file)
    with (tmp_path / "model.zip").open("rb") as file:
        np.testing.assert_array_equal(actions_of(ESADLEND.load(file, device="cpu")), actions_of(model))


def test_no_resource_is_left_open(tmp_path: Path) -> None:
    """Warnings are errors here, those of files that are never closed included."""
    model = train()
    model.save(tmp_path / "model")
    ESADLEND.load(tmp_path / "model", device="cpu")
    model.save_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer")


@pytest.mark.parametrize("policy", SPACES)
def test_policy_alone(policy: str, tmp_path: Path) -> None:
    model = train(policy)
    model.policy.save(str(tmp_path / "policy.pt"))
    loaded = type(model.policy).load(str(tmp_path / "policy.pt"), device="cpu")
    assert isinstance(loaded, LatentPolicy)
    observation = model.observation_space.sample()
    mine: Any = None
    theirs: Any = None
    for _ in range(2):
        action, mine = model.predict(observation, mine, deterministic=True)
        same, theirs = loaded.predict(observation, theirs, deterministic=True)
        np.testing.assert_array_equal(action, same)


def test_policy_alone_keeps_its_arguments(tmp_path: Path) -> None:
    policy_kwargs = {
        "net_arch": {"pi": [5], "qf": [6]},
        "memory_channels": 7,
        "latent_channels": 3,
        "head_kwargs": {"free_nats": 2.0},
        "world_model_kwargs": {"units": 9},
        "features_extractor_kwargs": {"features_dim": 11},
        "optimizer_class": th.optim.RMSprop,
        "optimizer_kwargs": {"alpha": 0.5},
    }
    model = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "policy_kwargs": policy_kwargs})
    model.policy.save(str(tmp_path / "policy.pt"))
    loaded = type(model.policy).load(str(tmp_path / "policy.pt"), device="cpu")
    for name, value in policy_kwargs.items():
        assert getattr(loaded, name) == value


@pytest.mark.parametrize("policy", ["MlpPolicy", "MultiInputPolicy"])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_replay_buffer(policy: str, n_envs: int, tmp_path: Path) -> None:
    model = train(policy, n_envs)
    model.save_replay_buffer(tmp_path / "buffer")
    other = ESADLEND(policy, make_env(policy, n_envs), **TINY)
    other.load_replay_buffer(tmp_path / "buffer", truncate_last_traj=True)
    for name in ("actions", "rewards", "costs", "dones", "timeouts", "episode_starts"):
        np.testing.assert_array_equal(getattr(other.replay_buffer, name), getattr(model.replay_buffer, name))
    np.random.seed(0)
    mine = model._sample(4)
    np.random.seed(0)
    for one, another in zip(mine, other._sample(4), strict=True):
        assert_same(one, another)
    other.learn(32, reset_num_timesteps=False)
    assert other.replay_buffer.size() == 2 * 32 // n_envs


def test_a_replay_buffer_is_replaced_as_a_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = train()
    model.save_replay_buffer(tmp_path / "buffer")
    saved = (tmp_path / "buffer.pkl").read_bytes()

    def run_out_of_space(path: Path, *args: Any) -> None:
        path.write_bytes(saved[:100])
        raise OSError("No space left on device")

    monkeypatch.setattr("stable_baselines3.common.off_policy_algorithm.save_to_pkl", run_out_of_space)
    with pytest.raises(OSError, match="No space left"):
        model.save_replay_buffer(tmp_path / "buffer")
    assert [path.name for path in tmp_path.iterdir()] == ["buffer.pkl"]
    assert (tmp_path / "buffer.pkl").read_bytes() == saved


def test_a_replay_buffer_takes_the_settings_of_its_model(tmp_path: Path) -> None:
    before = train(sequence_length=4)
    before._sample(2)  # the places of its windows are remembered, and saved with it
    before.save_replay_buffer(tmp_path / "buffer")
    model = ESADLEND("MlpPolicy", make_env("MlpPolicy"), **{**TINY, "sequence_length": 6, "cost_key": "crashed"})
    model.load_replay_buffer(tmp_path / "buffer")
    assert model._sample(2).rewards.shape == (2, 6)
    assert model.replay_buffer._windows is not None
    assert model.replay_buffer._windows.n_starts == model.replay_buffer.size() - 5
    assert model.replay_buffer.read_costs.cost_key == "crashed"


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (lambda: train(n_envs=2), "SequenceReplayBuffer of 2 environments"),
        (lambda: train("CnnPolicy"), r"observations Box\(0, 255"),
        (lambda: SAC("MlpPolicy", make_env("MlpPolicy"), buffer_size=10), "is a ReplayBuffer of 1 environments"),
    ],
)
def test_a_foreign_replay_buffer_is_refused(other: Callable[[], OffPolicyAlgorithm], named: str, tmp_path: Path) -> None:
    other().save_replay_buffer(tmp_path / "buffer")
    model = train()
    own = model.replay_buffer
    with pytest.raises(ValueError, match=f"{named}.*but the model needs a SequenceReplayBuffer of 1 environments.*; load"):
        model.load_replay_buffer(tmp_path / "buffer")
    assert model.replay_buffer is own


def test_a_saved_image_buffer_is_no_larger_than_its_frames(tmp_path: Path) -> None:
    model = train("CnnPolicy", buffer_size=60, learning_starts=100)
    model.save_replay_buffer(tmp_path / "buffer")
    assert (tmp_path / "buffer.pkl").stat().st_size < 1.2 * 60 * np.prod(PICTURE.shape) + 20_000


def test_set_parameters() -> None:
    model, other = train(), train(seed=1)
    assert not np.allclose(actions_of(model), actions_of(other))
    parameters: dict[str, Any] = model.get_parameters()
    other.set_parameters(parameters, exact_match=True)
    np.testing.assert_array_equal(actions_of(other), actions_of(model))
    del parameters["penalty"]
    with pytest.raises(ValueError, match="do not match"):
        other.set_parameters(parameters, exact_match=True)


def test_another_environment() -> None:
    model = train()
    model.set_env(make_env("MlpPolicy"))
    model.learn(16, reset_num_timesteps=False)
    model.set_env(DummyVecEnv([lambda: RandomEnv(VECTOR, episode_length=4)]), force_reset=True)
    model.learn(16, reset_num_timesteps=False)
    assert model.replay_buffer.dones[48:64].sum() == 4
    with pytest.raises(AssertionError):
        model.set_env(make_env("MlpPolicy", 2))
