"""What the latest training episodes have cost, beside what was predicted."""

import math

import numpy as np
import torch as th
from torch import nn

from sb3_esad.common.costs import EpisodeCosts, FinishedEpisode
from sb3_esad.common.functional import capped_cvar


class EpisodeRecord(nn.Module):
    """
    Ring of the latest episodes; it is part of the saved model, hence made of float buffers.

    :param cost_gamma: discount of the costs
    :param episode_length: in steps, assumed until cost-free episodes have been seen
    :param window: number of episodes remembered
    :param road_steps: steps over which the present cost rate is averaged
    """

    costs: th.Tensor
    discounted_costs: th.Tensor
    n_episodes: th.Tensor
    n_cost_free: th.Tensor
    mean_length: th.Tensor
    prediction_sum: th.Tensor
    prediction_weight: th.Tensor

    cost_rate: th.Tensor
    rate_weight: th.Tensor

    prediction_decay = 0.99

    def __init__(self, cost_gamma: float, episode_length: float, window: int, road_steps: int = 2000) -> None:
        super().__init__()
        self.window = window
        self.road_steps = road_steps
        self._under_way = EpisodeCosts(cost_gamma)  # not saved: another number of environments may follow
        self.register_buffer("costs", th.zeros(window))
        self.register_buffer("discounted_costs", th.zeros(window))
        self.register_buffer("n_episodes", th.zeros(()))
        self.register_buffer("n_cost_free", th.zeros(()))
        self.register_buffer("mean_length", th.tensor(float(episode_length)))
        self.register_buffer("cost_rate", th.zeros(()))
        self.register_buffer("rate_weight", th.zeros(()))
        self.register_buffer("prediction_sum", th.zeros(()))
        self.register_buffer("prediction_weight", th.zeros(()))

    @property
    def size(self) -> int:
        """Number of episodes remembered."""
        return min(int(self.n_episodes), self.window)

    @property
    def episode_length(self) -> float:
        """Mean length of the cost-free episodes; a crash shortens its episode and would make the budget look larger."""
        return max(self.mean_length.item(), 1.0)

    def observe(self, costs: np.ndarray, dones: np.ndarray) -> None:
        """
        Add one step of all environments.

        :param costs: (n_envs,)
        :param dones: (n_envs,)
        """
        share = min(len(costs) / self.road_steps, 1.0)
        self.cost_rate += share * (float(np.mean(costs)) - self.cost_rate)
        self.rate_weight += share * (1.0 - self.rate_weight)
        for episode in self._under_way.add(costs, dones):
            self._remember(episode)

    def forget_unfinished(self) -> None:
        """Drop the episodes under way, for the environments have been reset."""
        self._under_way.clear()

    def _remember(self, episode: FinishedEpisode) -> None:
        slot = int(self.n_episodes) % self.window
        self.costs[slot] = episode.cost
        self.discounted_costs[slot] = episode.discounted_cost
        self.n_episodes += 1
        if episode.cost == 0:
            self.n_cost_free += 1
            self.mean_length += (episode.length - self.mean_length) / self.n_cost_free.clamp(max=self.window)

    @th.no_grad()
    def note_prediction(self, values: th.Tensor) -> None:
        """
        Add what the critic expects of whole episodes to a moving average.

        :param values: discounted costs expected at episode starts, may be empty
        """
        if values.numel() > 0:
            share = 1.0 - self.prediction_decay
            self.prediction_sum += share * (values.mean() - self.prediction_sum)
            self.prediction_weight += share * (1.0 - self.prediction_weight)

    @property
    def has_prediction(self) -> bool:
        """Whether there has been any prediction."""
        return self.prediction_weight.item() > 0.0

    def calibration(self, epsilon: float) -> float:
        """
        Ratio of the predicted to the observed discounted cost of an episode.

        :param epsilon: > 0, added to both, so that rare costs do not make the ratio jump
        :return: the ratio, 1 as long as there is neither
        """
        predicted = self.prediction_sum.item() / max(self.prediction_weight.item(), 1e-8)
        observed = self.discounted_costs[: self.size].mean().item() if self.size else 0.0
        return (predicted + epsilon) / (observed + epsilon)

    @property
    def seen(self) -> float:
        """How full the moving average of the cost rate is, from 0 to 1."""
        return self.rate_weight.item()

    @property
    def expected_cost(self) -> float:
        """
        Cost of an episode of full length at the present rate.

        Not the mean of the latest episodes: once the agent drives well, each lasts long, and crashes of a policy that is gone
        would count for thousands of steps.
        """
        return self.cost_rate.item() / max(self.rate_weight.item(), 1e-8) * self.episode_length

    def tail_cost(self, risk_level: float) -> float:
        """
        Conditional value at risk of the episode cost at the present rate.

        :param risk_level: alpha in (0, 1]
        :return: capped CVaR with the spread of the remembered episodes
        """
        variance = self.costs[: max(self.size, 1)].var(correction=0)
        mean = th.as_tensor(self.expected_cost)
        return capped_cvar(mean, variance.to(mean.device), risk_level, math.inf).item()
