"""Memory over a training, and time per step beside networks and simulator: ``python benchmark/overhead.py``."""

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad import ESADLEND
from sb3_esad.common.agent import LatentAgent
from sb3_esad.common.callbacks import CostEvalCallback
from sb3_esad.common.critics import CostCritic
from sb3_esad.common.type_aliases import Belief, LatentState
from sb3_esad.progress import EpisodeHistory
from sb3_esad.watching import WatchCallback

ENV_ID = "esad-highway-vector-v0"
SMALL = {"net_arch": [32], "memory_channels": 32, "latent_channels": 8}
SPACES: dict[str, gym.spaces.Box] = {
    "MlpPolicy": gym.spaces.Box(-1, 1, (32,), np.float32),
    "CnnPolicy": gym.spaces.Box(0, 255, (3, 64, 64), np.uint8),
}
EPISODE = 150


class Memory(BaseCallback):
    """
    Measures, every so often, the memory of this process.

    :param every: environment steps between two samples
    """

    def __init__(self, every: int) -> None:
        super().__init__()
        self.every = every
        self.samples: list[tuple[int, float]] = []

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            pages = int(Path("/proc/self/statm").read_text().split()[1])
            self.samples.append((self.num_timesteps, pages * os.sysconf("SC_PAGE_SIZE") / 2**20))
            print(f"{self.num_timesteps:7d} steps  {self.samples[-1][1]:7.1f} MiB", flush=True)
        return True


class NoSimulator(gym.Env[Any, Any]):
    """
    Shows prepared observations in turn and does nothing else.

    :param space: of the observations
    """

    action_space = gym.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, space: gym.spaces.Box) -> None:
        self.observation_space = space
        self._observations = [space.sample() for _ in range(16)]
        self._count = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode, see gymnasium."""
        return self._observations[0], {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Make a step, see gymnasium."""
        self._count += 1
        return self._observations[self._count % 16], 1.0, False, self._count % EPISODE == 0, {"cost": 0.0}


@contextmanager
def no_networks() -> Iterator[None]:
    """Let the networks of both algorithms answer at once, always the same."""
    state = LatentState(th.zeros(1, 8, 1, 1), th.zeros(1, 8, 1, 1), th.zeros(1, 2))
    action, costs = th.zeros(1, 2), (th.zeros(2, 1), th.zeros(2, 1))
    with ExitStack() as stack:
        stack.enter_context(patch.object(LatentAgent, "observe", lambda *_: Belief(state, action)))
        stack.enter_context(patch.object(LatentAgent, "act", lambda *_: action))
        stack.enter_context(patch.object(CostCritic, "forward", lambda *_: costs))
        stack.enter_context(patch("stable_baselines3.sac.policies.SACPolicy._predict", lambda *_, **__: action))
        yield


def step_time(model: OffPolicyAlgorithm, steps: int) -> float:
    """
    Collect steps without learning from them.

    :param model: algorithm whose warm-up is over
    :param steps: how many
    :return: processor time of one of them [s]
    """
    model.set_logger(configure(None, []))
    model.learn(200)
    model._n_updates = 1  # from then on the cost critics are asked about every step
    start = time.process_time()
    model.learn(steps, reset_num_timesteps=False)
    return (time.process_time() - start) / steps


def measure_steps(steps: int, repeats: int) -> None:
    """
    Compare steps of collecting with those of SB3's SAC, where networks and simulator cost nothing for both.

    :param steps: of each measurement
    :param repeats: of which the best counts
    """
    for policy, space in SPACES.items():
        best = {}
        for name, algorithm in (("ESAD-LEND", ESADLEND), ("SAC", SAC)):
            times = []
            for _ in range(repeats):
                settings: dict[str, Any] = {"learning_starts": 0, "buffer_size": 2000, "gradient_steps": 0, "device": "cpu"}
                model = algorithm(policy, Monitor(NoSimulator(space)), **settings)
                with no_networks():
                    times.append(1e3 * step_time(model, steps))
            best[name] = min(times)
        total, stock = best.values()
        print(f"{policy}: {total:.3f} ms a step, SAC's {stock:.3f}; of ours {total - stock:.3f} ms", flush=True)


def measure_memory(steps: int, every: int) -> None:
    """
    Train with a small buffer and all that is usually switched on, and print what the process occupies.

    :param steps: of the training
    :param every: steps between two samples
    """
    arguments: dict[str, Any] = {"policy_kwargs": SMALL, "batch_size": 4, "imagination_starts": 8, "train_freq": 16}
    model = ESADLEND("MlpPolicy", ENV_ID, buffer_size=2000, learning_starts=1000, pretrain_steps=10, **arguments)
    memory = Memory(every)
    with tempfile.TemporaryDirectory() as folder:
        model.set_logger(configure(folder, ["csv", "tensorboard"]))
        evaluation = CostEvalCallback(
            Monitor(gym.make(ENV_ID)),
            eval_freq=2000,
            n_eval_episodes=2,
            log_path=folder,
            best_model_save_path=folder,
            verbose=0,
        )
        model.learn(steps, callback=[memory, EpisodeHistory(), evaluation, WatchCallback(every=1000)])
    half = [size for step, size in memory.samples if step > steps // 2]
    growth = np.polyfit(np.arange(len(half)), half, 1)[0] / every * 1000
    print(f"second half: {min(half):.1f} to {max(half):.1f} MiB, {1024 * growth:+.0f} KiB in 1,000 steps")


def main() -> None:
    """Measure time, then memory."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--memory-steps", type=int, default=20_000, help="0 for times only")
    parser.add_argument("--every", type=int, default=1000)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    th.set_num_threads(1)
    measure_steps(args.steps, args.repeats)
    if args.memory_steps:
        measure_memory(args.memory_steps, args.every)


if __name__ == "__main__":
    main()
