"""Refined latents: samplers with known outcomes, a toy that no Gaussian can express, and the Gaussian as a special case."""

import math

import pytest
import torch as th

from sb3_esad import ESADLEND, SADLEN
from sb3_esad.common.diffusion import DiffusionHead, gaussian_denoiser, make_head, noise_levels
from sb3_esad.common.latents import Gaussian, GaussianHead
from tests.conftest import TINY, CountingEnv

SHAPE = (6, 1, 1)


def diffusion_head(size: int = 4, diffusion_steps: int = 2) -> DiffusionHead:
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
    del head.average_denoiser
    head.average_denoiser = Oracle(residual)


def test_levels_fall() -> None:
    th.testing.assert_close(th.stack(noise_levels(2.0, 3)), th.tensor([2.0, 0.8, 0.32]))


def test_gaussian_denoiser_is_the_conditional_mean() -> None:
    clean, noise = 0.2 + 0.3 * th.randn(200_000), 0.4 * th.randn(200_000)
    noisy = clean + noise
    slope = th.cov(th.stack([noisy, clean]))[0, 1] / noisy.var()  # of the linear regression
    estimate = gaussian_denoiser(th.ones(1), th.tensor(0.4), th.tensor(0.2), th.tensor(0.09))
    th.testing.assert_close(estimate, clean.mean() + slope * (1 - noisy.mean())[None], atol=0.01, rtol=0)


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_an_oracle_leads_to_the_residual_with_the_spread_of_the_posterior(steps: int) -> None:
    head = diffusion_head(diffusion_steps=steps)
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
    head = diffusion_head()
    open_gate(head, residual=0.0, posterior_std=0.9)
    with th.no_grad():
        sample = head.sample(th.zeros(20_000, *SHAPE))
    assert (sample.std(0) >= 0.9 - 0.02).all()


def test_given_an_observation_candidates_surround_the_posterior() -> None:
    head = diffusion_head()
    memory, embedding = th.randn(1, *SHAPE), th.randn(1, 32, 1, 1)
    with th.no_grad():
        posterior = head.posterior(memory, embedding)
        open_gate(head, posterior.mean - head.prior(memory).mean, posterior_std=0.05)
        sample = head.sample(memory, embedding, n_candidates=20_000)
    th.testing.assert_close(sample.mean(0), posterior.mean[0], atol=0.01, rtol=0)
    th.testing.assert_close(sample.std(0), th.full((4, 1, 1), 0.05), atol=0.003, rtol=0)


def test_candidates_come_first() -> None:
    memory = th.randn(2, *SHAPE)
    for steps in (0, 2):
        head = make_head(SHAPE, 3, 4, 32, steps)
        if isinstance(head, DiffusionHead):
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
    diffusion = make_head(SHAPE, 3, 4, 32, steps)
    memory, embedding, outcomes = th.randn(5, *SHAPE), th.randn(5, 32, 1, 1), []
    for head in (gaussian, diffusion):
        th.manual_seed(2)
        outcomes.append([head.sample(memory, n_candidates=2), head.sample(memory, embedding)])
    for one, other in zip(*outcomes, strict=True):
        assert th.equal(one, other)


def shared(model: ESADLEND) -> th.Tensor:
    own = ("denoiser", "residual_scale", "residual_mean", "residual_square", "posterior_std", "advantage")
    return th.cat(
        [value.flatten() for name, value in model.policy.state_dict().items() if not any(each in name for each in own)]
    )


@pytest.mark.parametrize("steps", [0, 2])
def test_as_long_as_nothing_is_refined_the_world_model_is_that_of_sad_len(steps: int) -> None:
    kwargs = {**TINY["policy_kwargs"], "head_kwargs": {"diffusion_steps": steps}}
    with_diffusion = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "policy_kwargs": kwargs}).learn(32)
    head = with_diffusion.policy.world_model.rssm.head
    assert not head.refines if isinstance(head, DiffusionHead) else steps == 0
    assert th.equal(shared(with_diffusion), shared(SADLEN("MlpPolicy", CountingEnv(), **TINY).learn(32)))


def energy_distance(x: th.Tensor, y: th.Tensor) -> float:
    within = sum(th.cdist(each, each).sum() / (len(each) * (len(each) - 1)) for each in (x, y))
    return float(2 * th.cdist(x, y).mean() - within)


