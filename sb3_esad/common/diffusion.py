"""What a Gaussian cannot expect, such as a car that turns left or right: its prior refined by a few steps of diffusion."""

import math
from typing import Any, NamedTuple

import torch as th

from sb3_esad.common.checks import require
from sb3_esad.common.denoiser import Denoiser
from sb3_esad.common.latents import Gaussian, GaussianHead, LatentHead
from sb3_esad.common.target_networks import make_target, update_target
from sb3_esad.common.torch_layers import GridShape
from sb3_esad.common.type_aliases import TensorLogs

MOST_STEPS = 1000
"""Far more than a sample ever gains from."""
LEVEL_RATIO = 0.4
"""Of each noise level to the one before."""
TAU = 0.01
"""Share of an update in the running averages."""


def noise_levels(start: float | th.Tensor, steps: int) -> list[th.Tensor]:
    """
    Levels from which a sampler takes its steps.

    :param start: the highest standard deviation
    :param steps: K
    :return: K falling standard deviations
    """
    return [th.as_tensor(start * LEVEL_RATIO**step) for step in range(steps)]


def gaussian_denoiser(noisy: th.Tensor, level: th.Tensor, mean: th.Tensor, variance: th.Tensor) -> th.Tensor:
    """
    Best estimate of a residual that is Gaussian.

    :param noisy: residual plus noise, of shape (N, C, H, W)
    :param level: standard deviation of the noise
    :param mean: of the residual, broadcastable to ``noisy``
    :param variance: of the residual, likewise
    :return: the estimate, of the shape of ``noisy``
    """
    return mean + variance / (variance + level**2) * (noisy - mean)


class Gauges(NamedTuple):
    """
    What a batch says of the residual and of those who estimate it.

    :param residual_scale: its root mean square
    :param residual_mean: its mean in each cell, of shape (C, H, W)
    :param residual_square: its mean square in each cell, of shape (C, H, W)
    :param posterior_std: mean spread of the posterior, of shape (C, H, W)
    :param advantage: share of the squared error of the best Gaussian estimate that the denoiser saves
    """

    residual_scale: th.Tensor
    residual_mean: th.Tensor
    residual_square: th.Tensor
    posterior_std: th.Tensor
    advantage: th.Tensor


