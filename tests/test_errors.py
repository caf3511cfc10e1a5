"""Bad input gets one clear sentence that names the value and what to do."""

import re
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.envs import IdentityEnv
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her import HerReplayBuffer

from sb3_esad import ESADLEND, WCSAC, SACLag
from sb3_esad.common.schedules import HoldThenFall
from tests.conftest import PICTURE, SPACES, TINY, VECTOR, CountingEnv, RandomEnv


def make_model(policy: str = "MlpPolicy", env: gym.Env | DummyVecEnv | None = None, **kwargs: Any) -> ESADLEND:
    return ESADLEND(policy, env or CountingEnv(), **{**TINY, **kwargs})


def check_sentence(error: Any, *parts: str) -> None:
    """One sentence, on one line, with all that it must name."""
    message = str(error.value)
    assert re.fullmatch(r"[^\n]+\.", message), f"not a sentence: {message!r}"
    for part in parts:
        assert part in message, f"{part!r} is not in {message!r}"


class CostlyEnv(CountingEnv):
    """Costs whatever it is told to."""

    def __init__(self, info: dict[str, Any]) -> None:
        super().__init__()
        self.info = info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, _ = super().step(action)
        return obs, reward, terminated, truncated, dict(self.info)


@pytest.mark.parametrize("cost", [float("nan"), float("inf"), -0.1, [0.0, 1.0], np.zeros(1), "much", None])
def test_costs_that_are_none(cost: Any) -> None:
    with pytest.raises(ValueError) as error:
        make_model(env=CostlyEnv({"cost": cost})).learn(40)
    check_sentence(error, 'info["cost"] is ', repr(cost), "one number from 0 to 1")


def test_costs_above_one() -> None:
    with pytest.raises(ValueError) as error:
        make_model(env=CostlyEnv({"cost": 25.0})).learn(40)
    check_sentence(error, 'info["cost"] is 25.0', "divide all costs and cost_limit by the largest possible cost")


def test_missing_costs_are_zero_with_one_warning() -> None:
    model = make_model(env=DummyVecEnv([lambda: CostlyEnv({"crashed": False})] * 2))
    with pytest.warns(UserWarning, match="No cost") as caught:
        model.learn(40)
    (warning,) = (each for each in caught if "No cost" in str(each.message))
    assert 'pass cost_key="crashed"' in str(warning.message)
    assert model.replay_buffer.costs.sum() == 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_model(env=CostlyEnv({"crashed": True}), cost_key="crashed").learn(40)


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("cost_limit", -1.0, ">= 0, or None for no limit"),
        ("cost_limit", float("nan"), ">= 0, or None for no limit"),
        ("cost_limit", float("inf"), ">= 0, or None for no limit"),
        ("cost_limit", "0.05", ">= 0, or None for no limit"),
        ("risk_level", 0.0, "(0, 1]"),
        ("risk_level", 1.5, "(0, 1]"),
        ("risk_level", -0.5, "(0, 1]"),
        ("cost_gamma", 1.0, "[0, 1)"),
        ("gamma", 1.01, "[0, 1]"),
        ("lambda_return", -0.1, "[0, 1]"),
        ("tau", 0.0, "(0, 1]"),
        ("batch_size", 0, ">= 1"),
        ("pretrain_steps", -1, ">= 0"),
        ("pretrain_gradient_steps", -1, ">= 0"),
        ("imagination_horizon", 0, ">= 1"),
        ("imagination_starts", 1, ">= 2"),
        ("random_hold", 0, ">= 1"),
        ("max_grad_norm", 0.0, "> 0"),
        ("barrier_decay", 0.0, "(0, 1]"),
        ("barrier_steps", 0, "from 1 to 1250"),
        ("barrier_steps", 10**6, "from 1 to 1250"),
        ("n_candidates", 10**6, "from 1 to 10000"),
        ("n_proposals", 1, "from 2 to 10000"),
        ("barrier_coef", -1.0, ">= 0"),
        ("uniform_action_prob", 1.1, "[0, 1]"),
        ("replay_critic_coef", -1.0, ">= 0"),
        ("replay_cost_critic_coef", -1.0, ">= 0"),
        ("replay_lambda", 1.5, "in [0, 1]"),
        ("min_cost_critic_rate", -0.1, "in [0, 1]"),
        ("target_entropy", "low", '"auto"'),
        ("lambda_lr", -0.1, ">= 0"),
        ("penalty_coef", -0.1, ">= 0"),
        ("lagrangian_multiplier_init", 60.0, "within 0.05 and 50"),
        ("lagrangian_multiplier_init", -1.0, "within 0.0 and 50"),
        ("ent_coef", -0.1, '"auto"'),
        ("ent_coef", "automatic", '"auto"'),
        ("sequence_length", 0, "from 1 to 1000"),
        ("sequence_length", 1001, "from 1 to 1000, the steps stored per environment"),
    ],
)
def test_arguments_out_of_range(name: str, value: Any, remedy: str) -> None:
    """Refused by the constructor, not after hours."""
    with pytest.raises(ValueError) as error:
        make_model(**{name: value})
    check_sentence(error, f"{name} is {value!r}", "choose", remedy)


