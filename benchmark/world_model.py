"""
What the world model sees and foresees, experiment E10: ``python benchmark/world_model.py --seeds 0 1 2``.

5,000 recorded steps of the scenario, some minutes of training of the model alone, then on other episodes: intersection over
union of the vehicle channel, reconstructed and open loop, and the area under the curve of the predicted cost from the prior.
"""

import argparse
import time
from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from scipy.stats import rankdata
from stable_baselines3.common.torch_layers import NatureCNN

from sb3_esad import ESADLEND, SADLEN
from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.precision import autocast
from sb3_esad.common.type_aliases import LatentState, SequenceSamples
from sb3_esad.common.world_model import WorldModel
from sb3_esad.envs.drivers import CarFollower, RandomDriver, ReferenceDriver, SpeedKeeper

ENV = "esad-highway-v0"
VEHICLES, VISIBLE = 1, 0.19  # image channel, and half the grey level of a standing car
HORIZON = 10
STARTS = (5, 12, 20)
ARMS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "spatial, lane": ({}, {"frame": "lane"}),
    "spatial, ego": ({}, {"frame": "ego"}),
    "flat, lane": ({"features_extractor_class": NatureCNN}, {"frame": "lane"}),
}
"""Policy and scenario settings of each arm."""


class Step(NamedTuple):
    """One recorded step; the fields are those of the replay buffer."""

    observation: np.ndarray
    next_observation: np.ndarray
    action: np.ndarray
    reward: float
    done: bool
    info: dict[str, Any]


def steps(env: gym.Env[Any, Any], seed: int) -> Iterator[Step]:
    """
    Drive with scripted drivers of all tempers, among them some that do as they please, so that there are crashes enough.

    :param env: scenario
    :param seed: of scenario and drivers
    :return: endless steps
    """
    random = np.random.default_rng(seed)
    drivers = (SpeedKeeper(), CarFollower(), ReferenceDriver(), RandomDriver(seed), RandomDriver(seed + 1))
    while True:
        observation, _ = env.reset(seed=int(random.integers(2**31)))
        driver, wild = drivers[random.integers(len(drivers))], random.random() < 0.6
        pedal, steering, bias = (
            random.choice([0.1, 0.5, 1.0]),
            random.choice([0.05, 0.1, 0.3]),
            random.choice([0.0, 0.15, 0.3]),
        )
        done, count = False, 0
        while not done:
            if count % 5 == 0:
                noise = random.uniform(-1, 1, 2) * [pedal, steering] + [bias, 0]
            count += 1
            action = np.clip(driver(env) + (noise if wild else 0), -1, 1).astype(np.float32)
            following, reward, terminated, truncated, info = env.step(action)
            done = terminated or truncated
            yield Step(observation, following, action, float(reward), done, {**info, "TimeLimit.truncated": truncated})
            observation = following


def record(env: gym.Env[Any, Any], n_steps: int, seed: int, length: int) -> SequenceReplayBuffer:
    """
    Fill a replay buffer.

    :param env: scenario
    :param n_steps: how many steps
    :param seed: of scenario and drivers
    :param length: steps in a window
    :return: the buffer, to which all steps are equally new
    """
    spaces = env.observation_space, env.action_space
    buffer = SequenceReplayBuffer(n_steps, *spaces, "auto", sequence_length=length, recency=0.0)
    add_steps(buffer, islice(steps(env, seed), n_steps))
    return buffer


def add_steps(buffer: SequenceReplayBuffer, recorded: Iterable[Step]) -> None:
    """
    Store steps of one environment.

    :param buffer: that stores them
    :param recorded: the steps
    """
    for step in recorded:
        observation, following, action, reward, done = (np.array([field]) for field in step[:-1])
        buffer.add(observation, following, action, reward, done, [step.info])


def overlap(image: th.Tensor, truth: th.Tensor) -> np.ndarray:
    """
    Count where vehicles are and where they are drawn.

    :param image: reconstructions, of shape (N, C, H, W)
    :param truth: what was to be seen, of the same shape
    :return: pixels of the intersection and of the union
    """
    drawn, there = image[:, VEHICLES] > VISIBLE, truth[:, VEHICLES] > VISIBLE
    return np.array([(drawn & there).sum().item(), (drawn | there).sum().item()])


