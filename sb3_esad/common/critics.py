"""Critics: an ensemble for the reward, mean and variance for the cost."""

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_esad.common.functional import capped_cvar, sampled_variance_target
from sb3_esad.common.heads import ValueDistribution
from sb3_esad.common.torch_layers import LearningModule, Readout, dense_block, mlp

MIN_VARIANCE = 1e-4


class StateActionFeatures(nn.Module):
    """
    Summary of a state beside its action, in as many numbers each.

    What an action does in a single step is little, and as a few numbers beside hundreds it would be learned last.

    :param readout: summary of a state
    :param action_dim: length of the action
    """

    def __init__(self, readout: Readout, action_dim: int) -> None:
        super().__init__()
        self.readout = readout
        self.embed_action = dense_block(action_dim, readout.features_dim)
        self.features_dim = 2 * readout.features_dim

    def forward(self, state: PyTorchObs, action: th.Tensor) -> th.Tensor:
        """
        Summarise.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :return: shape (N, features_dim)
        """
        return th.cat([self.readout(state), self.embed_action(action)], dim=1)


class QEnsemble(LearningModule):
    """
    Several critics of the discounted return on one readout, as SB3's critics share a features extractor.

    :param readout: summary of a state
    :param action_dim: length of the action
    :param net_arch: hidden layers of each critic
    :param n_critics: size of the ensemble
    """

    scale: th.Tensor

    def __init__(self, readout: Readout, action_dim: int, net_arch: list[int], n_critics: int = 2) -> None:
        super().__init__()
        self.distribution = ValueDistribution()
        self.features = StateActionFeatures(readout, action_dim)
        self.q_networks = nn.ModuleList(
            mlp(self.features.features_dim, net_arch, self.distribution.n_bins, zero_output=True) for _ in range(n_critics)
        )
        self.register_buffer("scale", th.tensor(1.0))

    @th.no_grad()
    def follow_scale(self, returns: th.Tensor, rate: float = 0.01) -> None:
        """
        Keep track of how much returns differ, so that the actor sees them at a common scale (DreamerV3, Eq. 7).

        :param returns: any shape
        :param rate: share of the new value in the moving average
        """
        rank = th.linspace(0.05, 0.95, 2, device=returns.device)  # made there: an upload would wait for a GPU
        low, high = th.quantile(returns.float(), rank)
        self.scale.add_(rate * ((high - low) - self.scale)).clamp_(min=1.0)

    def logits(self, state: PyTorchObs, action: th.Tensor) -> th.Tensor:
        """
        Distributions of the return.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :return: shape (n_critics, N, n_bins)
        """
        features = self.features(state, action)
        return th.stack([q_network(features) for q_network in self.q_networks])

    def forward(self, state: PyTorchObs, action: th.Tensor) -> th.Tensor:
        """
        Expected return.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :return: one estimate of each critic, of shape (n_critics, N)
        """
        return self.distribution.mean(self.logits(state, action))

    def loss(self, state: PyTorchObs, action: th.Tensor, targets: th.Tensor) -> th.Tensor:
        """
        Cross-entropy of each critic with the targets, summed over critics.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :param targets: returns, of shape (N,)
        :return: shape (N,)
        """
        return self.distribution.loss(self.logits(state, action), targets.expand(len(self.q_networks), -1)).sum(0)


class CostTargets(NamedTuple):
    """
    Mean and variance of the discounted cost.

    :param means: shape (N,)
    :param variances: shape (N,)
    """

    means: th.Tensor
    variances: th.Tensor


