"""The multiplier moves once per rollout, and the best model is a feasible one."""

import os
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_esad import ADEND, ESADLEND
from sb3_esad.common import callbacks as callbacks_module
from sb3_esad.common.callbacks import CostEvalCallback, LagrangeCallback, prepend
from sb3_esad.common.costs import CostReader
from sb3_esad.common.evaluation import evaluate_policy
from sb3_esad.common.multipliers import AugmentedLagrangian
from tests.conftest import TINY, CountingEnv


class RecordingPenalty(AugmentedLagrangian):
    """Notes how often it is called, and with what."""

    def __init__(self) -> None:
        super().__init__(0.1, lagrangian_multiplier_init=1.0, min_episodes=1, penalty_warmup=0, road_steps=10)
        self.updates: list[tuple[Any, int]] = []
        self.n_observed = 0

    def observe(self, costs: np.ndarray, dones: np.ndarray, truncated: np.ndarray | None = None) -> None:
        self.n_observed += len(costs)
        super().observe(costs, dones, truncated)

    def update(self, violation: Any, gradient_steps: int = 1) -> dict[str, float]:
        self.updates.append((violation, gradient_steps))
        return super().update(violation, gradient_steps)


class CostReplayBuffer(ReplayBuffer):
    """SB3's buffer that knows how to read costs."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.read_costs = CostReader()


class SafeSAC(SAC):
    """The smallest algorithm with a penalty."""

    replay_buffer: CostReplayBuffer

    def _setup_model(self) -> None:
        super()._setup_model()
        self.penalty = RecordingPenalty()
        self.violations: list[float] = []
        self.n_updates_penalized = 0

    def train(self, gradient_steps: int, batch_size: int = 4) -> None:
        super().train(gradient_steps, batch_size)
        self.violations.append(1.0)

    def take_violation(self) -> tuple[float | None, int]:
        violations, self.violations = self.violations, []
        n_updates, self.n_updates_penalized = self._n_updates - self.n_updates_penalized, self._n_updates
        return float(np.mean(violations)) if violations else None, n_updates

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        return super()._init_callback(prepend(LagrangeCallback(), callback), progress_bar)


def make_model(env: gym.Env | DummyVecEnv | None = None, **kwargs: Any) -> SafeSAC:
    settings: dict[str, Any] = {"learning_starts": 10, "buffer_size": 100, "batch_size": 4, "train_freq": 5}
    net = {"policy_kwargs": {"net_arch": [8]}, "replay_buffer_class": CostReplayBuffer, "device": "cpu", "seed": 0}
    return SafeSAC("MlpPolicy", env or CountingEnv(), **{**settings, **net, **kwargs})


class CountCalls(BaseCallback):
    """A callback of the user's."""

    n_inits = 0

    def _init_callback(self) -> None:
        self.n_inits += 1

    def _on_step(self) -> bool:
        return True


def test_multiplier_moves_whatever_callback_the_user_has() -> None:
    called: list[int] = []

    def function(locals_: dict[str, Any], globals_: dict[str, Any]) -> bool:
        called.append(1)
        return True

    mine = CountCalls()
    choices: list[MaybeCallback] = [
        None,
        mine,
        [CountCalls(), CountCalls()],
        function,
        LagrangeCallback(),
        [CallbackList([LagrangeCallback(), CountCalls()])],
    ]
    for callback in choices:
        model = make_model()
        model.learn(40, callback=callback)
        assert model.penalty.n_observed == 30  # the first ten steps are random
        assert len(model.penalty.updates) == 8
        assert model.penalty.multiplier.item() > 1.0
    assert mine.n_inits == 1 and mine.n_calls == 40 and len(called) == 40


@pytest.mark.parametrize(("end", "time_limit", "length"), [(6, 1000, 5.0), (1000, 6, 6.0)])
def test_a_time_limit_is_no_crash(end: int, time_limit: int, length: float) -> None:
    """The sixth step costs 1: as the end of the episode it cuts it short, as its time limit it does not."""
    model = make_model(CountingEnv(episode_length=end, time_limit=time_limit), learning_starts=0)
    model.penalty.episodes.mean_length.fill_(5.0)
    model.learn(60)
    assert model.penalty.episodes.episode_length == length


def test_no_violation_counts_twice() -> None:
    """Three rollouts pass before the first update, and each later one sees exactly the update before it."""
    model = make_model(gradient_steps=2)
    model.learn(40)
    assert model.penalty.updates == [(None, 0)] * 3 + [(1.0, 2)] * 5
    model.learn(10, reset_num_timesteps=False)
    assert model.penalty.updates[8:] == [(1.0, 2), (1.0, 2)], "the first of them sees the last update of the first learn()"


