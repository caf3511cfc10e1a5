"""Steps per second of esad-highway-v0 beside stock highway-env: ``python benchmark/scenario_speed.py``."""

import argparse
import time

import gymnasium as gym
import highway_env  # noqa: F401  (registers the stock environments)
import numpy as np

import sb3_esad.envs  # noqa: F401  (registers ours)
from sb3_esad.envs.scenario import scenario_of


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


def main() -> None:
    """Alternate both, print medians and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--steps", type=int, default=300)
    args = parser.parse_args()
    ours = gym.make("esad-highway-v0")
    ours.reset(seed=0)
    vehicles = len(scenario_of(ours).traffic.speed) - 1
    envs = {"esad-highway-v0": ours, "highway-fast-v0": stock(vehicles)}
    rates: dict[str, list[float]] = {name: [] for name in envs}
    for _ in range(args.repeats):
        for name, env in envs.items():
            rates[name].append(rate(env, args.steps))
    for name, values in rates.items():
        print(f"{name:16s} median {np.median(values):.0f} steps/s, from {min(values):.0f} to {max(values):.0f}")
    print(
        f"ratio {np.median(rates['esad-highway-v0']) / np.median(rates['highway-fast-v0']):.1f} ({vehicles} vehicles, images)"
    )


if __name__ == "__main__":
    main()
