"""The stochastic part of the latent state: what a memory expects (prior) and what an observation adds (posterior)."""

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch as th
from torch import nn

from sb3_esad.common.checks import require
from sb3_esad.common.torch_layers import ChannelNorm, GridShape, SameConv2d, conv_block, kernel_size
from sb3_esad.common.type_aliases import TensorLogs

MIN_STD = 0.1


class Gaussian(NamedTuple):
    """
    Diagonal normal distribution over latents.

    :param mean: shape (..., C, H, W)
    :param std: shape of ``mean``
    """

    mean: th.Tensor
    std: th.Tensor

    def sample(self, generator: th.Generator | None = None) -> th.Tensor:
        """
        Draw a reparameterised sample.

        :param generator: of the noise; torch's global one if there is none
        :return: shape of ``mean``
        """
        # Noise with the channels last in memory, as everything else on the grid
        noise = th.randn(self.mean.movedim(-3, -1).shape, device=self.mean.device, generator=generator).movedim(-1, -3)
        return self.mean + self.std * noise

    def detach(self) -> "Gaussian":
        """
        Cut the gradient.

        :return: the same distribution as a constant
        """
        return Gaussian(self.mean.detach(), self.std.detach())


def kl_divergence(q: Gaussian, p: Gaussian) -> th.Tensor:
    """
    Kullback-Leibler divergence KL(q || p), summed over channels and cells.

    :param q: shape (..., C, H, W)
    :param p: shape of ``q``
    :return: divergence in nats, of shape (...)
    """
    ratio = (q.std / p.std).square()
    return 0.5 * (ratio + ((q.mean - p.mean) / p.std).square() - 1 - ratio.log()).sum((-3, -2, -1))


class LatentHead(nn.Module, ABC):
    """Distribution of the latent given the memory, with or without an observation."""

    @abstractmethod
    def prior(self, memory: th.Tensor) -> Gaussian:
        """
        Expect a latent before the observation is seen.

        :param memory: h, of shape (N, C, H, W)
        :return: p(z | h)
        """

    @abstractmethod
    def embed(self, features: th.Tensor) -> th.Tensor:
        """
        Prepare the features of observations for :meth:`posterior`, all steps at once.

        :param features: of shape (N, E, H, W)
        :return: embeddings, of shape (N, C', H, W)
        """

    @abstractmethod
    def posterior(self, memory: th.Tensor, embedding: th.Tensor) -> Gaussian:
        """
        Infer the latent from memory and observation.

        :param memory: h, of shape (N, C, H, W)
        :param embedding: what :meth:`embed` made of the observation, of shape (N, C', H, W)
        :return: q(z | h, o)
        """

    @abstractmethod
    def sample(
        self,
        memory: th.Tensor,
        embedding: th.Tensor | None = None,
        n_candidates: int = 1,
        generator: th.Generator | None = None,
    ) -> th.Tensor:
        """
        Draw candidate latents, from the prior or, given an observation, from the posterior.

        :param memory: h, of shape (N, C, H, W)
        :param embedding: what :meth:`embed` made of the observation, of shape (N, C', H, W)
        :param n_candidates: how many latents to draw for each memory
        :param generator: of the noise; torch's global one if there is none
        :return: latents, of shape (n_candidates * N, C, H, W), candidates first
        """

    @abstractmethod
    def loss(
        self,
        posterior: Gaussian,
        prior: Gaussian,
        memory: th.Tensor,
        embedding: th.Tensor,
        generator: th.Generator | None = None,
    ) -> tuple[th.Tensor, TensorLogs]:
        """
        Fit prior and posterior to each other, and whatever else the head draws its latents with.

        :param posterior: q(z | h, o), of shape (..., C, H, W)
        :param prior: p(z | h), of the same shape
        :param memory: h, from which both were inferred, of shape (..., C', H, W)
        :param embedding: what :meth:`embed` made of the observation, of shape (..., C'', H, W)
        :param generator: of all that is drawn; torch's global one if there is none
        :return: scalar loss, and what to log
        """

    def settle(self) -> None:
        """
        Take over what :meth:`loss` has found about scales, once the network has been moved.

        Not in ``loss`` itself: that may be computed while another thread draws samples (:meth:`LatentAlgorithm.train`).
        """


