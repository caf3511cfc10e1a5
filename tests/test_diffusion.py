"""Refined latents: samplers with known outcomes, a toy that no Gaussian can express, and the Gaussian as a special case."""

import math

import pytest
import torch as th

from sb3_esad import ESADLEND, SADLEN
from sb3_esad.common.diffusion import DiffusionHead, gaussian_denoiser, noise_levels
from sb3_esad.common.latents import Gaussian, GaussianHead
from tests.conftest import TINY, CountingEnv

SHAPE = (6, 1, 1)


def make_head(size: int = 4, diffusion_steps: int = 2) -> DiffusionHead:
    return DiffusionHead(SHAPE, 3, size, 32, diffusion_steps)


class Oracle:
    """Knows the residual."""

    def __init__(self, residual: float | th.Tensor) -> None:
        self.residual = residual

    def context(self, memory: th.Tensor, embedding: th.Tensor | None) -> th.Tensor:
        return memory

    def __call__(self, noisy: th.Tensor, level: th.Tensor, scale: th.Tensor, context: th.Tensor) -> th.Tensor:
        return th.zeros_like(noisy) + self.residual


def open_gate(head: DiffusionHead, residual: float | th.Tensor, posterior_std: float) -> None:
    head.advantage.fill_(0.5)
    head.residual_scale.fill_(0.2)
    head.posterior_std.fill_(posterior_std)
    del head.denoiser
    head.denoiser = Oracle(residual)


def test_levels_fall() -> None:
    th.testing.assert_close(th.stack(noise_levels(2.0, 3)), th.tensor([2.0, 0.8, 0.32]))


def test_gaussian_denoiser_is_the_conditional_mean() -> None:
    clean, noise = 0.3 * th.randn(200_000), 0.4 * th.randn(200_000)
    noisy = clean + noise
    slope = (noisy @ clean) / (noisy @ noisy)  # of the linear regression
    th.testing.assert_close(gaussian_denoiser(th.ones(1), th.tensor(0.4), th.tensor(0.09)), slope[None], atol=0.01, rtol=0)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_an_oracle_leads_to_the_residual_with_the_spread_of_the_posterior(steps: int) -> None:
    head = make_head(diffusion_steps=steps)
    open_gate(head, residual=0.7, posterior_std=0.05)
    memory = th.randn(1, *SHAPE).expand(20_000, *SHAPE)
    with th.no_grad():
        prior, sample = head.prior(memory[:1]), head.sample(memory)
    start = 0.6
    left = 0.05 / start  # of the distance to the residual, whatever the steps
    expected = prior.mean[0] + 0.7 * (1 - left)
    spread = left * (prior.std[0].square() - 0.05**2 + start**2).sqrt()
    th.testing.assert_close(sample.mean(0), expected, atol=0.01, rtol=0)
    th.testing.assert_close(sample.std(0), spread, atol=0.003, rtol=0)


def test_latents_vaguer_than_the_first_level_keep_their_spread() -> None:
    head = make_head()
    open_gate(head, residual=0.0, posterior_std=0.9)
    with th.no_grad():
        sample = head.sample(th.zeros(20_000, *SHAPE))
    assert (sample.std(0) >= 0.9 - 0.02).all()


def test_given_an_observation_candidates_surround_the_posterior() -> None:
    head = make_head()
    memory, embedding = th.randn(1, *SHAPE), th.randn(1, 32, 1, 1)
    with th.no_grad():
        posterior = head.posterior(memory, embedding)
        open_gate(head, posterior.mean - head.prior(memory).mean, posterior_std=0.05)
        sample = head.sample(memory, embedding, n_candidates=20_000)
    th.testing.assert_close(sample.mean(0), posterior.mean[0], atol=0.01, rtol=0)
    th.testing.assert_close(sample.std(0), th.full((4, 1, 1), 0.05), atol=0.003, rtol=0)


