"""
Do costs come as often as they are dreamed of? ``python benchmark/dreams.py MODEL.zip --env esad-braking-v0``.

The model drives unseen episodes with sampled actions. In windows of 16 steps, one after the other, the average of its world
model starts afresh, sees 6 steps and goes on for 10 without observations, with the actions that were taken: the cost imagined
for each of them is set against the costs that came. An actor that learns from dreams fears what they hold (those of its own
present actions), not what the road holds.
"""

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_esad import ESADLEND
from sb3_esad.common.buffers import SequenceReplayBuffer
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


def driven(model: ESADLEND, env_id: str, n_steps: int, n_envs: int, seed: int) -> SequenceReplayBuffer:
    """
    Let the policy drive, with sampled actions, and record it.

    :param model: trained model
    :param env_id: scenario
    :param n_steps: in all
    :param n_envs: environments side by side
    :param seed: of the first environment
    :return: the steps
    """
    env = DummyVecEnv([partial(gym.make, env_id)] * n_envs)
    spaces = env.observation_space, env.action_space
    buffer = SequenceReplayBuffer(n_steps, *spaces, "cpu", n_envs, sequence_length=SEEN + AHEAD, event_fraction=0.0)
    env.seed(seed)
    observation: Any = env.reset()
    following: Any
    state, starts = None, np.ones(n_envs, dtype=bool)
    for _ in range(n_steps // n_envs):
        action, state = model.predict(observation, state, starts)
        following, rewards, starts, infos = env.step(action)
        reached = following.copy()
        for index in np.flatnonzero(starts):
            reached[index] = infos[index]["terminal_observation"]
        buffer.add(observation, reached, model.policy.scale_action(action), rewards, starts, infos)
        observation = following
    return buffer


def windows(buffer: SequenceReplayBuffer) -> Iterator[SequenceSamples]:
    """
    Cut what was recorded into windows one after the other.

    :param buffer: recorded steps
    :return: for each stretch of ``SEEN`` + ``AHEAD`` steps a window of each environment
    """
    length, envs = SEEN + AHEAD, np.arange(buffer.n_envs)[:, None]
    for begin in range(0, buffer.size() - length + 1, length):
        steps = np.full_like(envs, begin) + np.arange(length)
        yield buffer._get_sequences(steps, envs, 0, 0.0, None)


def dream(model: WorldModel, samples: SequenceSamples) -> Dreams:
    """
    Go on without observations, and look at what came.

    :param model: trained model
    :param samples: windows
    :return: costs ahead in those windows whose first ``SEEN`` steps, and the next, belong to one episode
    """
    begins = samples.is_first & (th.arange(SEEN + AHEAD) > 0)
    over = begins[:, SEEN:].cumsum(1) > 0
    cut = (begins & (samples.continues.roll(1, 1) > 0))[:, SEEN:].cumsum(1) > 0
    usable = ~begins[:, : SEEN + 1].any(1)
    fields = imagine_costs(model, samples), samples.costs[:, SEEN:] * ~over, ~cut
    return Dreams(*(field[usable].numpy() for field in fields))


@th.no_grad()
def imagine_costs(model: WorldModel, samples: SequenceSamples) -> th.Tensor:
    """
    Foresee what the recorded actions cost.

    :param model: trained model
    :param samples: B windows
    :return: expected cost of each step, times the probability that the episode gets there, of shape (B, AHEAD)
    """
    filtered = model.observe(samples, th.zeros_like(samples.is_first.T))
    state, alive = filtered.states.map(lambda field: field[SEEN - 1]), th.ones(len(samples.costs))
    costs = []
    for action in samples.actions[:, SEEN:].unbind(1):
        state = model.rssm.imagine(state._replace(action=action))
        expected = model.predictions(model.features(state))
        costs.append(alive * expected.costs)
        alive = alive * expected.continues
    return th.stack(costs, 1)


def row(name: str, dreams: Dreams, columns: list[int]) -> str:
    """
    Compare what was imagined of some steps ahead with what came.

    :param name: of the row
    :param dreams: costs ahead
    :param columns: which steps
    :return: a line of the table, with Poisson's 95 % interval of the costs that came
    """
    known = dreams.known[:, columns]
    n, imagined = known.sum(), dreams.imagined[:, columns][known].mean()
    count = dreams.recorded[:, columns][known].sum()
    low, high = (1000 * end / n for end in poisson_interval(count))
    return f"| {name} | {1000 * imagined:.2f} | {1000 * count / n:.2f} [{low:.2f}, {high:.2f}] | {count:.0f} |"


def main() -> None:
    """Drive, dream, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--env", default="esad-highway-v0")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--n-envs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=UNSEEN)
    args = parser.parse_args()
    if args.steps < (SEEN + AHEAD) * args.n_envs:
        parser.error(
            f"--steps is {args.steps}, fewer than {SEEN + AHEAD} for each environment: ask for more, or lower --n-envs"
        )
    th.set_num_threads(1)
    th.manual_seed(0)
    model = ESADLEND.load(args.model, device="cpu")
    buffer = driven(model, args.env, args.steps, args.n_envs, args.seed)
    found = [dream(model.policy.world_model_target, samples) for samples in windows(buffer)]
    dreams = Dreams(*(np.concatenate(field) for field in zip(*found, strict=True)))
    print("| steps ahead | costs imagined in 1,000 steps | that came | in all |\n|---|---|---|---|")
    for step in range(AHEAD):
        print(row(str(step + 1), dreams, [step]))
    print(row("all", dreams, list(range(AHEAD))))


if __name__ == "__main__":
    main()
