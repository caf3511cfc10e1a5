"""Steps per second of the scenarios, images included, beside stock highway-env: ``python benchmark/scenario_speed.py``."""

import argparse
import time

import gymnasium as gym
import highway_env  # noqa: F401  (registers the stock environments)
import numpy as np

import sb3_esad.envs  # noqa: F401  (registers ours)
from sb3_esad.envs.scenario import scenario_of

SITUATIONS = ("highway", "traffic-negotiation", "obstacle-avoidance", "braking")
TOWNS = ("town03", "town04", "town06", "town07", "town10")
ROADS = [f"esad-{name}-v0" for name in (*SITUATIONS, *TOWNS)]


def stock(vehicles: int) -> gym.Env:
    """
    Build highway-fast-v0 with continuous actions at 5 Hz and an image of 64x64 pixels.

    :param vehicles: number of vehicles besides the agent's
    :return: the environment
    """
    image = {"type": "GrayscaleObservation", "observation_shape": (64, 64), "stack_size": 1, "weights": [0.2989, 0.587, 0.114]}
    config = {
        "observation": {**image, "scaling": 1.75},
        "action": {"type": "ContinuousAction"},
        "vehicles_count": vehicles,
        "policy_frequency": 5,
        "simulation_frequency": 10,
        "duration": 40,
        "offroad_terminal": False,
    }
    return gym.make("highway-fast-v0", config=config)


def rate(env: gym.Env, steps: int) -> float:
    """
    Drive straight on.

    :param env: environment to step
    :param steps: how many
    :return: steps per second
    """
    env.reset(seed=0)
    begin = time.perf_counter()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(np.zeros(2, dtype=np.float32))
        if terminated or truncated:
            env.reset()
    return steps / (time.perf_counter() - begin)


def compare(env_id: str, repeats: int, steps: int) -> None:
    """
    Alternate a scenario and the stock environment with as many vehicles, print medians and their ratio.

    :param env_id: scenario
    :param repeats: how often
    :param steps: each time
    """
    ours = gym.make(env_id)
    ours.reset(seed=0)
    vehicles = len(scenario_of(ours).traffic.speed) - 1
    rivals: tuple[gym.Env, gym.Env] = (ours, stock(vehicles))
    rates: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeats):
        for env, values in zip(rivals, rates, strict=True):
            values.append(rate(env, steps))
    own, other = np.median(rates[0]), np.median(rates[1])
    spread = f"from {min(rates[0]):.0f} to {max(rates[0]):.0f}"
    print(
        f"{env_id:30s} {own:5.0f} steps/s ({spread}), stock {other:4.0f}, ratio {own / other:4.1f}, {vehicles} others",
        flush=True,
    )


def main() -> None:
    """Compare every scenario that has roads."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--steps", type=int, default=200)
    parser.add_argument("--envs", nargs="+", default=ROADS)
    args = parser.parse_args()
    for env_id in args.envs:
        compare(env_id, args.repeats, args.steps)


if __name__ == "__main__":
    main()