def fit(head: DiffusionHead, mean: float, spread: float, std: float, iterations: int, size: int = 4) -> th.Tensor:
    """Fit to posteriors whose means are ``mean`` to either side, give or take ``spread``; returns the direction to them."""
    direction = th.nn.functional.normalize(th.randn(size), dim=0)[:, None, None]
    optimizer = th.optim.Adam(head.parameters(), 4e-3)
    memory, embedding = th.zeros(64, *SHAPE), th.zeros(64, 32, 1, 1)
    for _ in range(iterations):
        signs = 2 * th.randint(0, 2, (64, 1, 1, 1)) - 1.0
        means = mean * signs * direction + spread * th.randn(64, size, 1, 1)
        loss, _ = head.loss(Gaussian(means, th.full_like(means, std)), head.prior(memory), memory, embedding)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        head.settle()
    return direction


def test_two_modes_that_no_gaussian_can_express() -> None:
    """16 dimensions, two modes 2.0 apart, a deviation of .15 each: energy distance at most half of the Gaussian's."""
    head = diffusion_head(16)
    direction = fit(head, mean=1.0, spread=0.0, std=0.15, iterations=700, size=16)
    memory, signs = th.zeros(2000, *SHAPE), 2 * th.randint(0, 2, (2000, 1)) - 1.0
    truth = signs * direction.flatten() + 0.15 * th.randn(2000, 16)
    with th.no_grad():
        gaussian, refined = head.prior(memory).sample().flatten(1), head.sample(memory).flatten(1)
    assert head.refines
    assert energy_distance(truth, refined) < 0.5 * energy_distance(truth, gaussian)


@pytest.mark.parametrize("spread", [0.05, 0.2, 0.6])
def test_where_a_gaussian_is_right_nothing_is_refined(spread: float) -> None:
    """Below free_nats the prior's own variance is not fitted, and a denoiser that beats it has shown nothing."""
    head = diffusion_head()
    fit(head, mean=0.0, spread=spread, std=0.3, iterations=500)
    assert head.advantage < 0.01


def test_no_observation_is_one_of_zeros_as_in_training() -> None:
    denoiser, memory = diffusion_head().denoiser, th.randn(5, *SHAPE)
    th.testing.assert_close(denoiser.context(memory, None), denoiser.context(memory, th.zeros(5, 32, 1, 1)))


def test_samples_are_those_of_the_average_and_change_when_the_network_has_moved() -> None:
    head = diffusion_head()
    head.advantage.fill_(0.5)
    memory, embedding = th.randn(8, *SHAPE), th.zeros(8, 32, 1, 1)

    def sample() -> th.Tensor:
        with th.no_grad():
            return head.sample(memory, generator=th.Generator().manual_seed(0))

    before = sample()
    for parameter in head.denoiser.parameters():
        parameter.data.add_(1.0)
    posterior = Gaussian(th.randn(8, 4, 1, 1), th.ones(8, 4, 1, 1))
    head.loss(posterior, head.prior(memory), memory, embedding)
    assert th.equal(sample(), before)
    head.settle()
    assert not th.equal(sample(), before)
    weights = zip(head.average_denoiser.parameters(), head.denoiser.parameters(), strict=True)
    assert all(th.allclose(average, learned - 0.99, atol=1e-5) for average, learned in weights)


def test_gradients_of_the_diffusion_model_stay_its_own() -> None:
    head = diffusion_head()
    prior = head.prior(th.randn(8, *SHAPE))
    loss, logs = head.loss(
        Gaussian(th.randn(8, 4, 1, 1), th.ones(8, 4, 1, 1)), prior, th.randn(8, *SHAPE), th.randn(8, 32, 1, 1)
    )
    (loss - loss.detach()).backward()
    assert head.denoiser.output.weight.grad.abs().sum() > 0
    assert math.isfinite(logs["diffusion_loss"])
    assert all(parameter.grad is None for parameter in head.posterior_net.parameters())


def test_a_refined_sample_has_no_temperature() -> None:
    with pytest.raises(ValueError, match=r"temperature is 0\.5"):
        DiffusionHead(SHAPE, 4, 4, 8, temperature=0.5)
