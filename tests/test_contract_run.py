"""SB3's contract: training, acting, callbacks and logs of every algorithm."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv
from stable_baselines3.her import HerReplayBuffer

from tests.conftest import VECTOR, CountingEnv, RandomEnv
from tests.contract import Algorithm, every_algorithm, imagines, make


@every_algorithm
def test_as_many_updates_as_steps(algorithm: Algorithm) -> None:
    """From the first step on, although there are fewer of them than a window has."""
    env = DummyVecEnv([CountingEnv] * 2)
    model = make(algorithm, env=env, learning_starts=0, train_freq=3, gradient_steps=-1).learn(3)
    assert model._n_updates == model.logger.name_to_value["train/n_updates"] == 3 * env.num_envs


@every_algorithm
def test_frequency_of_updates(algorithm: Algorithm, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """After steps or after episodes, as it was asked for, and as a loaded model is told."""
    updated_at: list[int] = []
    monkeypatch.setattr(algorithm, "train", lambda self, *args, **kwargs: updated_at.append(self.num_timesteps))
    for train_freq in (4, (4, "step"), (1, "episode")):
        model = make(algorithm, learning_starts=6, train_freq=train_freq).learn(21)
    model.save(tmp_path / "model")
    algorithm.load(tmp_path / "model", env=CountingEnv(), train_freq=(5, "step")).learn(20)
    assert updated_at == [*2 * (8, 12, 16, 20, 24), 7, 14, 21, 10, 15, 20]


@every_algorithm
@pytest.mark.parametrize("train_freq", ["4", ("1", "episode"), "often", (1, "day")])
def test_frequencies_that_are_none(algorithm: Algorithm, train_freq: Any) -> None:
    with pytest.raises(ValueError, match=r"train_freq|train frequency"):
        make(algorithm, train_freq=train_freq)


@every_algorithm
def test_weight_of_the_entropy(algorithm: Algorithm) -> None:
    weights = {}
    for ent_coef in (0.3, "auto_0.01"):
        model = make(algorithm, ent_coef=ent_coef, learning_starts=0, gradient_steps=2).learn(4)
        weights[ent_coef] = model.logger.name_to_value["train/ent_coef"]
    assert weights[0.3] == pytest.approx(0.3)
    assert weights["auto_0.01"] == pytest.approx(0.01, rel=0.1) and weights["auto_0.01"] != 0.01


@every_algorithm
def test_noise_is_drawn_for_each_environment(algorithm: Algorithm) -> None:
    """Noise that is much larger than the range of an action pushes most of them to either end."""
    noise = NormalActionNoise(np.zeros(1), np.full(1, 20.0))
    env = DummyVecEnv([CountingEnv] * 2)
    model = make(algorithm, env=env, action_noise=noise, learning_starts=0, train_freq=100).learn(60)
    assert isinstance(model.action_noise, VectorizedActionNoise)
    actions = model.replay_buffer.actions[:30, :, 0]
    assert np.mean(np.abs(actions) > 0.999) > 0.7
    assert 5 < np.sum(actions[:, 0] * actions[:, 1] < 0) < 25, "in either environment for itself"


@every_algorithm
def test_window_of_the_statistics(algorithm: Algorithm) -> None:
    model = make(algorithm, stats_window_size=2).learn(28)
    assert model.ep_info_buffer.maxlen == model.ep_success_buffer.maxlen == len(model.ep_info_buffer) == 2


class OwnBox(spaces.Box):
    """A space of a user's."""


@every_algorithm
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_of_one_and_of_many(algorithm: Algorithm, dtype: type) -> None:
    space = OwnBox(np.array([[-3.0, 0.0], [1.0, -1.0]], dtype), np.array([[5.0, 0.1], [2.0, 1.0]], dtype), dtype=dtype)
    model = make(algorithm, env=RandomEnv(OwnBox(-1.0, 1.0, (3,), np.float32), space))
    one, _ = model.predict(VECTOR.sample())
    many, _ = model.predict(np.stack([VECTOR.sample() for _ in range(4)]), deterministic=True)
    assert one.dtype == many.dtype == dtype and many.shape == (4, 2, 2)
    assert all(space.contains(action) for action in (one, *many))


@every_algorithm
def test_what_reset_returns_is_no_observation(algorithm: Algorithm) -> None:
    with pytest.raises(ValueError, match="mixing Gym API"):
        make(algorithm).predict(CountingEnv().reset())