def area_under_curve(scores: np.ndarray, labels: np.ndarray) -> float:
    """
    Probability that a step with a cost is given a higher score than one without.

    :param scores: predicted costs, of shape (N,)
    :param labels: whether there was a cost, of shape (N,)
    :return: from 0 to 1
    """
    positives, ranks = labels > 0, rankdata(scores)
    n = positives.sum()
    return float((ranks[positives].sum() - n * (n + 1) / 2) / (n * (len(labels) - n)))


class Gauge:
    """Accumulates what a model gets right."""

    def __init__(self) -> None:
        self.overlaps = np.zeros((HORIZON + 1, 2))
        self.scores: list[float] = []
        self.labels: list[float] = []

    def add(self, model: WorldModel, samples: SequenceSamples, start: int) -> None:
        """
        Go on without observations from one step of each window.

        :param model: trained model
        :param samples: windows of recorded steps
        :param start: step after which the model is blind
        """
        assert isinstance(samples.next_observations, th.Tensor)
        images = samples.next_observations.transpose(0, 1).float() / 255
        filtered = model.observe(samples, th.zeros_like(samples.is_first.T))
        state = filtered.states.map(lambda field: field[start])
        self.overlaps[0] += overlap(model.reconstruct(state)["observation"], images[start])
        same = th.ones_like(samples.among_all)
        for ahead in range(1, HORIZON + 1):
            same &= ~samples.is_first.T[start + ahead]
            state = model.rssm.imagine(state._replace(action=samples.actions[:, start + ahead]))
            self._compare(model, LatentState(*(field[same] for field in state)), images[start + ahead][same], ahead)
            self.labels += samples.costs[same, start + ahead].tolist()

    def _compare(self, model: WorldModel, state: LatentState, images: th.Tensor, ahead: int) -> None:
        self.overlaps[ahead] += overlap(model.reconstruct(state)["observation"], images)
        self.scores += model.predictions(model.features(state)).costs.tolist()

    def figures(self) -> dict[str, float]:
        """
        Summarise.

        :return: intersection over union now and 1 s (5 steps) ahead, area under the curve 1 to 10 steps ahead
        """
        union = self.overlaps[:, 0] / self.overlaps[:, 1]
        auc = area_under_curve(np.array(self.scores), np.array(self.labels))
        return {"IoU now": union[0], "IoU 1 s": union[5], "cost AUC": auc, "costs": float(np.sum(self.labels))}


def fit(algorithm: ESADLEND, seconds: float) -> int:
    """
    Train the world model alone on what is in the replay buffer.

    :param algorithm: owns the model
    :param seconds: of wall-clock
    :return: the number of updates
    """
    begin, updates = time.perf_counter(), 0
    while (left := 1 - (time.perf_counter() - begin) / seconds) > 0:
        for group in algorithm.policy.world_model.optimizer.param_groups:
            group["lr"] = 6e-3 * min(1.0, (updates + 1) / 20, left / 0.4 + 0.1)
        algorithm._update_world_model(algorithm._sample(16))
        updates += 1
    return updates


def main() -> None:
    """Train and judge every arm with every seed, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=5000)
    parser.add_argument("--seconds", type=float, default=300)
    parser.add_argument("--length", type=int, default=16, help="steps in a training window")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    for arm in args.arms:
        for seed in args.seeds:
            policy, config = ARMS[arm]
            env = gym.make(ENV, config=config)
            algorithm = SADLEN("CnnPolicy", env, buffer_size=1000, policy_kwargs=dict(policy), seed=seed)
            algorithm.replay_buffer = record(env, args.steps, seed, args.length)
            updates = fit(algorithm, args.seconds)
            others, gauge = record(env, 4000, 1000 + seed, 32), Gauge()
            with th.no_grad(), autocast(algorithm.device):
                for _ in range(8):
                    samples = others.sample(32)
                    for start in STARTS:
                        gauge.add(algorithm.policy.world_model, samples, start)
            figures = ", ".join(f"{name} {value:.2f}" for name, value in gauge.figures().items())
            print(f"{arm}, seed {seed}: {updates} updates, {figures}", flush=True)


if __name__ == "__main__":
    main()
