"""Steps per second of the scenarios, images included, beside stock highway-env: ``python benchmark/scenario_speed.py``."""

import argparse
import time
from typing import Any

import gymnasium as gym
import highway_env  # noqa: F401  (registers the stock environments)
import numpy as np

import sb3_esad.envs  # noqa: F401  (registers ours)
from sb3_esad.envs.scenario import Scenario, scenario_of

SITUATIONS = ("highway", "traffic-negotiation", "obstacle-avoidance", "braking")
TOWNS = ("town03", "town04", "town06", "town07", "town10")
ROADS = [f"esad-{name}-v0" for name in (*SITUATIONS, *TOWNS)]
STRAIGHT_ON = np.zeros(2, dtype=np.float32)
IMAGE = {"type": "GrayscaleObservation", "observation_shape": (64, 64), "stack_size": 1, "weights": [0.2989, 0.587, 0.114]}
SHARED = {
    "observation": {**IMAGE, "scaling": 1.75},
    "action": {"type": "ContinuousAction"},
    "policy_frequency": 5,
    "simulation_frequency": 10,
    "duration": 40,
}
"""Of every stock environment, as ours have it: an image of 64x64 pixels, decisions at 5 Hz, physics at 10 Hz."""


def rival(scenario: Scenario) -> gym.Env[Any, Any]:
    """
    Make the stock environment that is most like a scenario, with as many vehicles and lanes as it has now.

    That is ``highway-fast-v0``, the fastest of all, where cars never leave and may hit the agent only; and for a junction
    ``intersection-v1``, which has at most about as many vehicles, for those that have crossed leave. No stock environment holds as
    many vehicles between junctions as our towns do.

    :param scenario: just reset
    :return: the environment
    """
    drivers = len(scenario.traffic.drivers)
    if scenario.spec is not None and "negotiation" in scenario.spec.id:
        config = {"initial_vehicle_count": drivers, "spawn_probability": 1.0}
        return gym.make("intersection-v1", config={**SHARED, **config}, disable_env_checker=True)
    config = {"vehicles_count": drivers, "lanes_count": getattr(scenario, "lanes", 3)}
    return gym.make("highway-fast-v0", config={**SHARED, **config}, disable_env_checker=True)


def step_time(env: gym.Env[Any, Any], seed: int, steps: int) -> float:
    """
    Drive straight on, from the same start again when an episode ends; resets are not timed.

    :param env: environment to step
    :param seed: of all episodes
    :param steps: how many
    :return: processor time of a step [s]
    """
    env.reset(seed=seed)
    total = 0.0
    for _ in range(steps):
        begin = time.process_time()
        _, _, terminated, truncated, _ = env.step(STRAIGHT_ON)
        total += time.process_time() - begin
        if terminated or truncated:
            env.reset(seed=seed)
    return total / steps


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
    ours, times, vehicles = gym.make(env_id), [], []
    for seed in range(episodes):
        ours.reset(seed=seed)
        vehicles.append(len(scenario_of(ours).traffic.drivers))
        pair = (ours, rival(scenario_of(ours)))
        times.append(np.min([[step_time(env, seed, steps) for env in pair] for _ in range(repeats)], axis=0))
    own, other = np.mean(times, axis=0)
    ratios = [second / first for first, second in times]
    reset = np.median([reset_time(ours, seed) for seed in range(30)])
    print(
        f"{env_id:30s} {1 / own:5.0f} steps/s, {pair[1].spec.id:16s} {1 / other:4.0f}, ratio {other / own:4.1f} (from {min(ratios):4.1f} "
        f"to {max(ratios):4.1f}), {np.mean(vehicles):4.1f} vehicles, reset {1000 * reset:4.1f} ms",
        flush=True,
    )


def main() -> None:
    """Compare every scenario that has roads."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--episodes", type=int, default=6)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--envs", nargs="+", default=ROADS)
    args = parser.parse_args()
    for env_id in args.envs:
        compare(env_id, args.episodes, args.repeats, args.steps)


if __name__ == "__main__":
    main()