class DiffusionHead(GaussianHead):
    """
    Gaussian prior and posterior, and a diffusion model of what lies between their means.

    The model learns the residual r = mu_q - mu_p from noisy copies of it (EDM, arXiv 2206.00364), as a function of the memory
    and, in half of the cases, of the observation. Samples of the prior start from the Gaussian's own, noised, and take
    ``diffusion_steps`` steps that end at the posterior's spread and not at zero: few steps from little noise are worth more
    than few steps from pure noise (truncated diffusion). It is learned beside the Gaussians, which never see its gradient,
    and sampled by its average over the last updates.

    Until the denoiser foresees residuals better than any that takes them for Gaussian, as the prior expects them or as they
    usually are, the head samples as a :class:`GaussianHead`.

    :param memory_shape: shape of the memory (C, H, W)
    :param embedding_channels: channels of the observation's features
    :param latent_channels: channels of the latent
    :param hidden_channels: units of the hidden layers in each cell
    :param diffusion_steps: K, steps of a sample
    :param start_level: noise that a sample of the prior starts with, in root mean squares of the residual
    :param kwargs: see :class:`GaussianHead`
    :raises ValueError: if ``diffusion_steps`` or ``start_level`` is out of its range, or ``temperature`` is not 1
    """

    residual_scale: th.Tensor
    residual_mean: th.Tensor
    residual_square: th.Tensor
    posterior_std: th.Tensor
    advantage: th.Tensor
    _gauges: Gauges | None = None

    def __init__(
        self,
        memory_shape: GridShape,
        embedding_channels: int,
        latent_channels: int,
        hidden_channels: int,
        diffusion_steps: int = 2,
        start_level: float = 3.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(memory_shape, embedding_channels, latent_channels, hidden_channels, **kwargs)
        few = f"a number of steps from 1 to {MOST_STEPS}, or a GaussianHead, which policies have with 0"
        require(1 <= diffusion_steps <= MOST_STEPS, "diffusion_steps", diffusion_steps, few)
        require(start_level > 0, "start_level", start_level, "a multiple > 0")
        require(self.temperature == 1, "temperature", self.temperature, "1, or a GaussianHead: refined samples have none")
        self.diffusion_steps = diffusion_steps
        self.start_level = start_level
        with th.random.fork_rng(devices=[]):  # so that all other networks begin as they would without a denoiser
            self.denoiser = Denoiser(memory_shape, hidden_channels, latent_channels, hidden_channels)
        self.average_denoiser = make_target(self.denoiser)
        latent_shape = (latent_channels, *memory_shape[1:])
        self.register_buffer("residual_scale", th.tensor(0.1))
        self.register_buffer("residual_mean", th.zeros(latent_shape))
        self.register_buffer("residual_square", th.full(latent_shape, 0.01))
        self.register_buffer("posterior_std", th.ones(latent_shape))
        self.register_buffer("advantage", th.tensor(-1.0))

    @property
    def refines(self) -> bool:
        """Whether samples are refined: the denoiser has become better than a Gaussian."""
        return bool(self.advantage > 0)

    def sample(
        self,
        memory: th.Tensor,
        embedding: th.Tensor | None = None,
        n_candidates: int = 1,
        generator: th.Generator | None = None,
    ) -> th.Tensor:
        if not self.refines:
            return super().sample(memory, embedding, n_candidates, generator)
        prior, context = self.prior(memory), self.average_denoiser.context(memory, embedding)
        level = self.residual_scale * (self.start_level if embedding is None else 1.0)
        fields = (prior.mean, context, *self._noised(prior, memory, embedding, level))
        mean, context, centre, spread = (th.cat([field] * n_candidates) for field in fields)
        return mean + self._refine(Gaussian(centre, spread).sample(generator), context, level, generator)

    def _noised(self, prior: Gaussian, memory: th.Tensor, embedding: th.Tensor | None, level: th.Tensor) -> Gaussian:
        """What is known of the residual without the denoiser, noised: the Gaussian prior's spread, or the posterior's mean."""
        if embedding is None:
            return Gaussian(th.zeros_like(prior.mean), (self._residual_variance(prior) + level**2).sqrt())
        residual = self.posterior(memory, embedding).mean - prior.mean
        return Gaussian(residual, level.expand_as(residual))

    def _residual_variance(self, prior: Gaussian) -> th.Tensor:
        """Variance of the posterior's mean given the memory, as far as the Gaussians tell."""
        return (prior.std.square() - self.posterior_std.square()).clamp(min=0)

    def _refine(self, noisy: th.Tensor, context: th.Tensor, start: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """Euler's steps from one noise level to the next; the last one ends at the spread of the posterior."""
        levels = noise_levels(start, self.diffusion_steps)
        for level, following in zip(levels, [*levels[1:], self.posterior_std], strict=True):
            clean = self.average_denoiser(noisy, level.expand(len(noisy)), self.residual_scale, context)
            noisy = clean + (following / level).clamp(max=1) * (noisy - clean)
        # Where latents are vaguer than where the last step began
        missing = (self.posterior_std.square() - levels[-1].square()).clamp(min=0).sqrt()
        return Gaussian(noisy, missing).sample(generator)

    def loss(
        self,
        posterior: Gaussian,
        prior: Gaussian,
        memory: th.Tensor,
        embedding: th.Tensor,
        generator: th.Generator | None = None,
    ) -> tuple[th.Tensor, TensorLogs]:
        loss, logs = super().loss(posterior, prior, memory, embedding, generator)
        posterior, prior = (Gaussian(*(field.detach().flatten(end_dim=-4) for field in each)) for each in (posterior, prior))
        memory, embedding = (field.detach().flatten(end_dim=-4) for field in (memory, embedding))
        residual = posterior.mean - prior.mean
        self._gauges = self._gauge(posterior, prior, residual, memory, generator)
        diffusion = self._denoising_loss(residual, memory, embedding, generator)
        scales = {"residual_scale": self.residual_scale.clone(), "diffusion_advantage": self.advantage.clone()}
        return loss + diffusion, {**logs, "diffusion_loss": diffusion.detach(), **scales}

    def settle(self) -> None:
        if self._gauges is None:
            return
        for name, value in self._gauges._asdict().items():
            getattr(self, name).lerp_(value, TAU)
        self._gauges = None
        update_target(self.denoiser, self.average_denoiser, TAU)

    def _denoising_loss(
        self, residual: th.Tensor, memory: th.Tensor, embedding: th.Tensor, generator: th.Generator | None
    ) -> th.Tensor:
        """Squared error of the denoiser on noised residuals, in the units of its last layer (EDM, Eq. 8)."""
        n, device = len(residual), residual.device
        exponent = math.log(2.5) + 1.2 * th.randn(n, device=device, generator=generator)
        level = self.residual_scale * exponent.exp().clamp(0.05, 10)
        seen = th.rand(n, device=device, generator=generator) < 0.5
        context = self.denoiser.context(memory, th.where(seen[:, None, None, None], embedding, 0.0))
        noisy = Gaussian(residual, level[:, None, None, None].expand_as(residual)).sample(generator)
        error = self.denoiser(noisy, level, self.residual_scale, context) - residual
        weight = (level**2 + self.residual_scale**2) / (level * self.residual_scale) ** 2
        return (weight * error.square().mean((-3, -2, -1))).mean()

    @th.no_grad()
    def _gauge(
        self, posterior: Gaussian, prior: Gaussian, residual: th.Tensor, memory: th.Tensor, generator: th.Generator | None
    ) -> Gauges:
        """Compare the denoiser with Gaussian ones where samples start, before it is fitted to these states."""
        level = self.residual_scale * self.start_level
        noisy = Gaussian(residual, level.expand_as(residual)).sample(generator)
        context = self.average_denoiser.context(memory, None)
        learned = self.average_denoiser(noisy, level.expand(len(noisy)), self.residual_scale, context)
        # While the prior is not fitted its variance is wrong, and whatever is learned would look better
        usual = self.residual_mean, self.residual_square - self.residual_mean.square()
        rivals = (th.zeros_like(residual), self._residual_variance(prior)), usual
        estimates = learned, *(gaussian_denoiser(noisy, level, *moments) for moments in rivals)
        error, *others = ((estimate - residual).square().mean() for estimate in estimates)
        square = residual.square().mean(0)
        advantage = 1 - error / th.stack(others).min()
        return Gauges(square.mean().sqrt(), residual.mean(0), square, posterior.std.mean(0), advantage)


def make_head(
    memory_shape: GridShape,
    embedding_channels: int,
    latent_channels: int,
    hidden_channels: int,
    diffusion_steps: int = 0,
    **kwargs: Any,
) -> LatentHead:
    """
    Build the latent head of ESAD-LEND: Gaussian, until more has been shown to help (docs/experiments.md, section 24).

    :param memory_shape: shape of the memory (C, H, W)
    :param embedding_channels: channels of the observation's features
    :param latent_channels: channels of the latent
    :param hidden_channels: units of the hidden layers in each cell
    :param diffusion_steps: K, steps of a sample; 0 for a Gaussian latent
    :param kwargs: see :class:`GaussianHead` and :class:`DiffusionHead`
    :return: the head
    """
    sizes = (memory_shape, embedding_channels, latent_channels, hidden_channels)
    return DiffusionHead(*sizes, diffusion_steps, **kwargs) if diffusion_steps else GaussianHead(*sizes, **kwargs)
