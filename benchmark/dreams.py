"""
Do costs come as often as they are dreamed of? ``python benchmark/dreams.py MODEL.zip --env esad-braking-v0``.

The model drives unseen episodes with sampled actions. In windows of 16 steps, one after the other, the average of its world
model starts afresh, sees 6 steps and goes on for 10 without observations, with the actions that were taken: the cost imagined
for each of them is set against the costs that came; its squared error is in thousandths. An actor that learns from dreams
fears what they hold (those of its own present actions), not what the road holds.
"""

import argparse
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from diffusion import BATCH, stretches
from world_model import Step

from sb3_esad import ESADLEND
from sb3_esad.common.diffusion import DiffusionHead
from sb3_esad.common.type_aliases import SequenceSamples
from sb3_esad.common.world_model import WorldModel
from sb3_esad.envs.intervals import poisson_interval

UNSEEN = 4_000_000
SEEN, AHEAD = 6, 10
"""Steps whose observations are taken in, and those that are imagined after them."""


class Dreams(NamedTuple):
    """
    Costs of the steps ahead, in N windows; arrays of shape (N, AHEAD).

    :param imagined: expected cost of each step, times the probability that it is reached
    :param recorded: what came, 0 once the episode is over
    :param known: False from the step after a time limit on
    """

    imagined: np.ndarray
    recorded: np.ndarray
    known: np.ndarray


def steps(model: ESADLEND, env: gym.Env[Any, Any], seed: int) -> Iterator[Step]:
    """
    Let the policy drive, with sampled actions.

    :param model: trained model
    :param env: scenario
    :param seed: of the first episode
    :return: endless steps
    """
    for episode_seed in count(seed):
        (observation, _), state, done = env.reset(seed=episode_seed), None, False
        while not done:
            action, state = model.predict(observation, state)
            following, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            scaled, info = model.policy.scale_action(action), {**info, "TimeLimit.truncated": truncated and not terminated}
            yield Step(observation, following, scaled, float(reward), done, info)
            observation = following


def dream(model: WorldModel, samples: SequenceSamples) -> Dreams:
    """
    Go on without observations, and look at what came.

    :param model: trained model
    :param samples: windows
    :return: costs ahead in those windows whose first ``SEEN`` steps, and the next, belong to one episode
    """
    begins = samples.is_first.clone()
    begins[:, 0] = False
    over = begins[:, SEEN:].cumsum(1) > 0
    cut = (begins & (samples.continues.roll(1, 1) > 0))[:, SEEN:].cumsum(1) > 0
    usable = ~begins[:, : SEEN + 1].any(1)
    fields = imagine_costs(model, samples), samples.costs[:, SEEN:] * ~over, ~cut
    return Dreams(*(field[usable].cpu().numpy() for field in fields))


@th.no_grad()
def imagine_costs(model: WorldModel, samples: SequenceSamples) -> th.Tensor:
    """
    Foresee what the recorded actions cost.

    :param model: trained model
    :param samples: B windows
    :return: expected cost of each step, times the probability that the episode gets there, of shape (B, AHEAD)
    """
    seen = model.observe(samples, th.zeros_like(samples.is_first.T)).states.map(lambda field: field[SEEN - 1])
    first, *following = samples.actions[:, SEEN:].unbind(1)
    actions = iter([*following, first])  # the last one is not executed
    imagined = model.imagine(seen._replace(action=first), lambda grid: next(actions), AHEAD, gamma=1.0)
    return (imagined.weights * imagined.predictions.costs).T


def row(name: str, dreams: Dreams, columns: list[int]) -> str:
    """
    Compare what was imagined of some steps ahead with what came.

    :param name: of the row
    :param dreams: costs ahead
    :param columns: which steps
    :return: a line of the table, with Poisson's 95 % interval of the costs that came, and 1,000 times the mean squared error
    """
    known = dreams.known[:, columns]
    n, imagined = known.sum(), dreams.imagined[:, columns][known].mean()
    count = dreams.recorded[:, columns][known].sum()
    low, high = (1000 * end / n for end in poisson_interval(count))
    score = 1000 * np.square(dreams.imagined[:, columns] - dreams.recorded[:, columns])[known].mean()
    return f"| {name} | {1000 * imagined:.2f} | {1000 * count / n:.2f} [{low:.2f}, {high:.2f}] | {count:.0f} | {score:.2f} |"


def main() -> None:
    """Drive, dream, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--env", default="esad-highway-v0")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=UNSEEN)
    parser.add_argument("--temperature", type=float, help="of a Gaussian prior, in [0, 1] (default: that of the model)")
    args = parser.parse_args()
    if args.steps < (SEEN + AHEAD) * BATCH:
        parser.error(f"--steps is {args.steps}: ask for {(SEEN + AHEAD) * BATCH}, a batch of windows, or more")
    th.set_num_threads(1)
    th.manual_seed(0)
    model = ESADLEND.load(args.model)
    env, average = gym.make(args.env), model.policy.world_model_target
    if args.temperature is not None:
        if not 0 <= args.temperature <= 1 or isinstance(average.rssm.head, DiffusionHead):
            parser.error(f"--temperature is {args.temperature}: give one in [0, 1], and a model without diffusion")
        average.rssm.head.temperature = args.temperature
    windows = stretches(env, steps(model, env, args.seed), args.steps, SEEN + AHEAD)
    found = [dream(average, samples) for samples in windows]
    dreams = Dreams(*(np.concatenate(field) for field in zip(*found, strict=True)))
    print("| steps ahead | costs imagined in 1,000 steps | that came | in all | 1000 x squared error |\n|---|---|---|---|---|")
    for step in range(AHEAD):
        print(row(str(step + 1), dreams, [step]))
    print(row("all", dreams, list(range(AHEAD))))


if __name__ == "__main__":
    main()
