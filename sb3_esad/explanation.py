"""Why a model does what it does: what it thinks possible, how dangerous that is, and whether the filter stepped in."""

import math
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_esad.common.imagined_returns import imagined_costs
from sb3_esad.common.noise import fixed_seed
from sb3_esad.common.selection import Selection, draw_scenarios
from sb3_esad.esad_lend import ESADLEND


class Futures(NamedTuple):
    """
    What may come, from the most to the least dangerous.

    :param images: what each looks like at its end by the key of the observation, of shape (M, ...)
    :param costs: discounted cost to come of each, of shape (M,)
    """

    images: dict[str, th.Tensor]
    costs: th.Tensor


class ExplainedDriver:
    """
    Drives one episode by the best actions, and tells what is behind each of them.

    :param model: trained model
    :param n_futures: scenarios that are imagined
    :param horizon: imagined steps
    """

    selection: Selection

    def __init__(self, model: ESADLEND, n_futures: int = 8, horizon: int = 5) -> None:
        self.model = model
        self.n_futures = n_futures
        self.horizon = horizon
        self._state = model.policy.initial_state(1)
        self._start = th.ones(1, dtype=th.bool, device=model.device)

    @th.no_grad()
    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """
        Take in an observation and choose an action.

        :param observation: of the environment, the first one of an episode at first
        :return: the action
        """
        policy = self.model.policy
        tensor, _ = policy.obs_to_tensor(observation)
        self._belief, self.selection = policy.decide(tensor, self._state, self._start, deterministic=True)
        self._state = self._belief.state._replace(action=self.selection.actions)
        self._start = th.zeros_like(self._start)
        return policy.unscale_action(self.selection.actions.cpu().numpy().reshape(policy.action_space.shape))

    @th.no_grad()
    def reconstruction(self) -> dict[str, th.Tensor]:
        """
        Show the present state.

        :return: preprocessed observations by key, of shape (1, ...)
        """
        return self.model.policy.average.world_model.reconstruct(self._state)

    @th.no_grad()
    def futures(self) -> Futures:
        """
        Imagine what may come of the chosen action, once from each scenario.

        :return: the futures
        """
        agent = self.model.policy.average
        with fixed_seed(self.model.device):
            scenarios = draw_scenarios(agent, self._belief, self.n_futures).map(lambda field: field.flatten(0, 1))
            start = scenarios._replace(action=self.selection.actions.repeat(self.n_futures, 1))
            imagined = agent.world_model.imagine(
                start, partial(agent.actor, deterministic=True), self.horizon, self.model.gamma
            )
            costs = imagined_costs(agent.cost_critic, imagined, self.model.discount_of_cost, lambda_=1.0)[0]
        order = costs.argsort(descending=True)
        return Futures(agent.world_model.decode(imagined.grids[-1][order].float()), costs[order])

    def tail(self, futures: Futures) -> float:
        """
        Average the most dangerous futures.

        :param futures: from the most to the least dangerous
        :return: mean cost of the worst ``risk_level`` of them
        """
        n_worst = math.ceil(self.model.risk_level * len(futures.costs))
        return futures.costs[:n_worst].mean().item()

    @property
    def risk(self) -> float:
        """Gamma of the chosen action as the critics see it, to be compared with ``model.penalty.budget``."""
        return self.model.risk(self.model.policy.average.world_model.features(self._state), self._state.action).item()