@pytest.mark.parametrize(
    ("name", "value"), [("cost_weight", 0.0), ("sparsity_weight", -0.1), ("foreground_weight", -1.0), ("open_loop_length", 0)]
)
def test_arguments_of_the_world_model_out_of_range(name: str, value: Any) -> None:
    with pytest.raises(ValueError) as error:
        make_model(policy_kwargs={**TINY["policy_kwargs"], "world_model_kwargs": {name: value}})
    check_sentence(error, f"{name} is {value!r}", "choose")


def test_a_barrier_that_looks_beyond_the_dream_would_never_be_seen() -> None:
    with pytest.raises(ValueError) as error:
        make_model(barrier_steps=3, barrier_coef=1.0)
    check_sentence(error, "barrier_steps is 3", "imagination_horizon=3")
    assert make_model(barrier_steps=3).barrier_steps == 3


@pytest.mark.parametrize("dtype", [np.int64, np.uint8])
def test_actions_that_are_no_floating_point(dtype: Any) -> None:
    env = CountingEnv()
    env.action_space = spaces.Box(0, 10, (1,), dtype)
    with pytest.raises(ValueError) as error:
        make_model(env=env)
    check_sentence(error, "needs actions of floating point", np.dtype(dtype).name, "round in the environment")


@pytest.mark.parametrize("algorithm", [ESADLEND, WCSAC, SACLag])
def test_the_limit_does_not_take_the_place_of_another_argument(algorithm: Any) -> None:
    """The fourth argument of SB3's SAC is buffer_size."""
    with pytest.raises(TypeError, match="positional arguments"):
        algorithm("MlpPolicy", CountingEnv(), 3e-4, 100_000)


def test_risk_level_is_checked_without_a_limit_too() -> None:
    with pytest.raises(ValueError) as error:
        make_model(cost_limit=None, risk_level=2.0)
    check_sentence(error, "risk_level is 2.0")


def test_loading_checks_arguments_too(tmp_path: Any) -> None:
    make_model().save(tmp_path / "model")
    with pytest.raises(ValueError) as error:
        ESADLEND.load(tmp_path / "model", tau=2.0)
    check_sentence(error, "tau is 2.0")


@pytest.mark.parametrize("space", [spaces.Discrete(5), spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2)], ids=str)
def test_actions_that_are_no_box(space: spaces.Space) -> None:
    with pytest.raises(ValueError) as error:
        make_model(env=IdentityEnv(space=space))
    check_sentence(error, "needs a Box of actions", str(space), "ContinuousAction")


def test_unbounded_actions() -> None:
    with pytest.raises(AssertionError, match="finite lower and upper bound"):
        make_model(env=RandomEnv(VECTOR, spaces.Box(-np.inf, np.inf, (1,), np.float32)))


@pytest.mark.parametrize(
    ("argument", "remedy"),
    [
        ({"use_sde": True}, "action_noise"),
        ({"sde_sample_freq": 4}, "action_noise"),
        ({"use_sde_at_warmup": True}, "random_hold"),
        ({"n_steps": 3}, "lambda_return"),
    ],
)
def test_what_other_algorithms_offer(argument: dict[str, Any], remedy: str) -> None:
    ((name, value),) = argument.items()
    with pytest.raises(ValueError) as error:
        make_model(**argument)
    check_sentence(error, f"{name}={value!r}", remedy)


def test_misspelt_arguments() -> None:
    with pytest.raises(TypeError) as error:
        make_model(cost_limits=1.0)
    check_sentence(error, "ESADLEND", "'cost_limits'")


@pytest.mark.parametrize("buffer_class", [HerReplayBuffer, ReplayBuffer])
def test_replay_buffers_without_windows(buffer_class: type[ReplayBuffer]) -> None:
    with pytest.raises(ValueError) as error:
        make_model(replay_buffer_class=buffer_class)
    check_sentence(error, buffer_class.__name__, "SequenceReplayBuffer")


