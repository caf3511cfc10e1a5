"""
Do the cost critics tell the truth? ``python benchmark/calibration.py MODEL.zip --out calibration.png``.

The model drives unseen episodes with the actions of its policy. On every state the predicted mean and standard deviation of
the discounted cost to come are set against what came: over all states, and drawn in bins of the predicted mean. With
``--buffer`` the critics are fitted first, as the demo does (``benchmark/driving.py esad_lend --few-updates --save-buffer``
leaves a model and a buffer), or with ``--imagined-coef 0.33``, as is right after the updates of ``hyperparams/``.
"""

import argparse
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from matplotlib.figure import Figure
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_esad import ESADLEND
from sb3_esad.demo import FIT_UPDATES

UNSEEN = 3_000_000
BINS = 10


class Visits(NamedTuple):
    """What was expected and what came, on each state of finished episodes; arrays of shape (N,)."""

    mean: np.ndarray
    variance: np.ndarray
    cost: np.ndarray
    cost_to_come: np.ndarray


def drive(model: ESADLEND, env_id: str, n_steps: int, n_envs: int, seed: int) -> Visits:
    """
    Let the policy drive, with sampled actions, as the critics mean it.

    :param model: trained model
    :param env_id: scenario
    :param n_steps: decisions in all
    :param n_envs: environments side by side
    :param seed: of the first environment
    :return: every state after which nothing that matters was cut off
    """
    env, policy, agent = DummyVecEnv([partial(gym.make, env_id)] * n_envs), model.policy, model.policy.average
    env.seed(seed)
    observation: Any = env.reset()
    starts, latent = np.ones(n_envs, dtype=bool), policy.initial_state(n_envs)
    rows = []
    for _ in range(n_steps // n_envs):
        latent = agent.observe(policy.obs_to_tensor(observation)[0], latent, th.as_tensor(starts), False).state
        action = agent.act(latent)
        with th.no_grad():
            means, variance = policy.cost_critic_target(agent.world_model.features(latent), action)
        latent = latent._replace(action=action)
        observation, _, starts, infos = env.step(policy.unscale_action(action.numpy()))
        costs = model.replay_buffer.read_costs(infos)
        cut = [info.get("TimeLimit.truncated", False) for info in infos]
        rows.append((means.mean(0).numpy(), variance.numpy(), costs, starts, np.array(cut)))
    mean, variance, costs, dones, cuts = (np.array(column) for column in zip(*rows, strict=True))
    to_come, known = cost_to_come(costs, dones, cuts, model.gamma if model.cost_gamma is None else model.cost_gamma)
    return Visits(mean[known], variance[known], costs[known], to_come[known])


def cost_to_come(costs: np.ndarray, dones: np.ndarray, cuts: np.ndarray, gamma: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Sum up discounted costs backwards.

    :param costs: of shape (T, n_envs)
    :param dones: whether the episode ended after the step
    :param cuts: whether it ended only because time was up
    :param gamma: discount of the cost
    :return: the sums, and whether at least 95 % of their weight was seen
    """
    sums, unseen = np.zeros_like(costs, dtype=np.float64), np.ones_like(costs, dtype=np.float64)
    following, weight = np.zeros(costs.shape[1]), np.ones(costs.shape[1])
    for t in reversed(range(len(costs))):
        following = costs[t] + gamma * np.where(dones[t], 0.0, following)
        weight = gamma * np.where(dones[t], cuts[t], weight)
        sums[t], unseen[t] = following, weight
    return sums, unseen < 0.05


def figures(visits: Visits) -> tuple[float, float, float, float]:
    """
    Mean and standard deviation over a set of states, predicted and found.

    :param visits: states
    :return: predicted mean, found mean, predicted deviation (of the mixture), found deviation
    """
    predicted = np.sqrt(visits.variance.mean() + visits.mean.var())
    return visits.mean.mean(), visits.cost_to_come.mean(), predicted, visits.cost_to_come.std()


def by_expectation(visits: Visits) -> list[Visits]:
    """
    Sort states by what was expected.

    :param visits: states
    :return: ``BINS`` parts of equal size, the safest first
    """
    parts = np.array_split(np.argsort(visits.mean), BINS)
    return [Visits(*(column[part] for column in visits)) for part in parts]


def plot(path: Path, bins: list[Visits]) -> None:
    """
    Draw predicted against found, for mean and standard deviation.

    :param path: where to write the PNG
    :param bins: states, sorted by their predicted mean
    """
    table = np.array([figures(each) for each in bins])
    figure = Figure(figsize=(9, 4.5), layout="constrained")
    for axes, name, first in zip(figure.subplots(1, 2), ("mean", "standard deviation"), (0, 2), strict=True):
        top = 1.05 * table[:, first : first + 2].max()
        axes.plot([0, top], [0, top], color="black", linestyle="--", label="truth")
        axes.plot(table[:, first], table[:, first + 1], "o-", label=f"{len(bins)} bins of equal size")
        axes.set(xlabel=f"predicted {name} of the discounted cost", ylabel=f"{name} of what came")
        axes.legend()
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=120)


def add_fit(parser: argparse.ArgumentParser) -> None:
    """
    Ask for a model, and whether its critics are to be fitted first.

    :param parser: gets the arguments that :func:`load_fitted` reads
    """
    parser.add_argument("model", type=Path)
    parser.add_argument("--buffer", type=Path, help="of the model: fit its critics first, which the demo has done")
    parser.add_argument("--imagined-coef", type=float, default=0.0, help="weight of imagined transitions in that fit")


def load_fitted(
    parser: argparse.ArgumentParser, args: argparse.Namespace, algorithm: type[ESADLEND] = ESADLEND, **settings: Any
) -> ESADLEND:
    """
    Load a model, and fit its critics if there is a buffer.

    :param parser: tells of arguments that do not fit together
    :param args: what :func:`add_fit` asked for
    :param algorithm: class of the model
    :param settings: arguments of its constructor to replace
    :return: the model, on the CPU
    """
    if args.imagined_coef != 0 and args.buffer is None:
        parser.error(f"--imagined-coef is {args.imagined_coef}, but nothing is fitted: add --buffer")
    model = algorithm.load(args.model, device="cpu", **settings)
    if args.buffer is not None:
        model.load_replay_buffer(args.buffer)
        model.fit_cost_critic(FIT_UPDATES, imagined_coef=args.imagined_coef)
    return model


def main() -> None:
    """Drive, compare, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_fit(parser)
    parser.add_argument("--env", default="esad-highway-v0")
    parser.add_argument("--steps", type=int, default=60_000)
    parser.add_argument("--n-envs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=UNSEEN)
    parser.add_argument("--out", type=Path, default=Path("calibration.png"))
    args = parser.parse_args()
    model = load_fitted(parser, args)
    visits = drive(model, args.env, args.steps, args.n_envs, args.seed)
    bins = by_expectation(visits)
    for name, each in [("all", visits), *((str(index), each) for index, each in enumerate(bins))]:
        mean, found_mean, deviation, found_deviation = figures(each)
        means = f"mean {mean:.4f} against {found_mean:.4f}"
        deviations = f"deviation {deviation:.3f} against {found_deviation:.3f}"
        print(f"{name:>4}: {len(each.mean)} states, {np.count_nonzero(each.cost)} costs, {means}, {deviations}")
    plot(args.out, bins)


if __name__ == "__main__":
    main()
