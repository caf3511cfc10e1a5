"""What the world model reads off a latent state: reward, cost and whether the episode goes on."""

import torch as th
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits

from sb3_esad.common.functional import correct_logit
from sb3_esad.common.torch_layers import GridReadout, GridShape, SparseReadout, mlp
from sb3_esad.common.transforms import symexp, twohot_decode, twohot_encode
from sb3_esad.common.type_aliases import Predictions, TensorLogs


class ValueDistribution(nn.Module):
    """
    Categorical distribution of a real number over bins that are dense near zero (DreamerV3, arXiv 2301.04104).

    :param n_bins: odd number of bins, so that zero is one of them
    :param limit: the outermost bins stand for +-(exp(limit) - 1)
    """

    bins: th.Tensor

    def __init__(self, n_bins: int = 101, limit: float = 10.0) -> None:
        super().__init__()
        self.n_bins = n_bins
        self.register_buffer("bins", symexp(th.linspace(-limit, limit, n_bins)), persistent=False)

    def mean(self, logits: th.Tensor) -> th.Tensor:
        """
        Expected number.

        :param logits: shape (..., n_bins)
        :return: shape (...)
        """
        return twohot_decode(logits.float().softmax(-1), self.bins)

    def loss(self, logits: th.Tensor, values: th.Tensor) -> th.Tensor:
        """
        Cross-entropy with the distribution whose mean is the value.

        :param logits: shape (..., n_bins)
        :param values: shape (...)
        :return: shape (...)
        """
        return -(twohot_encode(values, self.bins) * logits.float().log_softmax(-1)).sum(-1)


class PredictionHeads(nn.Module):
    """
    Predict reward, cost and continuation from the state that was reached.

    :param grid_shape: shape of the latent grid (C, H, W)
    :param units: units of the hidden layers
    :param cost_weight: weight of a cost event in the binary cross-entropy, undone in the predicted probability
    :param sparsity_weight: price of looking at a cell, of those that foretell cost and end
    """

    def __init__(self, grid_shape: GridShape, units: int, cost_weight: float, sparsity_weight: float) -> None:
        super().__init__()
        self.cost_weight = cost_weight
        self.sparsity_weight = sparsity_weight
        self.distribution = ValueDistribution()
        self.readout = GridReadout(grid_shape, units)
        self.reward = mlp(units, [units], self.distribution.n_bins, zero_output=True)
        # A single cell leaves nothing to choose
        spatial = grid_shape[1] * grid_shape[2] > 1
        self.event_readout = SparseReadout(grid_shape, units) if spatial else GridReadout(grid_shape, units)
        hidden = [] if spatial else [units]
        self.cost = mlp(units, hidden, 1)
        self.going_on = mlp(units, hidden, 1)

    def forward(self, grid: th.Tensor) -> Predictions:
        """
        Predict expected values.

        :param grid: latent states, of shape (N, C, H, W)
        :return: fields of shape (N,)
        """
        reward, cost, going_on = self._logits(grid)
        cost = correct_logit(cost, self.cost_weight)
        return Predictions(self.distribution.mean(reward), cost.sigmoid(), going_on.sigmoid())

    def loss(self, grid: th.Tensor, targets: Predictions, event_weights: th.Tensor) -> tuple[th.Tensor, TensorLogs]:
        """
        Fit the heads to what was recorded.

        :param grid: latent states, of shape (N, C, H, W)
        :param targets: recorded values, fields of shape (N,)
        :param event_weights: importance of each state for cost and continuation, of shape (N,)
        :return: scalar loss, and its terms
        """
        reward, cost, going_on = self._logits(grid)
        positive = cost.new_full((), self.cost_weight)
        cost_loss = binary_cross_entropy_with_logits(cost, targets.costs, reduction="none", pos_weight=positive)
        terms = {
            "reward_loss": self.distribution.loss(reward, targets.rewards).mean(),
            "cost_loss": (event_weights * cost_loss).mean(),
            "continue_loss": (
                event_weights * binary_cross_entropy_with_logits(going_on, targets.continues, reduction="none")
            ).mean(),
            "sparsity_loss": self.sparsity_weight * self.event_readout.price(),
        }
        return th.stack(list(terms.values())).sum(), {name: term.detach() for name, term in terms.items()}

    def _logits(self, grid: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        events = self.event_readout(grid)
        reward, cost, going_on = self.reward(self.readout(grid)), self.cost(events), self.going_on(events)
        return reward, cost.float().squeeze(-1), going_on.float().squeeze(-1)