def test_memory_optimisation_would_lose_crashes() -> None:
    with pytest.raises(ValueError) as error:
        make_model(optimize_memory_usage=True)
    check_sentence(error, "optimize_memory_usage=True")


@pytest.mark.parametrize("shape", [(15, 64, 3), (64, 12, 1)])
def test_images_that_are_too_small(shape: tuple[int, int, int]) -> None:
    space = spaces.Box(0, 255, shape, np.uint8)
    for policy, observed in (("CnnPolicy", space), ("MultiInputPolicy", spaces.Dict({"view": space}))):
        with pytest.raises(ValueError) as error:
            make_model(policy, RandomEnv(observed))
        check_sentence(error, "too small", "16x16", str(min(shape[:2])))


@pytest.mark.parametrize("space", [VECTOR, spaces.Box(0.0, 1.0, (3, 32, 32), np.float32), spaces.Discrete(3)], ids=str)
def test_what_is_no_image(space: spaces.Space) -> None:
    with pytest.raises(ValueError) as error:
        make_model("CnnPolicy", RandomEnv(space))
    check_sentence(error, "CnnPolicy", str(space), "MlpPolicy")


def test_what_is_no_dictionary() -> None:
    with pytest.raises(ValueError) as error:
        make_model("MultiInputPolicy", RandomEnv(VECTOR))
    check_sentence(error, "MultiInputPolicy needs a Dict", str(VECTOR), "MlpPolicy")
    with pytest.raises(ValueError, match="You must use `MultiInputPolicy`"):
        make_model("MlpPolicy", RandomEnv(SPACES["MultiInputPolicy"]))
    with pytest.raises(ValueError, match="policy is 'LstmPolicy'; choose one of MlpPolicy, CnnPolicy, MultiInputPolicy"):
        make_model("LstmPolicy")


@pytest.mark.parametrize("net_arch", [[], {"pi": [], "qf": [8]}, {"pi": [8], "qf": []}])
def test_networks_without_layers(net_arch: Any) -> None:
    with pytest.raises(ValueError) as error:
        make_model(policy_kwargs={"net_arch": net_arch})
    check_sentence(error, f"net_arch is {net_arch!r}", "at least one hidden layer")


class DarkEnv(RandomEnv):
    """Shows nothing but one colour."""

    brightness = 0

    def _darken(self, observation: Any) -> Any:
        if isinstance(observation, dict):
            return {key: self._darken(part) for key, part in observation.items()}
        return np.full_like(observation, self.brightness)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = super().reset(**kwargs)
        return self._darken(observation), info


@pytest.mark.parametrize("brightness", [0, 255])
def test_black_images(brightness: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(DarkEnv, "brightness", brightness)
    with pytest.raises(ValueError) as error:
        make_model("CnnPolicy", DarkEnv(PICTURE)).learn(40)
    check_sentence(error, f"is {brightness}", "SDL_VIDEODRIVER")


def test_the_black_image_is_named() -> None:
    space = spaces.Dict({"camera": PICTURE, "speed": VECTOR})
    with pytest.raises(ValueError) as error:
        make_model("MultiInputPolicy", DarkEnv(space)).learn(40)
    check_sentence(error, "'camera'")


@pytest.mark.parametrize("space", [VECTOR, spaces.Box(-1.0, 1.0, (2, 5, 5), np.float32)], ids=str)
def test_zeros_that_are_no_image(space: spaces.Space) -> None:
    make_model(env=DarkEnv(space)).learn(24)


def test_one_environment_among_several_may_begin_in_the_dark() -> None:
    make_model("CnnPolicy", DummyVecEnv([lambda: RandomEnv(PICTURE), lambda: DarkEnv(PICTURE)])).learn(24)


@pytest.mark.parametrize(("name", "value"), [("sequence_length", 4), ("cost_key", "crashed")])
def test_arguments_of_the_buffer_that_are_the_algorithms(name: str, value: Any) -> None:
    with pytest.raises(ValueError) as error:
        make_model(replay_buffer_kwargs={name: value})
    check_sentence(error, f"replay_buffer_kwargs['{name}'] is {value!r}", f"the argument {name}")


def test_a_rate_that_never_falls_is_a_number() -> None:
    with pytest.raises(ValueError) as error:
        HoldThenFall(0.006, hold=1.0)
    check_sentence(error, "hold is 1.0", "[0, 1)")


@pytest.mark.parametrize("name", ["memory_channels", "latent_channels"])
def test_no_channels(name: str) -> None:
    with pytest.raises(ValueError, match=f"{name} is 0; choose a number >= 1, or None for the usual one"):
        ESADLEND("MlpPolicy", CountingEnv(), policy_kwargs={name: 0})
