"""What the latest steps and episodes of the training have cost, beside what was predicted."""

import math

import numpy as np
import torch as th
from torch import nn

from sb3_esad.common.costs import EpisodeCosts, FinishedEpisode
from sb3_esad.common.functional import capped_cvar
from sb3_esad.common.recent_sums import RecentSums


class EpisodeRecord(nn.Module):
    """
    What the present policy costs; it is part of the saved model, hence made of buffers.

    :param cost_gamma: discount of the costs
    :param episode_length: in steps, assumed until an episode has ended otherwise than by a cost
    :param window: number of episodes remembered for the spread of their costs
    :param road_steps: steps over which cost and predictions are averaged; more if two episodes of each environment are longer
    """

    costs: th.Tensor
    n_episodes: th.Tensor
    n_ended: th.Tensor
    mean_length: th.Tensor
    timeouts: th.Tensor

    def __init__(self, cost_gamma: float, episode_length: float, window: int, road_steps: int = 2000) -> None:
        super().__init__()
        self.cost_gamma = cost_gamma
        self.window = window
        self.road_steps = road_steps
        self.recent = RecentSums(("costs", "costs_to_come", "predicted", "predictions"), road_steps)
        self.register_buffer("costs", th.zeros(window))
        self.register_buffer("n_episodes", th.zeros(()))
        self.register_buffer("n_ended", th.zeros(()))
        self.register_buffer("mean_length", th.tensor(float(episode_length)))
        self.register_buffer("timeouts", th.zeros(()))
        self.forget_unfinished()

    def forget_unfinished(self) -> None:
        """Drop the episodes under way, for the environments have been reset; they are not saved either."""
        self._under_way = EpisodeCosts()
        self._weights = np.zeros(0)
        self._whole = np.zeros(0, dtype=bool)

    @property
    def size(self) -> int:
        """Number of episodes remembered."""
        return min(int(self.n_episodes), self.window)

    @property
    def episode_length(self) -> float:
        """Mean length of the episodes that no cost has ended, for a crash would make the budget look larger."""
        return max(self.mean_length.item(), 1.0)

    def observe(self, costs: np.ndarray, dones: np.ndarray, truncated: np.ndarray | None = None) -> None:
        """
        Add one step of all environments.

        :param costs: (n_envs,)
        :param dones: (n_envs,)
        :param truncated: (n_envs,), whether only time was up; None for none
        """
        if len(costs) != len(self._weights):
            self._weights = np.zeros(len(costs))
        if len(costs) != len(self._whole):
            self._whole = np.ones(len(costs), dtype=bool)
        # Environments in step with each other would else show many steps of the same part of an episode
        self.recent.length.fill_(max(self.road_steps, math.ceil(2 * self._steps_of_episodes)))
        timed_out = np.zeros(len(costs), dtype=bool) if truncated is None else np.asarray(truncated, dtype=bool)
        # A cost counts in the discounted cost to come of every earlier step of its episode: 1 + gamma + gamma^2 + ...
        self._weights = 1.0 + self.cost_gamma * self._weights
        self.recent.add(len(costs), costs=costs.sum(), costs_to_come=(self._weights * costs).sum())
        self._weights[np.asarray(dones, dtype=bool) & ~timed_out] = 0.0  # critics look beyond a time limit as well
        for episode in self._under_way.add(costs, dones):
            if self._whole[episode.env]:
                self._remember(episode, bool(costs[episode.env] > 0), bool(timed_out[episode.env]))
            self._whole[episode.env] = True

    def pass_over(self, dones: np.ndarray) -> None:
        """
        Let a step of random actions go by; an episode that began with them is never remembered, for it is no whole one.

        :param dones: (n_envs,)
        """
        self._whole = np.array(dones, dtype=bool)

    def _remember(self, episode: FinishedEpisode, costs: bool, timed_out: bool) -> None:
        self.costs[int(self.n_episodes) % self.window] = episode.cost
        self.n_episodes += 1
        if timed_out or not costs:
            self.n_ended += 1
            counted = self.n_ended.clamp(max=self.window)
            self.mean_length += (episode.length - self.mean_length) / counted
            self.timeouts += (float(timed_out) - self.timeouts) / counted

    @th.no_grad()
    def note_prediction(self, values: th.Tensor) -> None:
        """
        Add what the critic expects where the policy is.

        :param values: discounted costs to come, one for each environment
        """
        self.recent.add(0, predicted=values.sum().item(), predictions=len(values))

    @property
    def has_prediction(self) -> bool:
        """Whether there has been any prediction lately."""
        return self.recent["predictions"] > 0

    def calibration(self, epsilon: float) -> float:
        """
        Ratio of the predicted to the observed discounted cost to come, on the states lately visited.

        :param epsilon: > 0, added to both, so that rare costs do not make the ratio jump
        :return: the ratio, 1 as long as there is neither
        """
        return (self.predicted + epsilon) / (self.observed + epsilon)

    @property
    def predicted(self) -> float:
        """Mean discounted cost to come that has lately been expected."""
        return self.recent["predicted"] / max(self.recent["predictions"], 1.0)

    @property
    def observed(self) -> float:
        """Mean discounted cost to come of the steps lately made, as far as it has come."""
        return self.recent["costs_to_come"] / max(self.recent["steps"], 1.0)

    @property
    def _steps_of_episodes(self) -> float:
        """Steps of all environments in which each of them drives an episode of usual length."""
        return len(self._weights) * self.episode_length

    @property
    def seen(self) -> float:
        """How many of the ``road_steps`` have been seen, from 0 to 1."""
        return min(self.recent["steps"] / (self.road_steps * (1 - 1 / len(self.recent.blocks))), 1.0)

    @property
    def has_seen_episodes(self) -> bool:
        """Whether enough steps have been seen for an episode of each environment."""
        return self.recent["steps"] >= self._steps_of_episodes

    @property
    def expected_cost(self) -> float:
        """
        Cost of an episode of usual length at the present rate.

        Not the mean of the latest episodes: once the agent drives well, each lasts long, and crashes of a policy that is gone
        would count for thousands of steps.
        """
        return self.recent["costs"] / max(self.recent["steps"], 1.0) * self.episode_length

    @property
    def resolution(self) -> float:
        """Cost of an episode of usual length if a single cost of 1 had fallen into the latest steps."""
        return self.episode_length / max(self.recent["steps"], 1.0)

    def tail_cost(self, risk_level: float) -> float:
        """
        Conditional value at risk of the episode cost at the present rate.

        :param risk_level: alpha in (0, 1]
        :return: capped CVaR with the spread of the remembered episodes
        """
        variance = self.costs[: max(self.size, 1)].var(correction=0)
        mean = th.as_tensor(self.expected_cost)
        return capped_cvar(mean, variance.to(mean.device), risk_level, math.inf).item()