def test_candidates_come_first() -> None:
    memory = th.randn(2, *SHAPE)
    for head in (make_head(), make_head(diffusion_steps=0)):
        head.advantage.fill_(0.5)
        head.prior_net[1].weight.data.mul_(100)
        with th.no_grad():
            candidates = head.sample(memory, n_candidates=3).unflatten(0, (3, 2))
            means = head.prior(memory).mean
        assert ((candidates - means).abs() < (candidates - means.flip(0)).abs()).float().mean() > 0.8


@pytest.mark.parametrize("steps", [0, 2])
def test_without_steps_or_before_it_is_better_the_head_is_gaussian_bit_for_bit(steps: int) -> None:
    th.manual_seed(1)
    gaussian = GaussianHead(SHAPE, 3, 4, 32)
    th.manual_seed(1)
    diffusion = make_head(diffusion_steps=steps)
    memory, embedding, outcomes = th.randn(5, *SHAPE), th.randn(5, 32, 1, 1), []
    for head in (gaussian, diffusion):
        th.manual_seed(2)
        outcomes.append([head.sample(memory, n_candidates=2), head.sample(memory, embedding)])
    for one, other in zip(*outcomes, strict=True):
        assert th.equal(one, other)


def shared(model: ESADLEND) -> th.Tensor:
    own = ("denoiser", "residual_scale", "posterior_std", "advantage")
    return th.cat(
        [value.flatten() for name, value in model.policy.state_dict().items() if not any(each in name for each in own)]
    )


@pytest.mark.parametrize("steps", [0, 2])
def test_as_long_as_nothing_is_refined_the_world_model_is_that_of_sad_len(steps: int) -> None:
    kwargs = {**TINY["policy_kwargs"], "head_kwargs": {"diffusion_steps": steps}}
    with_diffusion = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "policy_kwargs": kwargs}).learn(32)
    assert not with_diffusion.policy.world_model.rssm.head.refines
    assert th.equal(shared(with_diffusion), shared(SADLEN("MlpPolicy", CountingEnv(), **TINY).learn(32)))


def energy_distance(x: th.Tensor, y: th.Tensor) -> float:
    within = sum(th.cdist(each, each).sum() / (len(each) * (len(each) - 1)) for each in (x, y))
    return float(2 * th.cdist(x, y).mean() - within)


def test_two_modes_that_no_gaussian_can_express() -> None:
    """16 dimensions, two modes 2.0 apart, a deviation of .15 each: energy distance at most half of the Gaussian's."""
    direction = th.nn.functional.normalize(th.randn(16), dim=0)[:, None, None]
    head = make_head(16)
    optimizer = th.optim.Adam(head.parameters(), 4e-3)
    memory, embedding = th.zeros(64, *SHAPE), th.zeros(64, 32, 1, 1)
    for _ in range(500):
        signs = 2 * th.randint(0, 2, (64, 1, 1, 1)) - 1.0
        posterior = Gaussian(signs * direction, th.full((64, 16, 1, 1), 0.15))
        loss, _ = head.loss(posterior, head.prior(memory), memory, embedding)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    memory, signs = th.zeros(2000, *SHAPE), 2 * th.randint(0, 2, (2000, 1)) - 1.0
    truth = signs * direction.flatten() + 0.15 * th.randn(2000, 16)
    with th.no_grad():
        gaussian, refined = head.prior(memory).sample().flatten(1), head.sample(memory).flatten(1)
    assert head.refines
    assert energy_distance(truth, refined) < 0.5 * energy_distance(truth, gaussian)


def test_gradients_of_the_diffusion_model_stay_its_own() -> None:
    head = make_head()
    prior = head.prior(th.randn(8, *SHAPE))
    loss, logs = head.loss(
        Gaussian(th.randn(8, 4, 1, 1), th.ones(8, 4, 1, 1)), prior, th.randn(8, *SHAPE), th.randn(8, 32, 1, 1)
    )
    (loss - loss.detach()).backward()
    assert head.denoiser.output.weight.grad.abs().sum() > 0
    assert math.isfinite(logs["diffusion_loss"])
    assert all(parameter.grad is None for parameter in head.posterior_net.parameters())