def drive(algorithm: Algorithm, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Learn, then act at random; what was done and earned."""
    model = make(algorithm, env=RandomEnv(VECTOR), seed=seed, action_noise=NormalActionNoise(np.zeros(1), np.ones(1))).learn(
        28
    )
    env = model.get_env()
    observation, state, start, actions, rewards = env.reset(), None, None, [], []
    for _ in range(8):
        action, state = model.predict(observation, state, start, deterministic=False)
        observation, reward, start, _ = env.step(action)
        actions.append(action)
        rewards.append(reward)
    return np.concatenate([model.replay_buffer.actions[:28, 0], *actions]), np.array(rewards)


@every_algorithm
def test_the_seed_decides(algorithm: Algorithm) -> None:
    (actions, rewards), (same_actions, same_rewards) = (drive(algorithm, seed=3) for _ in range(2))
    np.testing.assert_array_equal(actions, same_actions)
    np.testing.assert_array_equal(rewards, same_rewards)


class Stop(BaseCallback):
    """
    Stops at once.

    :param answer: what it says
    """

    def __init__(self, answer: Any) -> None:
        super().__init__()
        self.answer = answer

    def _on_step(self) -> bool:
        return self.answer


@every_algorithm
@pytest.mark.parametrize("answer", [False, np.bool_(False), th.tensor(False)], ids=["bool", "numpy", "torch"])
def test_callbacks_stop(algorithm: Algorithm, answer: Any) -> None:
    callback = Stop(answer)
    model = make(algorithm).learn(30, callback=callback)
    assert callback.n_calls == model.num_timesteps == 1


class Witness(BaseCallback):
    """Looks at what SB3 lets callbacks see of a step."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[float] = []

    def _on_step(self) -> bool:
        assert self.model.observation_space.contains(self.locals["new_obs"][0])
        assert all(len(self.locals[name]) == 1 for name in ("infos", "dones", "rewards", "actions"))
        self.seen.append(self.locals["new_obs"][0].item())
        return True


@every_algorithm
@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_callbacks_see_the_step(algorithm: Algorithm) -> None:
    """In lists and inside others, with the bar of the progress; a function does as well."""
    first, second = Witness(), Witness()
    model = make(algorithm).learn(12, callback=[first, EveryNTimesteps(2, second)], progress_bar=True)
    assert first.seen == [1, 2, 3, 4, 5, 6, 0, 1, 2, 3, 4, 5] and second.seen == first.seen[1::2]
    steps: list[int] = []
    model.learn(4, callback=lambda locals_, globals_: steps.append(locals_["self"].num_timesteps) or True)
    assert steps == [1, 2, 3, 4]


class Success(CountingEnv):
    """Says at the end of an episode that it went well."""

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated, truncated, {**info, **({"is_success": True} if terminated else {})}


class HasParent(BaseCallback):
    """Notes whose child it is."""

    def _on_step(self) -> bool:
        assert isinstance(self.parent, EvalCallback)
        return True


@every_algorithm
def test_evaluation_while_training(algorithm: Algorithm, tmp_path: Path) -> None:
    """Callbacks follow it, success is logged, and the best model acts as the present one."""
    child = HasParent()
    callback = EvalCallback(
        DummyVecEnv([lambda: Monitor(Success())] * 2),
        callback_on_new_best=CallbackList([HasParent()]),
        callback_after_eval=child,
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        n_eval_episodes=2,
        eval_freq=12,
        verbose=0,
    )
    model = make(algorithm, env=Success()).learn(12, callback=callback)
    assert callback.last_mean_reward == 28.0 and callback._is_success_buffer == [True, True] and child.n_calls == 1
    logged = np.load(tmp_path / "evaluations.npz")
    assert logged["timesteps"].tolist() == [12] and logged["ep_lengths"].tolist() == [[7, 7]]
    model.dump_logs()
    best = algorithm.load(tmp_path / "best_model")
    observation = np.ones((3, 1), np.float32)
    actions = [each.predict(observation, deterministic=True)[0] for each in (model, best)]
    np.testing.assert_array_equal(*actions)


@every_algorithm
def test_success_is_logged(algorithm: Algorithm, capsys: pytest.CaptureFixture[str]) -> None:
    make(algorithm, env=Success(), verbose=1).learn(28)
    assert "success_rate" in capsys.readouterr().out


@every_algorithm
def test_runs_of_tensorboard(algorithm: Algorithm, tmp_path: Path) -> None:
    """Named after the class, one for each training that counts from zero."""
    pytest.importorskip("tensorboard")
    model = make(algorithm, tensorboard_log=str(tmp_path))
    model.learn(8)
    model.learn(8, reset_num_timesteps=False)
    model.learn(8)
    model.learn(8, tb_log_name="mine")
    assert {path.name for path in tmp_path.iterdir()} == {f"{algorithm.__name__}_1", f"{algorithm.__name__}_2", "mine_1"}


OFFERED_BY_SAC = {"use_sde": True, "sde_sample_freq": 4, "use_sde_at_warmup": True}


@every_algorithm
def test_exploration_that_depends_on_the_state(algorithm: Algorithm) -> None:
    """SAC has it, and so have those that extend it; the others say what to do instead."""
    if not imagines(algorithm):
        model = make(algorithm, **OFFERED_BY_SAC).learn(32)
        assert model.actor.get_std().isfinite().all()
        return
    for name, value in OFFERED_BY_SAC.items():
        with pytest.raises(ValueError, match=rf"{algorithm.__name__} cannot take {name}={value}: .* instead\."):
            make(algorithm, **{name: value})


@every_algorithm
@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"n_steps": 3}, r"n_steps(=| is )3"),
        ({"replay_buffer_class": HerReplayBuffer}, "replay_buffer_class is 'HerReplayBuffer'; choose a "),
        ({"replay_buffer_class": ReplayBuffer}, "replay_buffer_class is 'ReplayBuffer'; choose a .*, which keeps costs"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage=True would lose"),
    ],
    ids=str,
)
def test_what_is_not_offered(algorithm: Algorithm, arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make(algorithm, **arguments)


@every_algorithm
@pytest.mark.parametrize("space", [spaces.Discrete(3), spaces.MultiBinary(2)], ids=str)
def test_actions_that_are_no_box(algorithm: Algorithm, space: spaces.Space) -> None:
    env: gym.Env = RandomEnv(VECTOR, space)
    with pytest.raises((AssertionError, ValueError), match="Box"):
        make(algorithm, env=env)