class GaussianHead(LatentHead):
    """
    Gaussian prior and posterior, kept together by a balanced KL (DreamerV2, arXiv 2010.02193, Eq. 2).

    :param memory_shape: shape of the memory (C, H, W)
    :param embedding_channels: channels of the observation's features
    :param latent_channels: channels of the latent
    :param hidden_channels: units of the hidden layer in each cell
    :param dynamics_scale: weight of the KL that moves the prior
    :param representation_scale: weight of the KL that moves the posterior
    :param free_nats: divergence below which neither is moved
    :param temperature: factor of the prior's standard deviation in :meth:`LatentHead.sample`, so in imagination, in [0, 1]; 0
        takes the prior's mean. Where training withholds an observation, all of it is drawn (docs/experiments.md, section 32)
    :raises ValueError: if ``temperature`` is out of its range
    """

    def __init__(
        self,
        memory_shape: GridShape,
        embedding_channels: int,
        latent_channels: int,
        hidden_channels: int,
        dynamics_scale: float = 0.5,
        representation_scale: float = 0.1,
        free_nats: float = 1.0,
        temperature: float = 1.0,
    ) -> None:
        super().__init__()
        require(0 <= temperature <= 1, "temperature", temperature, "a factor in [0, 1]")
        kernel = kernel_size(memory_shape)
        self.scales = (dynamics_scale, representation_scale)
        self.free_nats = free_nats
        self.temperature = temperature
        self.embedding_net = SameConv2d(embedding_channels, hidden_channels, 1)
        self.memory_net = SameConv2d(memory_shape[0], hidden_channels, kernel)
        self.prior_net = nn.Sequential(
            conv_block(memory_shape[0], hidden_channels, kernel), SameConv2d(hidden_channels, 2 * latent_channels, 1)
        )
        self.posterior_net = nn.Sequential(
            ChannelNorm(hidden_channels), nn.SiLU(), SameConv2d(hidden_channels, 2 * latent_channels, 1)
        )

    def prior(self, memory: th.Tensor) -> Gaussian:
        return self._gaussian(self.prior_net(memory))

    def embed(self, features: th.Tensor) -> th.Tensor:
        return self.embedding_net(features)

    def posterior(self, memory: th.Tensor, embedding: th.Tensor) -> Gaussian:
        return self._gaussian(self.posterior_net(self.memory_net(memory) + embedding))

    def sample(
        self,
        memory: th.Tensor,
        embedding: th.Tensor | None = None,
        n_candidates: int = 1,
        generator: th.Generator | None = None,
    ) -> th.Tensor:
        if embedding is None:
            prior = self.prior(memory)
            gaussian = prior._replace(std=self.temperature * prior.std)
        else:
            gaussian = self.posterior(memory, embedding)
        return Gaussian(*(th.cat([parameter] * n_candidates) for parameter in gaussian)).sample(generator)

    def loss(
        self,
        posterior: Gaussian,
        prior: Gaussian,
        memory: th.Tensor,
        embedding: th.Tensor,
        generator: th.Generator | None = None,
    ) -> tuple[th.Tensor, TensorLogs]:
        dynamics = kl_divergence(posterior.detach(), prior)
        representation = kl_divergence(posterior, prior.detach())
        terms = (dynamics, representation)
        loss = sum(scale * kl.clamp(min=self.free_nats).mean() for scale, kl in zip(self.scales, terms, strict=True))
        return th.as_tensor(loss), {"kl": dynamics.mean().detach()}

    @staticmethod
    def _gaussian(parameters: th.Tensor) -> Gaussian:
        mean, std = parameters.float().chunk(2, 1)
        return Gaussian(mean, nn.functional.softplus(std) + MIN_STD)
