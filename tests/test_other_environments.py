"""Environments that are not ours: highway-env's own, and those that return six values."""

from typing import Any

import gymnasium as gym
import highway_env
import numpy as np
import pytest

from sb3_esad import ESADLEND
from sb3_esad.common.six_values import CostFromSixValues
from sb3_esad.envs.metrics import DrivingMetrics, summarise
from tests.conftest import TINY, CountingEnv

gym.register_envs(highway_env)


def stock(name: str = "highway-fast-v0", **config: Any) -> gym.Env:
    return gym.make(name, config={"action": {"type": "ContinuousAction"}, "policy_frequency": 5, "duration": 8, **config})


def drive(env: gym.Env, action: list[float], seed: int = 0) -> dict[str, float]:
    """The record of one episode with a constant action."""
    metrics = DrivingMetrics(env)
    metrics.reset(seed=seed)
    done = False
    while not done:
        _, _, terminated, truncated, _ = metrics.step(np.array(action, dtype=np.float32))
        done = terminated or truncated
    return metrics.records[0]


def test_alone_at_constant_speed() -> None:
    env = stock(vehicles_count=0)
    record = drive(env, [0.0, 0.0])
    vehicle = env.unwrapped.vehicle  # type: ignore[attr-defined]
    assert record["duration"] == pytest.approx(8.0)
    assert record["distance"] == pytest.approx(vehicle.speed * 8.0, rel=1e-6)
    assert record["route_completion"] == pytest.approx(record["distance"] / (8.0 * vehicle.lane.speed_limit))
    assert (record["success"], record["collisions"]) == (1.0, 0.0)
    assert record["min_ttc"] == 20.0


def test_off_the_road_counts_once_and_stops_the_completion() -> None:
    record = drive(stock(vehicles_count=0, offroad_terminal=False, duration=3), [0.0, 0.2])
    assert record["infractions_static"] == 1.0
    assert record["route_completion"] < 0.5
    assert record["success"] == 0.0


def test_a_crash_is_one_with_a_vehicle() -> None:
    for seed in range(10):
        record = drive(stock(vehicles_count=30, duration=30, vehicles_density=2), [1.0, 0.0], seed)
        if record["infractions_vehicle"]:
            break
    assert record["collisions"] == record["cost"] == 1.0
    assert record["infraction_score"] == 0.6
    assert record["min_ttc"] < 1.0
    assert summarise([record])["collision_free"] == 0.0


STOCK = sorted(spec.id for spec in gym.registry.values() if str(spec.entry_point).startswith("highway_env."))


@pytest.mark.filterwarnings("ignore:.*out of date")
@pytest.mark.parametrize("name", [name for name in STOCK if "multi-agent" not in name])
def test_every_stock_environment_has_a_record_or_a_reason(name: str) -> None:
    env = gym.make(name)
    if "duration" not in env.unwrapped.config:  # type: ignore[attr-defined]
        with pytest.raises(ValueError, match="has no 'duration' in its configuration"):
            DrivingMetrics(env)
        return
    metrics = DrivingMetrics(env)
    metrics.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(10):
        _, _, terminated, truncated, _ = metrics.step(env.action_space.sample())
        if terminated or truncated:
            break
    record = metrics.env.episode.record(success=False)  # type: ignore[attr-defined]
    assert record["steps"] >= 1.0 and 0.0 <= record["route_completion"] <= 1.0 and record["min_ttc"] >= 0.0


def test_who_arrives_has_done_it_all() -> None:
    """Ends of an episode before its time, on the road and without a crash."""
    env = stock(vehicles_count=0)
    env.unwrapped._is_terminated = lambda: env.unwrapped.time >= 2  # type: ignore[attr-defined]
    record = drive(env, [0.0, 0.0])
    assert (record["success"], record["route_completion"]) == (1.0, 1.0)


class SixValues(CountingEnv):
    """Counts in Safety-Gymnasium's convention, its costs up to 4."""

    def step(self, action: np.ndarray) -> Any:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, 4.0 * info.pop("cost"), terminated, truncated, info


def test_six_values_are_learned_from() -> None:
    env = CostFromSixValues(SixValues(), max_cost=4.0)
    env.reset()
    costs = [env.step(np.zeros(1, dtype=np.float32))[4]["cost"] for _ in range(6)]
    assert costs == [0.0, 0.0, 1.0, 0.0, 0.0, 1.0]
    assert ESADLEND("MlpPolicy", CostFromSixValues(SixValues(), max_cost=4.0), **TINY).learn(28).total_cost == 8.0


def test_five_values_are_refused() -> None:
    env = CostFromSixValues(CountingEnv())
    env.reset()
    with pytest.raises(ValueError, match="returned 5 values instead of six; use it without this wrapper"):
        env.step(np.zeros(1, dtype=np.float32))
    with pytest.raises(ValueError, match="max_cost is 0; choose a number above 0"):
        CostFromSixValues(CountingEnv(), max_cost=0)
