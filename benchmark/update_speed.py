"""How long an update takes, with diffusion too, beside one of SB3's SAC on as many frames: ``update_speed.py``."""

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad import ESADLEND
from sb3_esad.common.diffusion import DiffusionHead

BATCH, LENGTH = 16, 32
ROUND = 8
"""Updates in one call, as in hyperparams/esad_lend.yml: they overlap within it; SAC's do not."""


def prepared(model: OffPolicyAlgorithm, steps: int) -> OffPolicyAlgorithm:
    """
    Fill the replay buffer with random steps, without an update.

    :param model: algorithm that starts to learn after ``steps``
    :param steps: environment steps
    :return: the model
    """
    model.set_logger(configure(None, []))
    return model.learn(steps)


def esad_lend(env_id: str, steps: int, diffusion_steps: int) -> ESADLEND:
    """
    Build ESAD-LEND, its refined latents in use if there are any.

    :param env_id: scenario
    :param steps: before it learns
    :param diffusion_steps: K
    :return: the algorithm
    """
    arguments: dict[str, Any] = {"batch_size": BATCH, "sequence_length": LENGTH, "pretrain_steps": 0, "learning_starts": steps}
    model = ESADLEND("CnnPolicy", env_id, policy_kwargs={"head_kwargs": {"diffusion_steps": diffusion_steps}}, **arguments)
    head = model.policy.world_model.rssm.head
    if isinstance(head, DiffusionHead):
        head.advantage.fill_(100.0)  # its gate, which an average of some hundred updates moves, stays open
    return model


def seconds(train: Callable[[int, int], None], batch_size: int) -> float:
    """
    Time one update, as a part of a round of them.

    :param train: does a number of updates on batches of a size
    :param batch_size: windows or frames
    :return: wall-clock of one update [s]
    """
    start = time.perf_counter()
    train(ROUND, batch_size)
    return (time.perf_counter() - start) / ROUND


def main() -> None:
    """Alternate updates of both, print medians and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=5, help=f"rounds of {ROUND} updates")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    env, steps = "esad-highway-v0", 600
    sac = prepared(SAC("CnnPolicy", env, learning_starts=steps, buffer_size=2000, batch_size=BATCH * LENGTH), steps)
    ours = {f"ESAD-LEND, K = {k}": (prepared(esad_lend(env, steps, k), steps).train, BATCH) for k in (0, 2)}
    rivals = {"SAC": (sac.train, BATCH * LENGTH), **ours}
    for train, batch_size in rivals.values():
        train(1, batch_size)  # the first call allocates
    times: dict[str, list[float]] = {name: [] for name in rivals}
    for _ in range(args.repeats):
        for name, rival in rivals.items():
            times[name].append(seconds(*rival))
    medians = {name: float(np.median(values)) for name, values in times.items()}
    for name, values in times.items():
        ratio = medians[name] / medians["SAC"]
        print(f"{name:16s} median {medians[name]:.3f} s, from {min(values):.3f} to {max(values):.3f} s, {ratio:.2f} of SAC's")
    print(f"({BATCH} windows of {LENGTH} images, {args.threads} threads)")


if __name__ == "__main__":
    main()
