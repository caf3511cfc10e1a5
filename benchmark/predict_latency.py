"""
How long ``predict`` takes on one thread, with and without the filter: ``python benchmark/predict_latency.py``.

The filter imagines one action where that is admissible and five where it is not. Untrained critics fear everything, so that
each action is replaced, which takes longest. With ``--model`` a trained policy tells how long it usually takes.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from sb3_esad import ESADLEND
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.selection import SafetyFilter

ENV_ID = "esad-highway-v0"
ARMS = {"without filter": None, "8 scenarios, 16 proposals, 3 steps": 0}
"""When the filter starts."""
SIZES: dict[str, Any] = {"n_candidates": 8, "n_proposals": 16, "barrier_steps": 3}


class TrustedCritics(AugmentedLagrangian):
    """A budget for critics that are found calibrated whatever they expect, so that the filter is at work."""

    calibrated = True


def load(path: Path | None, filter_start: int | None) -> ESADLEND:
    """
    Give the driver.

    :param path: of a trained model, None for an untrained one
    :param filter_start: when the filter starts, None for never
    :return: the driver; its filter, if it has one, is at work
    """
    if path is None:
        env = gym.make(ENV_ID)
        model = ESADLEND("CnnPolicy", env, buffer_size=1000, seed=0, filter_start=filter_start, **SIZES)
    else:
        model = ESADLEND.load(path, device="cpu", filter_start=filter_start, **SIZES)
    if isinstance(model.policy.action_filter, SafetyFilter):
        model.policy.action_filter.penalty = TrustedCritics(cost_limit=0.05)
    return model


def require_limit(parser: argparse.ArgumentParser, path: Path, model: ESADLEND) -> None:
    """
    Refuse a model that has nothing to filter by.

    :param parser: tells of it
    :param path: of the model
    :param model: as loaded
    """
    if model.cost_limit is None:
        parser.error(f"{path} has no cost limit and hence no filter: choose a model that was trained with a limit")


def times(model: ESADLEND, steps: int) -> np.ndarray:
    """
    Drive.

    :param model: decides
    :param steps: decisions
    :return: what each takes [ms]
    """
    env = gym.make(ENV_ID)
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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="trained on the same scenario (default: an untrained one)")
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()
    th.set_num_threads(1)
    if args.model is not None:
        require_limit(parser, args.model, ESADLEND.load(args.model, device="cpu"))
    for name, filter_start in ARMS.items():
        warm = times(load(args.model, filter_start), args.steps)
        print(
            f"predict, {name}: median {np.median(warm):.2f} ms, 99th percentile {np.percentile(warm, 99):.2f} ms", flush=True
        )


if __name__ == "__main__":
    main()
