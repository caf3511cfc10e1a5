"""The network of the diffusion model."""

import torch as th
from torch import nn

from sb3_esad.common.torch_layers import ChannelNorm, GridShape, SameConv2d, conv_block, dense_block, kernel_size


class ResidualBlock(nn.Module):
    """
    A perceptron in each cell, added to its input.

    :param channels: of input and output
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.net = nn.Sequential(
            ChannelNorm(channels), SameConv2d(channels, channels, 1), nn.SiLU(), SameConv2d(channels, channels, 1)
        )

    def forward(self, grid: th.Tensor) -> th.Tensor:
        """
        Refine features.

        :param grid: shape (N, C, H, W)
        :return: shape of ``grid``
        """
        return grid + self.net(grid)


class Denoiser(nn.Module):
    """
    D(x, sigma; h, e): what a noisy latent was before the noise, with the preconditioning of EDM (arXiv 2206.00364, Table 1).

    :param memory_shape: shape of the memory (C, H, W)
    :param embedding_channels: channels of an embedded observation
    :param latent_channels: channels of the latent
    :param channels: units of the hidden layers in each cell
    """

    def __init__(self, memory_shape: GridShape, embedding_channels: int, latent_channels: int, channels: int) -> None:
        super().__init__()
        kernel = kernel_size(memory_shape)
        self.memory_net = conv_block(memory_shape[0], channels, kernel)
        self.embedding_net = SameConv2d(embedding_channels, channels, 1, bias=False)  # zeros are no observation
        self.level_net = dense_block(1, channels)
        self.latent_net = SameConv2d(latent_channels, channels, kernel)
        self.blocks = nn.Sequential(ResidualBlock(channels), ChannelNorm(channels), nn.SiLU())
        self.output = SameConv2d(channels, latent_channels, 1)
        for parameter in self.output.parameters():
            nn.init.zeros_(parameter)

    def context(self, memory: th.Tensor, embedding: th.Tensor | None) -> th.Tensor:
        """
        Prepare what all steps of a sample have in common.

        :param memory: h, of shape (N, C, H, W)
        :param embedding: of the observation, of shape (N, C', H, W), zeros where it is not given; None for none at all
        :return: shape (N, channels, H, W)
        """
        context = self.memory_net(memory)
        return context if embedding is None else context + self.embedding_net(embedding)

    def forward(self, noisy: th.Tensor, level: th.Tensor, scale: th.Tensor, context: th.Tensor) -> th.Tensor:
        """
        Estimate the latent without its noise.

        :param noisy: shape (N, C, H, W)
        :param level: sigma, standard deviation of the noise, of shape (N,)
        :param scale: sigma_d, root mean square of the latents without noise
        :param context: what :meth:`context` made of memory and observation
        :return: shape of ``noisy``
        """
        sigma = level[:, None, None, None]
        total = (sigma**2 + scale**2).sqrt()
        common = self.level_net((level.log() / 4)[:, None])[..., None, None]
        hidden = self.latent_net(noisy / total) + context + common
        change = self.output(self.blocks(hidden)).float()
        return (scale / total) ** 2 * noisy + sigma * scale / total * change
