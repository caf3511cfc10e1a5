"""The actor: a squashed Gaussian over actions given the latent state."""

import torch as th
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from torch.distributions import Normal

from sb3_esad.common.torch_layers import GridReadout, GridShape, LearningModule, mlp

LOG_STD_MIN, LOG_STD_MAX = -3.0, 1.0


class SquashedGaussian(SquashedDiagGaussianDistribution):
    """SB3's distribution without torch's checks of parameters, for which a GPU would be waited for at each imagined step."""

    def proba_distribution(self, mean_actions: th.Tensor, log_std: th.Tensor) -> "SquashedGaussian":
        self.distribution = Normal(mean_actions, log_std.exp(), validate_args=False)
        return self


class Actor(LearningModule):
    """
    Policy on latent states, in actions scaled to [-1, 1].

    :param grid_shape: shape of the latent grid (C, H, W)
    :param action_dim: length of the action
    :param net_arch: hidden layers; the first entry is the length of the readout too
    """

    def __init__(self, grid_shape: GridShape, action_dim: int, net_arch: list[int]) -> None:
        super().__init__()
        self.action_dim = action_dim
        self.readout = GridReadout(grid_shape, net_arch[0])
        self.mean_log_std_net = mlp(net_arch[0], net_arch[1:], 2 * action_dim, zero_output=True)

    def forward(self, grid: th.Tensor, deterministic: bool = False) -> th.Tensor:
        """
        Choose actions.

        :param grid: features of N states, of shape (N, C, H, W)
        :param deterministic: take the mode instead of a sample
        :return: shape (N, A)
        """
        return self._distribution().actions_from_params(*self._mean_log_std(grid), deterministic=deterministic)

    def action_log_prob(self, grid: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        Draw reparameterised actions.

        :param grid: features of N states, of shape (N, C, H, W)
        :return: actions of shape (N, A), and their log-density of shape (N,)
        """
        return self._distribution().log_prob_from_params(*self._mean_log_std(grid))

    def _distribution(self) -> SquashedGaussian:
        return SquashedGaussian(self.action_dim)

    def _mean_log_std(self, grid: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        mean, spread = self.mean_log_std_net(self.readout(grid)).float().chunk(2, dim=1)
        # Smooth bounds keep a gradient where a clamp would have none
        return mean, LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (th.tanh(spread) + 1)
