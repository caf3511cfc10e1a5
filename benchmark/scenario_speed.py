"""Steps per second of the scenarios, images included, beside stock highway-env: ``python benchmark/scenario_speed.py``."""

import argparse
import time
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the stock environments)
import numpy as np

import sb3_esad.envs  # noqa: F401  (registers ours)
from sb3_esad.envs.scenario import Scenario, scenario_of

JUNCTION = "esad-traffic-negotiation-v0"
OTHERS = ("highway", "obstacle-avoidance", "braking", "town03", "town04", "town06", "town07", "town10")
ROADS = [*(f"esad-{name}-v0" for name in OTHERS), JUNCTION]  # last, for intersection-v1 changes stock's cars for all others
COURSES = [f"esad-course{walkers}-v0" for walkers in ("", "-1mps", "-2mps", "-3mps")]
STRAIGHT_ON = np.zeros(2, dtype=np.float32)
RESETS = 50
IMAGE = {"type": "GrayscaleObservation", "observation_shape": (64, 64), "stack_size": 1, "weights": [0.2989, 0.587, 0.114]}
SHARED = {
    "observation": {**IMAGE, "scaling": 1.75},
    "action": {"type": "ContinuousAction"},
    "policy_frequency": 5,
    "simulation_frequency": 10,
    "duration": 40,
}
"""Of every stock environment, as ours have it: an image of 64x64 pixels, decisions at 5 Hz, physics at 10 Hz."""


def rival(env_id: str, scenario: Scenario) -> tuple[str, gym.Env[Any, Any]]:
    """
    Make the stock environment that is most like a scenario, with as many vehicles and lanes as it has now.

    For the junction that is ``intersection-v1``; it has a few vehicles less, for who has crossed leaves. For all others it is
    ``highway-fast-v0``, which is made for speed: nobody leaves, and only the agent can crash. Stock roundabouts take no
    continuous actions, and the stock junction has no room for as many vehicles as a town.

    :param env_id: of the scenario
    :param scenario: just reset
    :return: its id, and the environment
    """
    drivers = len(scenario.traffic.drivers)
    if env_id == JUNCTION:
        name, config = "intersection-v1", {"initial_vehicle_count": drivers, "spawn_probability": 1.0}
    else:
        name, config = "highway-fast-v0", {"vehicles_count": drivers, "lanes_count": getattr(scenario, "lanes", 3)}
    return name, gym.make(name, config={**SHARED, **config}, disable_env_checker=True)


def vehicles(env: gym.Env[Any, Any]) -> int:
    """
    Count those that drive themselves.

    :param env: a scenario or a stock environment
    :return: how many there are now
    """
    scene: Any = env.unwrapped
    return len(scene.traffic.drivers) if isinstance(scene, Scenario) else len(scene.road.vehicles) - 1


def drive(env: gym.Env[Any, Any], seed: int, steps: int) -> tuple[float, float]:
    """
    Drive straight on, from the same start again when an episode ends; resets are not timed.

    :param env: environment to step
    :param seed: of all episodes
    :param steps: how many
    :return: processor time of a step [s], and how many vehicles there were on average
    """
    env.reset(seed=seed)
    total, count = 0.0, 0
    for _ in range(steps):
        begin = time.process_time()
        _, _, terminated, truncated, _ = env.step(STRAIGHT_ON)
        total += time.process_time() - begin
        count += vehicles(env)
        if terminated or truncated:
            env.reset(seed=seed)
    return total / steps, count / steps


def reset_time(env: gym.Env[Any, Any], seed: int) -> float:
    """
    Draw an episode.

    :param env: environment to reset
    :param seed: of the episode
    :return: processor time [s]
    """
    begin = time.process_time()
    env.reset(seed=seed)
    return time.process_time() - begin


def compare(env_id: str, episodes: int, repeats: int, steps: int) -> None:
    """
    Alternate a scenario and its rival, take the best time of each in each episode, and print what these give.

    :param env_id: scenario
    :param episodes: how many starts, each with as many vehicles for both
    :param repeats: of each of them
    :param steps: each time
    """
    ours, best = gym.make(env_id), []
    for seed in range(episodes):
        ours.reset(seed=seed)
        name, stock = rival(env_id, scenario_of(ours))
        best.append(np.min([[drive(env, seed, steps) for env in (ours, stock)] for _ in range(repeats)], axis=0))
    (own, crowd), (other, stock_crowd) = np.mean(best, axis=0)
    ratios = [each[1, 0] / each[0, 0] for each in best]
    reset = np.median([reset_time(ours, seed) for seed in range(RESETS)])
    print(
        f"{env_id:28s}{1 / own:5.0f} steps/s with {crowd:4.1f} vehicles, {name:16s}{1 / other:4.0f} with {stock_crowd:4.1f};",
        f"ratio {other / own:4.1f}, of episodes {min(ratios):4.1f} to {max(ratios):4.1f}; reset {1000 * reset:3.1f} ms",
        flush=True,
    )


def alone(env_id: str, episodes: int, repeats: int, steps: int) -> None:
    """
    Time a scenario that is like nothing in stock.

    :param env_id: scenario
    :param episodes: how many starts
    :param repeats: of each of them
    :param steps: each time
    """
    env = gym.make(env_id)
    best = [min(drive(env, seed, steps)[0] for _ in range(repeats)) for seed in range(episodes)]
    reset = np.median([reset_time(env, seed) for seed in range(RESETS)])
    print(f"{env_id:28s}{1 / np.mean(best):5.0f} steps/s; reset {1000 * reset:3.1f} ms", flush=True)


def main() -> None:
    """Compare every scenario that has roads, and time the others."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--envs", nargs="+", default=[*COURSES, *ROADS])
    args = parser.parse_args()
    for env_id in args.envs:
        measure = alone if env_id in COURSES else compare
        measure(env_id, args.episodes, args.repeats, args.steps)


if __name__ == "__main__":
    main()
