"""The paper's equations against published values, Monte-Carlo and brute force."""

import math

import numpy as np
import pytest
import torch as th

from sb3_esad.common import functional as F
from sb3_esad.common.transforms import symexp, symlog, twohot_decode, twohot_encode


def t(*values: float) -> th.Tensor:
    return th.tensor(values, dtype=th.float64).squeeze()


@pytest.mark.parametrize(
    ("risk_level", "expected"),
    [(0.05, 2.063), (0.1, 1.755), (0.25, 1.271), (0.5, 0.798), (0.75, 0.424), (0.9, 0.195), (0.99, 0.027), (1.0, 0.0)],
)
def test_tail_factor(risk_level: float, expected: float) -> None:
    assert F.tail_factor(risk_level) == pytest.approx(expected, abs=5e-4)


@pytest.mark.parametrize("risk_level", [0.0, -0.1, 1.1, math.nan])
def test_tail_factor_refuses(risk_level: float) -> None:
    with pytest.raises(ValueError, match="risk_level is"):
        F.tail_factor(risk_level)


@pytest.mark.parametrize("risk_level", [0.1, 0.5, 0.9])
def test_gaussian_cvar_is_the_mean_of_the_worst(risk_level: float) -> None:
    draws = np.sort(np.random.default_rng(0).normal(1.0, 2.0, 1_000_000))
    worst = draws[-int(risk_level * len(draws)) :].mean()
    assert F.gaussian_cvar(t(1.0), t(4.0), risk_level).item() == pytest.approx(worst, abs=0.02)


def test_cvar_known_values() -> None:
    assert F.gaussian_cvar(t(0.1), t(0.04), 0.5).item() == pytest.approx(0.2596, abs=1e-4)
    assert F.capped_cvar(t(0.1), t(0.04), 0.5, 1.0).item() == pytest.approx(0.2)
    assert F.capped_cvar(t(0.9), t(0.04), 0.5, 1.0).item() == pytest.approx(1.0)


def test_risk_level_one_is_the_mean_with_a_finite_gradient() -> None:
    mean, variance = th.ones(3, requires_grad=True), th.zeros(3, requires_grad=True)
    F.gaussian_cvar(mean, variance, 1.0).sum().backward()
    assert mean.grad is not None and mean.grad.isfinite().all()
    assert variance.grad is None
    assert F.capped_cvar(t(0.3), t(9.0), 1.0, 1.0).item() == pytest.approx(0.3)


@pytest.mark.parametrize("probability", [0.02, 0.05, 0.1])
def test_capped_cvar_bounds_rare_crashes(probability: float) -> None:
    """The cap is exact for an indicator whose probability is below the risk level; the Gaussian is far above."""
    mean, variance = t(probability), t(probability * (1 - probability))
    true = probability / 0.5
    assert F.capped_cvar(mean, variance, 0.5, 1.0).item() == pytest.approx(
        min(true, F.gaussian_cvar(mean, variance, 0.5).item())
    )
    assert F.gaussian_cvar(mean, variance, 0.5).item() > F.capped_cvar(mean, variance, 0.5, 1.0).item()


def test_wasserstein2() -> None:
    assert F.wasserstein2(t(1.0), t(0.25), t(0.5), t(0.04)).item() == pytest.approx(0.34)
    assert F.wasserstein2(t(2.0), t(9.0), t(2.0), t(4.0)).item() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("limit", "gamma", "length", "expected"),
    [(1, 0.95, 40, 0.4357), (1, 0.97, 200, 0.1663), (25, 0.99, 1000, 2.4999), (3, 1.0, 17, 3.0), (0, 0.9, 10, 0.0)],
)
def test_discounted_budget(limit: float, gamma: float, length: float, expected: float) -> None:
    assert F.discounted_budget(limit, gamma, length) == pytest.approx(expected, abs=1e-4)


def test_where_only_time_ends_episodes_the_budget_is_that_of_a_steady_rate() -> None:
    rates = [F.discounted_budget(1.0, 0.97, 20, timeouts) for timeouts in (0.0, 0.5, 1.0)]
    assert rates == pytest.approx([(1 - 0.97**20) / 0.6, (1 - 0.97**20 / 2) / 0.6, 1 / 0.6])


def test_discounted_budget_is_continuous_at_one() -> None:
    assert F.discounted_budget(2.0, 1.0 - 1e-7, 50) == pytest.approx(2.0, abs=1e-4)


def test_cost_variance_target_known_values() -> None:
    safe = F.cost_variance_target(t(0.0), t(1.0), t(0.45), t(0.5), t(0.04), 0.9)
    crash = F.cost_variance_target(t(1.0), t(0.0), t(1.0), t(0.0), t(0.0), 0.9)
    assert safe.item() == pytest.approx(0.0324)
    assert crash.item() == pytest.approx(0.0)


