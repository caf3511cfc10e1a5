"""
Whether diffusion foresees more than a Gaussian, experiment E0: ``python benchmark/diffusion.py --seeds 0 1 2``.

Recorded steps of a scenario, some minutes of training of the world model alone; then, on other episodes, the same model with
and without refined latents, from the same states: energy score of the latent 1, 5 and 10 steps ahead, Brier score of a cost
within 5 and 10 steps (lower is better), and what an imagined step takes. No step is foreseen twice, and intervals are over
means of 512 consecutive steps. The energy score is that of a cell of the latent, for of all cells at once it would hardly see
several modes.
"""

import argparse
import time
from collections.abc import Iterator
from itertools import islice, product
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from world_model import Step, add_steps, fit, record, steps

from sb3_esad import ESADLEND
from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.diffusion import DiffusionHead
from sb3_esad.common.precision import autocast
from sb3_esad.common.rssm import Filtered
from sb3_esad.common.type_aliases import LatentState, SequenceSamples
from sb3_esad.common.world_model import WorldModel
from sb3_esad.envs.intervals import mean_interval

AHEAD, STARTS = (1, 5, 10), (7, 19)
N_SAMPLES, LENGTH, BATCH = 16, 32, 16
SCORES = tuple(f"energy score {ahead} ahead" for ahead in AHEAD) + tuple(f"Brier score within {ahead}" for ahead in AHEAD[1:])
Windows = list[tuple[SequenceSamples, Filtered]]


