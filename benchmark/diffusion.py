"""
Whether diffusion foresees more than a Gaussian, experiment E0: ``python benchmark/diffusion.py --seeds 0 1 2``.

Recorded steps of a scenario, some minutes of training of the world model alone; then, on other episodes, the same model with
and without refined latents: energy score of the latent 1, 5 and 10 steps ahead (lower is better; differences are conditional
energy distances), Brier score of a cost within 5 and 10 steps, and what an imagined step takes. No step is foreseen twice.
"""

import argparse
import time
from collections.abc import Iterator
from itertools import islice
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.utils import set_random_seed
from world_model import add_steps, fit, record, steps

from sb3_esad import ESADLEND
from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.diffusion import DiffusionHead
from sb3_esad.common.precision import autocast
from sb3_esad.common.type_aliases import LatentState, SequenceSamples
from sb3_esad.common.world_model import WorldModel
from sb3_esad.envs.intervals import mean_interval

AHEAD, STARTS = (1, 5, 10), (7, 19)
N_SAMPLES, LENGTH, BATCH = 16, 32, 16
SCORES = tuple(f"energy score {ahead} ahead" for ahead in AHEAD) + tuple(f"Brier score within {ahead}" for ahead in AHEAD[1:])


def stretches(env: gym.Env[Any, Any], n_steps: int, seed: int) -> Iterator[SequenceSamples]:
    """
    Drive, and cut what is seen into windows one after the other.

    :param env: scenario
    :param n_steps: about how many steps
    :param seed: of scenario and drivers
    :return: batches of ``BATCH`` windows, none of which overlap
    """
    window = SequenceReplayBuffer(LENGTH, env.observation_space, env.action_space, sequence_length=LENGTH, event_fraction=0.0)
    driven, batch = steps(env, seed), []
    for _ in range(n_steps // LENGTH):
        add_steps(window, islice(driven, LENGTH))
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


def scores(model: WorldModel, samples: SequenceSamples, start: int) -> np.ndarray:
    """
    Go on without observations from one step of each window, and compare with what came.

    :param model: trained model
    :param samples: windows of recorded steps
    :param start: step after which the model is blind
    :return: a column for each of ``SCORES``, nan where the episode was over, or over without a cost; a row for each window
    """
    filtered = model.observe(samples, th.zeros_like(samples.is_first.T))
    state = repeat(filtered.states.map(lambda field: field[start]))
    same, safe, happens = th.tensor(True), th.ones(()), th.zeros(())
    energies, briers = [], []
    for ahead in range(1, AHEAD[-1] + 1):
        action = samples.actions[:, start + ahead]
        state = model.rssm.imagine(state._replace(action=action.repeat(N_SAMPLES, 1)))
        same = same & ~samples.is_first[:, start + ahead]
        safe = safe * (1 - model.predictions(model.features(state)).costs)
        happens = th.maximum(happens, same * samples.costs[:, start + ahead])
        if ahead in AHEAD:
            latents = state.latent.flatten(1).unflatten(0, (N_SAMPLES, -1))
            energy = energy_score(latents, filtered.states.latent[start + ahead].flatten(1))
            energies.append(energy.masked_fill(~same, np.nan))  # another episode is no future of this one
            brier = (1 - safe.unflatten(0, (N_SAMPLES, -1)).mean(0) - happens).square()
            briers.append(brier.masked_fill(~(same | (happens > 0)), np.nan))
    return th.stack([*energies, *briers[1:]], 1).cpu().numpy()


def interval(differences: np.ndarray) -> str:
    """
    Mean with its interval.

    :param differences: of pairs, of shape (N,)
    :return: words
    """
    known = differences[~np.isnan(differences)]
    low, high = mean_interval(known)
    return f"{known.mean():+.4f} [{low:+.4f}, {high:+.4f}]"


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
    parser.add_argument("--diffusion-steps", type=int, nargs="+", default=[0, 1, 2, 3], help="0 first")
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    env = gym.make(args.env)
    for seed in args.seeds:
        kwargs = {"head_kwargs": {"diffusion_steps": 2}}
        algorithm = ESADLEND("CnnPolicy", env, buffer_size=1000, policy_kwargs=kwargs, seed=seed)
        algorithm.replay_buffer = record(env, args.steps, seed, 16)
        updates = fit(algorithm, args.seconds)
        others = list(stretches(env, args.others, 1000 + seed))
        head = algorithm.policy.world_model.rssm.head
        assert isinstance(head, DiffusionHead)
        print(f"{args.env}, seed {seed}: {updates} updates, advantage {head.advantage:.2f}, scale {head.residual_scale:.2f}")
        results = {}
        for level in args.levels:
            head.start_level = level
            for n_steps in args.diffusion_steps:
                head.diffusion_steps = n_steps
                head.advantage.fill_(1.0 if n_steps else -1.0)
                set_random_seed(0)
                with th.no_grad(), autocast(algorithm.device):
                    rows = [scores(algorithm.policy.world_model, each, start) for each in others for start in STARTS]
                    took = step_time(algorithm.policy.world_model)
                results[n_steps] = np.concatenate(rows)
                means = zip(SCORES, np.nanmean(results[n_steps], 0), strict=True)
                figures = ", ".join(f"{name} {value:.4f}" for name, value in means)
                print(f"  level {level}, {n_steps} steps: {figures}, {took:.1f} ms a step", flush=True)
                if n_steps:
                    apart = results[n_steps] - results[0]
                    print("    less 0 steps: " + ", ".join(interval(column) for column in apart.T), flush=True)


if __name__ == "__main__":
    main()
