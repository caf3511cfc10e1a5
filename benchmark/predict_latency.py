"""How long ``predict`` takes for one environment on one thread: ``python benchmark/predict_latency.py``."""

import argparse
import time

import gymnasium as gym
import numpy as np
import torch as th

from sb3_esad import ESADLEND


def main() -> None:
    """Drive with an untrained policy, print the median and the 99th percentile."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()
    th.set_num_threads(1)
    env = gym.make("esad-highway-v0")
    model = ESADLEND("CnnPolicy", env, buffer_size=1000, seed=0)
    observation, state, start, times = env.reset(seed=0)[0], None, np.array([True]), []
    for _ in range(args.steps):
        begin = time.perf_counter()
        action, state = model.predict(observation, state, start, deterministic=True)
        times.append(1e3 * (time.perf_counter() - begin))
        observation, _, terminated, truncated, _ = env.step(action)
        start = np.array([terminated or truncated])
        if start[0]:
            observation, _ = env.reset()
    warm = times[50:]
    print(f"predict: median {np.median(warm):.2f} ms, 99th percentile {np.percentile(warm, 99):.2f} ms ({len(warm)} calls)")


if __name__ == "__main__":
    main()
