"""
Which crashes does a model know when it sees one? ``python benchmark/recognition.py MODEL.zip``.

The model watches scripted drivers, and itself, and is asked how each episode has ended: by its picture of the last frame, and
by its imagination of the last steps, given the actions that were taken. A table has a row for each driver and kind of ending.
"""

import argparse
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import pandas as pd
import torch as th

from sb3_esad import ESADLEND
from sb3_esad.common.type_aliases import LatentState
from sb3_esad.envs.drivers import DRIVERS
from sb3_esad.envs.scenario import scenario_of

ENV = "esad-highway-v0"
TUNING = 700_000
"""First seed of the episodes; how well a model drives is measured on others."""
BLIND_STEPS = 5


class Ending(NamedTuple):
    """
    How an episode ended, and what the model made of it.

    :param driver: who drove
    :param ending: kind of cost, or "none"
    :param seen: expected cost of the last step, its picture seen
    :param foreseen: chance of a cost in the last steps, imagined with the actions that were taken
    :param critic: expected discounted cost to come before these steps
    """

    driver: str
    ending: str
    seen: float
    foreseen: float
    critic: float


@th.no_grad()
def endings(model: ESADLEND, driver_name: str, seeds: range) -> Iterator[Ending]:
    """
    Watch a driver.

    :param model: trained model
    :param driver_name: key of ``DRIVERS``, or "itself"
    :param seeds: of the episodes
    :return: one ending for each episode
    """
    env: gym.Env[Any, Any] = gym.make(ENV)
    for seed in seeds:
        states, info = drive(model, env, driver_name, seed)
        start, *last = states[-1 - BLIND_STEPS :]
        terms = [name for name, happened in info["cost_terms"].items() if happened]
        foreseen = 1 - math.prod(1 - expected_cost(model, state) for state in imagine(model, start, last))
        critic = model.policy.cost_critic_target(model.policy.world_model_target.features(start), start.action)[0].max()
        yield Ending(driver_name, ", ".join(terms) or "none", expected_cost(model, states[-1]), foreseen, critic.item())


def drive(model: ESADLEND, env: gym.Env[Any, Any], driver_name: str, seed: int) -> tuple[list[LatentState], dict[str, Any]]:
    """
    Drive one episode.

    :param model: trained model, which watches
    :param env: environment
    :param driver_name: who drives
    :param seed: of the episode
    :return: the state after every observation with the action taken in it, and the last info
    """
    agent, done = model.policy.average, False
    observation, info = env.reset(seed=seed)
    state, start = model.policy.initial_state(1), th.ones(1, dtype=th.bool)
    driver = None if driver_name == "itself" else DRIVERS[driver_name](scenario_of(env), seed)
    states: list[LatentState] = []
    while True:
        state = agent.observe(model.policy.obs_to_tensor(observation)[0], state, start, True).state
        own = agent.act(state, True)
        chosen = own if driver is None else th.as_tensor(driver(env)).view_as(own)
        state, start = state._replace(action=chosen), th.zeros_like(start)
        states.append(state)
        if done:
            return states, info
        observation, _, terminated, truncated, info = env.step(chosen[0].numpy())
        done = terminated or truncated


def imagine(model: ESADLEND, state: LatentState, last: list[LatentState]) -> Iterator[LatentState]:
    """
    Go on without looking.

    :param model: trained model
    :param state: to start from
    :param last: the states that followed, whose actions are repeated
    :return: an imagined state for each of them
    """
    for following in last:
        state = model.policy.world_model_target.rssm.imagine(state)._replace(action=following.action)
        yield state


def expected_cost(model: ESADLEND, state: LatentState) -> float:
    """
    Ask the model what it cost to get here.

    :param model: trained model
    :param state: a single one
    :return: the expected cost
    """
    world_model = model.policy.world_model_target
    return world_model.predict(world_model.features(state)[None]).costs.item()


def main() -> None:
    """Watch, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--seed", type=int, default=TUNING)
    args = parser.parse_args()
    th.set_num_threads(1)  # single images are too small to be shared
    model = ESADLEND.load(args.model, device="cpu")
    seeds = range(args.seed, args.seed + args.episodes)
    rows = [ending for driver in ("keeper", "random", "itself") for ending in endings(model, driver, seeds)]
    groups = pd.DataFrame(rows).groupby(["driver", "ending"])
    print(groups.mean().round(2).assign(episodes=groups.size()).to_string())


if __name__ == "__main__":
    main()