@pytest.mark.parametrize(("hazard", "mean", "variance"), [(0.01, 0.1681, 0.0656), (0.05, 0.5128, 0.0876)])
def test_hazard_chain_fixed_point(hazard: float, mean: float, variance: float) -> None:
    """A crash of probability ``hazard`` in each step; cost 1 and the end. Expected heads must find the true variance."""
    gamma, cost, continues = 0.95, t(hazard), t(1 - hazard)
    q, v = t(0.0), t(0.0)
    for _ in range(1000):
        q, v = cost + gamma * continues * q, F.cost_variance_target(cost, continues, q, q, v, gamma)
    assert q.item() == pytest.approx(mean, abs=1e-4)
    assert v.item() == pytest.approx(variance, abs=1e-4)
    times = np.random.default_rng(0).geometric(hazard, 400_000)
    assert math.sqrt(v.item()) == pytest.approx((gamma ** (times - 1)).std(), rel=0.05)
    plugged_in = (cost + gamma * continues * q) ** 2 - q**2
    assert plugged_in.item() == pytest.approx(0.0, abs=1e-9)


def test_cost_goes_on_after_an_event() -> None:
    """Costs of probability p that end nothing: Q = p / (1 - gamma), V = p (1 - p) / (1 - gamma^2)."""
    p, gamma = 0.2, 0.8
    cost, continues, q, v = t(p), t(1.0), t(p / (1 - gamma)), t(0.0)
    for _ in range(500):
        v = F.cost_variance_target(cost, continues, q, q, v, gamma, continue_after_cost=1.0)
    assert v.item() == pytest.approx(p * (1 - p) / (1 - gamma**2))


def test_variance_targets_are_never_negative() -> None:
    cost, continues, q, q_next, v_next = th.rand(5, 200_000, dtype=th.float64)
    target = F.cost_variance_target(cost, continues, 3 * q, 3 * q_next, v_next, 0.97, continue_after_cost=0.3)
    assert target.min() >= -1e-12


def test_expected_error_of_certain_heads_is_the_sampled_one() -> None:
    cost, continues = th.randint(2, (2, 1000)).double()
    q, q_next, v_next = th.rand(3, 1000, dtype=th.float64)
    expected = F.cost_variance_target(cost, continues, q, q_next, v_next, 0.9, continue_after_cost=0.5)
    th.testing.assert_close(expected, F.sampled_variance_target(cost, continues, q, q_next, v_next, 0.9))


def test_expected_error_is_the_mean_of_sampled_ones() -> None:
    probability, survival, q, q_next, gamma = 0.3, 0.6, 0.4, 0.7, 0.9
    crash = th.rand(400_000, dtype=th.float64) < probability
    alive = (th.rand(400_000) < 0.5) & crash | (th.rand(400_000) < (survival - 0.15) / 0.7) & ~crash
    sampled = F.sampled_variance_target(crash.double(), alive.double(), t(q), t(q_next), t(0.2), gamma).mean()
    expected = F.cost_variance_target(t(probability), t(survival), t(q), t(q_next), t(0.2), gamma, continue_after_cost=0.5)
    assert expected.item() == pytest.approx(sampled.item(), rel=0.02)


@pytest.mark.parametrize("risk_level", [0.1, 0.5, 0.9, 1.0])
def test_the_likelier_a_crash_the_riskier_for_the_actor(risk_level: float) -> None:
    """A cost of 1 with probability Q has the variance Q (1 - Q)."""
    chance = th.linspace(0.01, 0.99, 99, dtype=th.float64, requires_grad=True)
    risk = F.rising_cvar(chance, chance * (1 - chance), risk_level)
    (slope,) = th.autograd.grad(risk.sum(), chance)
    assert (slope >= 1.0).all()
    assert (risk <= chance / risk_level + 1e-12).all()


def test_a_gaussian_would_make_sure_of_a_crash() -> None:
    """Why the variance has no gradient: root of 1 + k (1 - 2 Q) / (2 sqrt(Q (1 - Q))) for k = .798."""
    chance = th.tensor([0.85, 0.89, 0.895, 0.95], dtype=th.float64, requires_grad=True)
    (slope,) = th.autograd.grad(F.gaussian_cvar(chance, chance * (1 - chance), 0.5).sum(), chance)
    assert (slope > 0).tolist() == [True, True, False, False]


def test_barrier_residual() -> None:
    assert F.barrier_residual(t(0.3), t(0.4), 0.1, 0.3).item() == pytest.approx(-0.01)
    assert F.barrier_residual(t(0.3), t(0.4), 0.0, 0.3).item() == pytest.approx(0.3 - 0.7 * 0.4)


def test_correct_logit() -> None:
    p, weight = t(0.01), 10.0
    raw = weight * p / (weight * p + 1 - p)
    assert raw.item() == pytest.approx(0.0917, abs=1e-4)
    assert F.correct_logit(raw.logit(), weight).sigmoid().item() == pytest.approx(0.01)


def test_symlog_and_symexp_are_inverse() -> None:
    values = t(-1000.0, -1.0, 0.0, 0.5, 30.0)
    th.testing.assert_close(symexp(symlog(values)), values)
    assert symlog(t(math.e - 1)).item() == pytest.approx(1.0)


def test_twohot() -> None:
    bins = th.linspace(-10.0, 10.0, 101)
    values = th.empty(7, 5).uniform_(-9.9, 9.9)
    encoded = twohot_encode(values, bins)
    assert encoded.shape == (7, 5, 101)
    assert (encoded > 0).sum(-1).max() <= 2
    th.testing.assert_close(encoded.sum(-1), th.ones(7, 5))
    th.testing.assert_close(twohot_decode(encoded, bins), values, atol=1e-4, rtol=0)
    assert twohot_decode(twohot_encode(th.tensor([-99.0, 99.0]), bins), bins).tolist() == pytest.approx([-10, 10])
