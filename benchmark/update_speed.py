"""How long a gradient update takes, beside one of SB3's SAC on as many frames: ``python benchmark/update_speed.py``."""

import argparse
import time
from collections.abc import Callable

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad import ESADLEND

BATCH, LENGTH = 16, 32


def prepared(model: OffPolicyAlgorithm, steps: int) -> OffPolicyAlgorithm:
    """
    Fill the replay buffer with random steps, without an update.

    :param model: algorithm that starts to learn after ``steps``
    :param steps: environment steps
    :return: the model
    """
    model.set_logger(configure(None, []))
    return model.learn(steps)


def seconds(update: Callable[[], None]) -> float:
    """
    Time one call.

    :param update: what to time
    :return: wall-clock [s]
    """
    start = time.perf_counter()
    update()
    return time.perf_counter() - start


def main() -> None:
    """Alternate updates of both, print medians and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=10)
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    env, steps = "esad-highway-v0", 600
    ours = prepared(
        ESADLEND("CnnPolicy", env, learning_starts=steps, batch_size=BATCH, sequence_length=LENGTH, pretrain_steps=0), steps
    )
    sac = prepared(SAC("CnnPolicy", env, learning_starts=steps, buffer_size=2000, batch_size=BATCH * LENGTH), steps)
    updates = {"ESAD-LEND": lambda: ours.train(1, BATCH), "SAC": lambda: sac.train(1, BATCH * LENGTH)}
    for update in updates.values():
        update()  # the first call allocates
    times: dict[str, list[float]] = {name: [] for name in updates}
    for _ in range(args.repeats):
        for name, update in updates.items():
            times[name].append(seconds(update))
    medians = {name: float(np.median(values)) for name, values in times.items()}
    for name, values in times.items():
        print(f"{name:10s} median {medians[name]:.3f} s, from {min(values):.3f} to {max(values):.3f} s")
    print(f"ratio {medians['ESAD-LEND'] / medians['SAC']:.2f} ({BATCH} windows of {LENGTH} images, {args.threads} threads)")


if __name__ == "__main__":
    main()
