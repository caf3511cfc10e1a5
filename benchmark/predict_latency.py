"""How long ``predict`` takes on one thread, with and without the filter: ``python benchmark/predict_latency.py``."""

import argparse
import time

import gymnasium as gym
import numpy as np
import torch as th

from sb3_esad import ESADLEND
from sb3_esad.common.selection import SafetyFilter

ARMS = {"without filter": None, "8 scenarios, 16 proposals, 3 steps": 0}
"""When the filter starts."""


def times(filter_start: int | None, steps: int) -> np.ndarray:
    """
    Drive with an untrained policy.

    :param filter_start: when the filter starts, None for never
    :param steps: decisions
    :return: what each takes [ms]
    """
    env = gym.make("esad-highway-v0")
    model = ESADLEND("CnnPolicy", env, buffer_size=1000, filter_start=filter_start, barrier_steps=3, seed=0)
    if isinstance(model.policy.action_filter, SafetyFilter):
        # An untrained critic fears everything: each action is replaced, which takes longest
        model.policy.action_filter.is_active = lambda: True
    observation, state, start, taken = env.reset(seed=0)[0], None, np.array([True]), []
    for _ in range(steps):
        begin = time.perf_counter()
        action, state = model.predict(observation, state, start, deterministic=True)
        taken.append(1e3 * (time.perf_counter() - begin))
        observation, _, terminated, truncated, _ = env.step(action)
        start = np.array([terminated or truncated])
        if start[0]:
            observation, _ = env.reset()
    return np.array(taken[50:])


def main() -> None:
    """Print the median and the 99th percentile of both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()
    th.set_num_threads(1)
    for name, filter_start in ARMS.items():
        warm = times(filter_start, args.steps)
        print(
            f"predict, {name}: median {np.median(warm):.2f} ms, 99th percentile {np.percentile(warm, 99):.2f} ms", flush=True
        )


if __name__ == "__main__":
    main()