def test_rollouts_without_updates_hold_the_multiplier() -> None:
    model = make_model(gradient_steps=0)
    model.learn(40)
    assert model.penalty.updates == [(None, 0)] * 8
    model = make_model(learning_starts=1000)
    model.learn(40)
    assert model.penalty.multiplier.item() == 1.0


def test_several_environments_and_logs() -> None:
    model = make_model(DummyVecEnv([CountingEnv] * 3), train_freq=2)
    logged = record_logs(model)
    model.learn(60, log_interval=1)
    assert model.penalty.n_observed == 60 - 12
    assert {"train/lagrangian_multiplier", "train/budget", "safety/cost_calibration"} <= logged.keys()


class Recorder(KVWriter):
    """Keeps everything that is logged."""

    def __init__(self) -> None:
        self.values: dict[str, list[Any]] = {}

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        for name, value in key_values.items():
            self.values.setdefault(name, []).append(value)

    def close(self) -> None:
        pass


def record_logs(model: SAC) -> dict[str, list[Any]]:
    recorder = Recorder()
    model.set_logger(Logger(folder=None, output_formats=[recorder]))
    return recorder.values


def test_prepend_keeps_callback_lists() -> None:
    first, second = LagrangeCallback(), CallbackList([CountCalls()])
    assert prepend(first, second) == [first, second]
    assert len(prepend(first, None)) == 2


def test_evaluate_policy_sums_costs() -> None:
    env = Monitor(CountingEnv(episode_length=7))
    model = make_model()
    rewards, lengths, costs = evaluate_policy(model, env, n_eval_episodes=3, return_episode_rewards=True)
    assert (rewards, lengths, costs) == ([28.0] * 3, [7] * 3, [2.0] * 3)
    assert evaluate_policy(model, env, n_eval_episodes=3) == (28.0, 0.0, 2.0)