def stretches(env: gym.Env[Any, Any], driven: Iterator[Step], n_steps: int, length: int = LENGTH) -> Iterator[SequenceSamples]:
    """
    Cut what is driven into windows one after the other.

    :param env: scenario
    :param driven: steps in it
    :param n_steps: about how many of them
    :param length: steps of a window
    :return: batches of ``BATCH`` windows, none of which overlap
    """
    spaces, batch = (env.observation_space, env.action_space), []
    window = SequenceReplayBuffer(length, *spaces, sequence_length=length, event_fraction=0.0)
    for _ in range(n_steps // length):
        add_steps(window, islice(driven, length))
        batch.append(window.sample(1))
        if len(batch) == BATCH:
            yield SequenceSamples(*map(th.cat, zip(*batch, strict=True)))
            batch = []


def energy_score(samples: th.Tensor, truth: th.Tensor) -> th.Tensor:
    """
    Proper score of a forecast by samples (Gneiting & Raftery 2007): E|X - y| - E|X - X'| / 2.

    :param samples: of the forecast, of shape (S, N, D)
    :param truth: what came, of shape (N, D)
    :return: shape (N,)
    """
    apart = th.cdist(samples.transpose(0, 1), samples.transpose(0, 1)).sum((1, 2)) / (len(samples) * (len(samples) - 1))
    return (samples - truth).norm(dim=-1).mean(0) - apart / 2


def repeat(state: LatentState) -> LatentState:
    """
    Copy states as often as samples are drawn.

    :param state: N states
    :return: ``N_SAMPLES`` * N states
    """
    return state.map(lambda field: field.repeat(N_SAMPLES, *[1] * (field.dim() - 1)))


def energy_by_cell(samples: th.Tensor, truth: th.Tensor) -> th.Tensor:
    """
    Average the energy score over the cells of a grid, for in hundreds of dimensions it hardly sees several modes.

    :param samples: of the forecast, of shape (S * N, C, H, W)
    :param truth: what came, of shape (N, C, H, W)
    :return: shape (N,)
    """
    n, size = truth.shape[:2]
    cells = samples.flatten(2).transpose(1, 2).reshape(len(samples) // n, -1, size)
    return energy_score(cells, truth.flatten(2).transpose(1, 2).reshape(-1, size)).view(n, -1).mean(1)


def scores(model: WorldModel, samples: SequenceSamples, filtered: Filtered, start: int) -> th.Tensor:
    """
    Go on without observations from one step of each window, and compare with what came.

    :param model: trained model
    :param samples: windows of recorded steps
    :param filtered: their states
    :param start: step after which the model is blind
    :return: a row for each window, a column for each of ``SCORES``: nan where another episode had begun, which is no future
        of this one, and for costs where time had been up before, but not where nothing could come any more
    """
    state = repeat(filtered.states.map(lambda field: field[start]))
    same, in_time = th.tensor(True), th.tensor(True)
    safe, alive, happens = th.ones(()), th.ones(()), th.zeros(())
    energies, briers = [], []
    for step in range(start + 1, start + 1 + AHEAD[-1]):
        state = model.rssm.imagine(state._replace(action=samples.actions[:, step].repeat(N_SAMPLES, 1)))
        expected = model.predictions(model.features(state))
        safe, alive = safe * (1 - alive * expected.costs), alive * expected.continues
        begins = samples.is_first[:, step]
        in_time = in_time & ~(same & begins & (samples.continues[:, step - 1] > 0))
        same = same & ~begins
        happens = th.maximum(happens, same * samples.costs[:, step])
        if step - start in AHEAD:
            energy = energy_by_cell(state.latent, filtered.states.latent[step])
            energies.append(energy.masked_fill(~same, np.nan))
            brier = (1 - safe.unflatten(0, (N_SAMPLES, -1)).mean(0) - happens).square()
            briers.append(brier.masked_fill(~in_time, np.nan))
    return th.stack([*energies, *briers[1:]], 1)


def judge(model: WorldModel, others: Windows) -> np.ndarray:
    """
    Score a model, by random numbers that are the same whenever it is asked.

    :param model: trained model
    :param others: batches of windows with their states
    :return: a row for each batch, a column for each of ``SCORES``
    """
    rows = []
    for seed, (samples, filtered) in enumerate(others):
        th.manual_seed(seed)
        found = th.cat([scores(model, samples, filtered, start) for start in STARTS])
        rows.append(found.nanmean(0).cpu().numpy())
    return np.array(rows)


def describe(found: np.ndarray) -> str:
    """
    Name the mean scores.

    :param found: a row for each batch, a column for each of ``SCORES``
    :return: words
    """
    return ", ".join(f"{name} {value:.4f}" for name, value in zip(SCORES, found.mean(0), strict=True))


def interval(differences: np.ndarray) -> str:
    """
    Mean with its interval.

    :param differences: of pairs, of shape (N,)
    :return: words
    """
    low, high = mean_interval(differences)
    return f"{differences.mean():+.4f} [{low:+.4f}, {high:+.4f}]"


def step_time(model: WorldModel, n: int = 48, repeats: int = 30) -> float:
    """
    Time an imagined step.

    :param model: world model
    :param n: states
    :param repeats: how often
    :return: median [ms]
    """
    state, times = model.initial(n), []
    for _ in range(repeats):
        begin = time.perf_counter()
        state = model.rssm.imagine(state)
        times.append(1e3 * (time.perf_counter() - begin))
    return float(np.median(times))


def compare(model: WorldModel, others: Windows, levels: list[float], arms: list[int]) -> None:
    """
    Print what refined latents foresee, beside those that are not.

    :param model: trained model
    :param others: batches of windows with their states
    :param levels: of noise from which samples are refined
    :param arms: numbers of steps >= 1
    """
    head = model.rssm.head
    assert isinstance(head, DiffusionHead)
    print(f"  advantage {head.advantage:.2f}, scale {head.residual_scale:.2f}")
    head.advantage.fill_(-1.0)  # as the gate is while a Gaussian is better
    plain = judge(model, others)
    print(f"  Gaussian: {describe(plain)}, {step_time(model):.1f} ms a step", flush=True)
    head.advantage.fill_(1.0)
    for level, n_steps in product(levels, arms):
        head.start_level, head.diffusion_steps = level, n_steps
        found = judge(model, others)
        print(f"  level {level}, {n_steps} steps: {describe(found)}, {step_time(model):.1f} ms a step")
        print("    less the Gaussian: " + ", ".join(interval(column) for column in (found - plain).T), flush=True)


def main() -> None:
    """Train and judge with every seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="esad-traffic-negotiation-v0")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--others", type=int, default=20_000, help="steps to judge by")
    parser.add_argument("--seconds", type=float, default=300)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--levels", type=float, nargs="+", default=[3.0], help="start_level of the samples")
    parser.add_argument("--diffusion-steps", type=int, nargs="+", default=[1, 2, 3])
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    env = gym.make(args.env)
    for seed in args.seeds:
        kwargs = {"head_kwargs": {"diffusion_steps": 2}}
        algorithm = ESADLEND("CnnPolicy", env, buffer_size=1000, policy_kwargs=kwargs, seed=seed)
        algorithm.replay_buffer = record(env, args.steps, seed, 16)
        updates, model = fit(algorithm, args.seconds), algorithm.policy.world_model
        print(f"{args.env}, seed {seed}: {updates} updates")
        with th.no_grad(), autocast(algorithm.device):
            windows = stretches(env, steps(env, 1000 + seed), args.others)
            others = [(each, model.observe(each, th.zeros_like(each.is_first.T))) for each in windows]
            compare(model, others, args.levels, args.diffusion_steps)


if __name__ == "__main__":
    main()
