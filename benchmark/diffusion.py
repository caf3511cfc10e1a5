"""
Whether diffusion foresees more than a Gaussian, experiment E0: ``python benchmark/diffusion.py --seeds 0 1 2``.

Recorded steps of a scenario, some minutes of training of the world model alone; then, on other episodes, the same model with
and without refined latents: energy score of the latent 1 and 5 steps ahead (lower is better; differences are conditional
energy distances), Brier score of a cost within 5 steps, and what an imagined step takes.
"""

import argparse
import time

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.utils import set_random_seed
from world_model import fit, record

from sb3_esad import ESADLEND
from sb3_esad.common.diffusion import DiffusionHead
from sb3_esad.common.precision import autocast
from sb3_esad.common.type_aliases import LatentState, SequenceSamples
from sb3_esad.common.world_model import WorldModel
from sb3_esad.envs.intervals import mean_interval

HORIZON, STARTS = 5, (5, 12, 20)
N_SAMPLES = 16
SCORES = ("energy score, 1 step", "energy score, 5 steps", "Brier score, 5 steps")


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
    :return: a column for each of ``SCORES``, nan where the episode was over; a row for each window that goes on or costs
    """
    filtered = model.observe(samples, th.zeros_like(samples.is_first.T))
    state = repeat(filtered.states.map(lambda field: field[start]))
    same, safe, happens = th.tensor(True), th.ones(()), th.zeros(())
    energies = []
    for ahead in range(1, HORIZON + 1):
        action = samples.actions[:, start + ahead]
        state = model.rssm.imagine(state._replace(action=action.repeat(N_SAMPLES, 1)))
        same = same & ~samples.is_first[:, start + ahead]
        if ahead in (1, HORIZON):
            latents = state.latent.flatten(1).unflatten(0, (N_SAMPLES, -1))
            energy = energy_score(latents, filtered.states.latent[start + ahead].flatten(1))
            energies.append(energy.masked_fill(~same, np.nan))  # another episode is no future of this one
        safe = safe * (1 - model.predictions(model.features(state)).costs)
        happens = th.maximum(happens, same * samples.costs[:, start + ahead])
    brier = (1 - safe.unflatten(0, (N_SAMPLES, -1)).mean(0) - happens).square()
    return th.stack([*energies, brier], 1)[same | (happens > 0)].cpu().numpy()


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
    parser.add_argument("--seconds", type=float, default=300)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--levels", type=float, nargs="+", default=[3.0], help="start_level of the samples")
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    env = gym.make(args.env)
    for seed in args.seeds:
        kwargs = {"head_kwargs": {"diffusion_steps": 2}}
        algorithm = ESADLEND("CnnPolicy", env, buffer_size=1000, policy_kwargs=kwargs, seed=seed)
        algorithm.replay_buffer = record(env, args.steps, seed, 16)
        updates = fit(algorithm, args.seconds)
        others = record(env, 5000, 1000 + seed, 32, event_fraction=0.0)  # costs as often as they come
        head = algorithm.policy.world_model.rssm.head
        assert isinstance(head, DiffusionHead)
        print(f"{args.env}, seed {seed}: {updates} updates, advantage {head.advantage:.2f}, scale {head.residual_scale:.2f}")
        results = {}
        for level in args.levels:
            head.start_level = level
            for steps in (0, 1, 2, 3):
                head.diffusion_steps = steps
                head.advantage.fill_(1.0 if steps else -1.0)
                set_random_seed(0)
                with th.no_grad(), autocast(algorithm.device):
                    batches = [others.sample(32) for _ in range(12)]
                    rows = [scores(algorithm.policy.world_model, each, start) for each in batches for start in STARTS]
                    took = step_time(algorithm.policy.world_model)
                results[steps] = np.concatenate(rows)
                means = zip(SCORES, np.nanmean(results[steps], 0), strict=True)
                figures = ", ".join(f"{name} {value:.4f}" for name, value in means)
                print(f"  level {level}, {steps} steps: {figures}, {took:.1f} ms a step", flush=True)
                if steps:
                    apart = results[steps] - results[0]
                    print("    less 0 steps: " + ", ".join(interval(column) for column in apart.T), flush=True)


if __name__ == "__main__":
    main()