def test_evaluate_policy_in_several_environments_without_monitor() -> None:
    lengths_of = [4, 9]
    env = DummyVecEnv([lambda n=n: CountingEnv(episode_length=n) for n in lengths_of])  # type: ignore[misc]
    _, lengths, costs = evaluate_policy(make_model(), env, 6, return_episode_rewards=True, warn=False)
    assert sorted(lengths) == [4, 4, 4, 9, 9, 9]  # type: ignore[arg-type]
    assert [length // 3 for length in lengths] == costs  # type: ignore[union-attr]


def test_evaluate_policy_calls_the_users_callback_and_checks_the_threshold() -> None:
    seen: list[float] = []
    env = Monitor(CountingEnv(episode_length=7))
    evaluate_policy(make_model(), env, 1, callback=lambda locals_, _: seen.append(locals_["info"]["cost"]))
    assert seen == [0, 0, 1, 0, 0, 1, 0]
    with pytest.raises(AssertionError, match="below threshold"):
        evaluate_policy(make_model(), env, 1, reward_threshold=99.0)


class LoseLives(gym.Wrapper):
    """Ends the agent's episode after each step that costs, but not the one that a Monitor inside counts."""

    def step(self, action: np.ndarray) -> Any:
        obs, reward, terminated, truncated, info = self.env.step(action)
        return obs, reward, terminated or info["cost"] > 0, truncated, info

    def reset(self, **kwargs: Any) -> Any:
        return (np.zeros(1, dtype=np.float32), {}) if self.get_wrapper_attr("count") % 7 else self.env.reset(**kwargs)


def test_a_lost_life_is_no_episode_to_a_monitor() -> None:
    env = DummyVecEnv([lambda: LoseLives(Monitor(CountingEnv(episode_length=7)))])
    _, lengths, costs = evaluate_policy(make_model(), env, 2, return_episode_rewards=True)
    assert (lengths, costs) == ([7, 7], [2.0, 2.0])


def evaluate_like(monkeypatch: pytest.MonkeyPatch, results: list[tuple[float, float]]) -> None:
    """Let successive evaluations return these rewards and costs."""
    remaining = iter(results)

    def evaluate(*args: Any, **kwargs: Any) -> Any:
        reward, cost = next(remaining)
        return [reward] * 2, [5] * 2, [cost] * 2

    monkeypatch.setattr(callbacks_module, "evaluate_policy", evaluate)


def test_best_model_is_feasible_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    results = [(9.0, 5.0), (8.0, 3.0), (99.0, 4.0), (1.0, 1.0), (50.0, 2.0), (0.5, 0.0), (2.0, 0.5)]
    evaluate_like(monkeypatch, results)
    best = CountCalls()
    saved: list[tuple[float, float]] = []
    callback = CostEvalCallback(
        DummyVecEnv([CountingEnv]),
        cost_limit=1.0,
        eval_freq=5,
        verbose=0,
        log_path=str(tmp_path),
        best_model_save_path=str(tmp_path),
        callback_on_new_best=best,
    )

    def note_best() -> bool:
        saved.append((callback.best_mean_reward, callback.best_mean_cost))
        return True

    monkeypatch.setattr(best, "_on_step", note_best)
    model = make_model()
    logged = record_logs(model)
    model.learn(35, callback=callback)
    none = -np.inf  # no reward counts before the limit is kept, so that it only rises
    assert saved == [(none, 5.0), (none, 3.0), (1.0, 1.0), (2.0, 0.5)]
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert evaluations["costs"].shape == evaluations["results"].shape == (7, 2)
    assert evaluations["costs"][:, 0].tolist() == [cost for _, cost in results]
    assert logged["eval/mean_ep_cost"] == [cost for _, cost in results]
    assert logged["eval/feasible"] == [cost <= 1 for _, cost in results]
    assert sorted(os.listdir(tmp_path)) == ["best_model.zip", "evaluations.npz"]
    SAC.load(tmp_path / "best_model.zip")


def test_without_limit_the_highest_reward_wins(monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate_like(monkeypatch, [(1.0, 5.0), (2.0, 9.0)])
    callback = CostEvalCallback(DummyVecEnv([CountingEnv]), eval_freq=5, verbose=0)
    SAC("MlpPolicy", CountingEnv(), device="cpu").learn(10, callback=callback)
    assert callback.best_mean_reward == 2.0 and isinstance(callback, EvalCallback)


def test_cost_of_the_model_is_the_default() -> None:
    class Crashing(CountingEnv):
        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            observation, reward, terminated, truncated, _ = super().step(action)
            return observation, reward, terminated, truncated, {"crashed": True}

    model = ESADLEND("MlpPolicy", Crashing(episode_length=5), **TINY, cost_key="crashed")
    callback = CostEvalCallback(Monitor(Crashing(episode_length=5)), eval_freq=4, n_eval_episodes=2, verbose=0)
    model.learn(4, callback=callback)
    assert callback.last_mean_cost == 5.0
    assert evaluate_policy(model, Monitor(Crashing(episode_length=5)), 2)[2] == 5.0


def test_a_model_that_keeps_no_limit_is_always_feasible(monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate_like(monkeypatch, [(1.0, 0.0), (2.0, 9.0)])
    callback = CostEvalCallback(DummyVecEnv([CountingEnv]), eval_freq=5, verbose=0)
    ADEND("MlpPolicy", CountingEnv(), **TINY).learn(10, callback=callback)
    assert callback.cost_limit is None and callback.best_mean_reward == 2.0


def test_limit_of_the_model_is_the_default(monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate_like(monkeypatch, [(1.0, 0.0), (2.0, 9.0)])
    model = SAC("MlpPolicy", CountingEnv(), device="cpu")
    model.cost_limit = 0.0  # type: ignore[attr-defined]
    callback = CostEvalCallback(DummyVecEnv([CountingEnv]), eval_freq=5, verbose=0)
    model.learn(10, callback=callback)
    assert callback.best_mean_reward == 1.0


def test_evaluation_in_training_with_normalisation(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: Monitor(CountingEnv())] * 2))
    eval_env = VecNormalize(DummyVecEnv([lambda: Monitor(CountingEnv(), info_keywords=("cost",))]), training=False)
    after = CountCalls()
    callback = CostEvalCallback(
        eval_env, cost_limit=2.0, eval_freq=10, n_eval_episodes=2, log_path=str(tmp_path), callback_after_eval=after
    )
    make_model(env).learn(40, callback=callback)  # type: ignore[arg-type]
    assert callback.evaluations_costs == [[2.0, 2.0]] * 2
    assert after.n_calls == 2
    assert "Episode cost: 2.00 +/- 0.00" in capsys.readouterr().out


def test_evaluation_can_stop_training(monkeypatch: pytest.MonkeyPatch) -> None:
    evaluate_like(monkeypatch, [(1.0, 0.0)] * 9)
    stop = CountCalls()
    monkeypatch.setattr(stop, "_on_step", lambda: False)
    callback = CostEvalCallback(DummyVecEnv([CountingEnv]), eval_freq=5, verbose=0, callback_after_eval=stop)
    model = make_model()
    model.learn(40, callback=callback)
    assert model.num_timesteps == 5