class CostCritic(LearningModule):
    """
    Mean and variance of the discounted cost: an ensemble for the mean, one network for the variance.

    :param readout: summary of a state
    :param action_dim: length of the action
    :param net_arch: hidden layers of each critic
    :param n_critics: size of the ensemble of means
    """

    bound: th.Tensor

    def __init__(self, readout: Readout, action_dim: int, net_arch: list[int], n_critics: int = 2) -> None:
        super().__init__()
        self.features = StateActionFeatures(readout, action_dim)
        self.means = nn.ModuleList(mlp(self.features.features_dim, net_arch, 1) for _ in range(n_critics))
        self.variance = mlp(self.features.features_dim, net_arch, 1)
        # Costs are rare: to start near zero saves the first thousand updates
        for network in (*self.means, self.variance):
            nn.init.constant_(network[-1].bias, -4.0)
        self.register_buffer("bound", th.tensor(1.0))

    @th.no_grad()
    def raise_bound(self, bound: float) -> None:
        """
        Make room for discounted costs above one, as they occur where an episode goes on after a cost.

        :param bound: the largest discounted cost that is possible
        """
        raised = self.bound.clamp(min=bound)
        for network in self.means:
            *_, output_bias = network.parameters()
            output_bias.sub_(th.log(raised / self.bound))  # so that small estimates stay what they are
        self.bound.copy_(raised)

    def forward(self, state: PyTorchObs, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Mean and variance of the discounted cost.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :return: means of shape (n_critics, N), variance of shape (N,)
        """
        logits, variance = self.raw(state, action)
        return self.bound * logits.sigmoid(), variance

    def risk(self, means: th.Tensor, variance: th.Tensor, risk_level: float) -> th.Tensor:
        """
        Safety measure Gamma by the more pessimistic mean: pessimism belongs to decisions, not to targets.

        :param means: shape (n_critics, N)
        :param variance: shape (N,)
        :param risk_level: worst fraction of outcomes, in (0, 1]
        :return: conditional value at risk of the cost to come, of shape (N,)
        """
        return capped_cvar(means, variance, risk_level, self.bound).max(0).values

    def raw(self, state: PyTorchObs, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        What the losses are taken on: logits of mean / bound, and the variance.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :return: logits of shape (n_critics, N), variance of shape (N,)
        """
        features = self.features(state, action)
        logits = th.stack([network(features).float().squeeze(-1) for network in self.means])
        variance = nn.functional.softplus(self.variance(features).float().squeeze(-1)) + MIN_VARIANCE
        return logits, variance

    def loss(
        self, state: PyTorchObs, action: th.Tensor, mean_targets: th.Tensor, variance_targets: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Cross-entropy of the means and squared error of the variance.

        Not the 2-Wasserstein distance of arXiv 2407.06317: on sampled targets it converges to a fraction of the true
        deviation.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :param mean_targets: discounted costs, of shape (N,)
        :param variance_targets: their variance, of shape (N,)
        :return: loss of the means summed over critics, and of the variance, each of shape (N,)
        """
        logits, variance = self.raw(state, action)
        fractions = (mean_targets / self.bound).clamp(0, 1).expand_as(logits)
        mean_loss = nn.functional.binary_cross_entropy_with_logits(logits, fractions, reduction="none").sum(0)
        return mean_loss, (variance - variance_targets).square()

    @th.no_grad()
    def targets(
        self,
        taken: tuple[PyTorchObs, th.Tensor],
        reached: tuple[PyTorchObs, th.Tensor],
        costs: th.Tensor,
        continues: th.Tensor,
        gamma: float,
    ) -> CostTargets:
        """
        One-step targets from what really happened, bootstrapped by the mean of the estimates.

        :param taken: N states and the actions executed in them
        :param reached: the states that followed and the actions of the present policy in them
        :param costs: of the steps, of shape (N,)
        :param continues: 0 where a step ended in a terminal state, of shape (N,)
        :param gamma: discount of the cost
        :return: fields of shape (N,)
        """
        next_means, next_variance = self(*reached)
        next_mean, mean = next_means.mean(0), self(*taken)[0].mean(0)
        return CostTargets(
            costs + gamma * continues * next_mean,
            sampled_variance_target(costs, continues, mean, next_mean, next_variance, gamma),
        )
