"""The mathematics of ESAD-LEND (arXiv 2407.06317) as pure functions."""

import math
from functools import cache
from statistics import NormalDist

import torch as th


@cache
def tail_factor(risk_level: float) -> float:
    """
    Distance of the conditional value at risk from the mean of a Gaussian, in standard deviations.

    k(alpha) = phi(Phi^-1(alpha)) / alpha (Yang et al., WCSAC, AAAI 2021).

    :param risk_level: alpha in (0, 1], the worst fraction of outcomes; 1 gives 0
    :return: k(alpha) >= 0
    :raises ValueError: if ``risk_level`` is outside (0, 1]
    """
    if not 0.0 < risk_level <= 1.0:
        raise ValueError(f"risk_level is {risk_level}; choose the worst fraction of outcomes in (0, 1], 1 for the mean.")
    if risk_level == 1.0:
        return 0.0
    normal = NormalDist()
    return normal.pdf(normal.inv_cdf(risk_level)) / risk_level


def gaussian_cvar(mean: th.Tensor, variance: th.Tensor, risk_level: float) -> th.Tensor:
    """
    Expected cost in the worst ``risk_level`` fraction of outcomes of a Gaussian.

    The safety measure Gamma of arXiv 2407.06317: Q + phi(Phi^-1(alpha)) / alpha * sqrt(V).

    :param mean: Q^c, the expected discounted cost
    :param variance: V^c > 0, its variance, of the shape of ``mean``
    :param risk_level: alpha in (0, 1]; smaller is more pessimistic, 1 is the mean
    :return: the conditional value at risk, of the shape of ``mean``
    """
    factor = tail_factor(risk_level)
    # At factor 0 the root is left out, for 0 * inf in its gradient at V = 0 is not a number.
    return mean + factor * variance.sqrt() if factor > 0.0 else mean


def capped_cvar(mean: th.Tensor, variance: th.Tensor, risk_level: float, cost_bound: float | th.Tensor) -> th.Tensor:
    """
    Gaussian conditional value at risk, kept below what any non-negative cost can reach.

    For costs >= 0 the worst fraction alpha holds at most the whole mean, so CVaR_alpha <= E / alpha. A Gaussian
    exceeds this by far for rare events, such as a collision in one of fifty episodes.

    :param mean: Q^c, the expected discounted cost
    :param variance: V^c > 0, its variance, of the shape of ``mean``
    :param risk_level: alpha in (0, 1]
    :param cost_bound: the largest discounted cost possible, 1 if a unit cost ends the episode
    :return: the capped conditional value at risk, of the shape of ``mean``
    """
    return th.minimum(gaussian_cvar(mean, variance, risk_level), mean / risk_level).clamp(max=cost_bound)


def rising_cvar(mean: th.Tensor, variance: th.Tensor, risk_level: float) -> th.Tensor:
    """
    Risk for an actor to descend: it always falls with the expected cost.

    Neither does the bound of :func:`capped_cvar` hold, below which the risk is flat where the worst outcomes are all crashes,
    so that an actor that always crashes would never learn from it to crash less often ("blindness to success", arXiv
    2205.05138), nor has the variance a gradient. It is largest where it is open whether a crash will happen: the deviation of
    a crash of probability Q falls faster than Q rises where Q > .89 (risk level .5), and the actor would make sure of it.

    :param mean: Q^c, the expected discounted cost
    :param variance: V^c > 0, its variance, of the shape of ``mean``
    :param risk_level: alpha in (0, 1]
    :return: the conditional value at risk, of the shape of ``mean``, its slope in it at least 1
    """
    return capped_cvar(mean, variance.detach(), risk_level, math.inf)


def wasserstein2(mean1: th.Tensor, variance1: th.Tensor, mean2: th.Tensor, variance2: th.Tensor) -> th.Tensor:
    """
    Squared 2-Wasserstein distance of two scalar Gaussians.

    (m1 - m2)^2 + V1 + V2 - 2 sqrt(V1 V2), the critic's distance in arXiv 2407.06317 and WCSAC.

    :param mean1: mean of the first
    :param variance1: variance of the first
    :param mean2: mean of the second
    :param variance2: variance of the second
    :return: the squared distance, of the common shape
    """
    return (mean1 - mean2) ** 2 + (variance1.sqrt() - variance2.sqrt()) ** 2


def discounted_budget(cost_limit: float, gamma: float, episode_length: float, timeouts: float = 0.0) -> float:
    """
    The discounted value of a cost limit that is spread evenly over an episode.

    d = D (1 - gamma^T) / ((1 - gamma) T) (WCSAC). Where only time ends episodes critics look beyond their ends, as if they
    went on at the same rate, so that there d = D / ((1 - gamma) T).

    :param cost_limit: D, the undiscounted cost allowed per episode
    :param gamma: discount of the cost, in [0, 1]; 1 returns ``cost_limit``
    :param episode_length: T > 0, in steps
    :param timeouts: share of episodes that only time ends
    :return: d, comparable with a discounted cost value
    """
    if gamma == 1.0:
        return cost_limit
    return cost_limit * (1.0 - (1.0 - timeouts) * gamma**episode_length) / ((1.0 - gamma) * episode_length)


def indicator_joint(cost: th.Tensor, continues: th.Tensor, continue_after_cost: float) -> th.Tensor:
    """
    E[c k] of a cost in {0, 1} and of the continuation, from their expectations.

    The estimate rho c is kept between Frechet's bounds, so that a variance stays >= 0 even when the two heads disagree.

    :param cost: E[c] in [0, 1]
    :param continues: E[k] in [0, 1], of the same shape
    :param continue_after_cost: rho = P(k = 1 | c = 1), 0 if a cost ends the episode
    :return: E[c k], of the same shape
    """
    lowest = (cost + continues - 1.0).clamp(min=0.0)
    return (continue_after_cost * cost).clamp(min=lowest, max=th.minimum(cost, continues))


def expected_squared_error(
    cost: th.Tensor,
    second_moment: th.Tensor,
    joint: th.Tensor,
    continues: th.Tensor,
    mean: th.Tensor,
    next_mean: th.Tensor,
    gamma: float,
) -> th.Tensor:
    """
    E[(c + gamma k Q' - Q)^2] when cost and continuation are known by their moments only.

    To put the expectations themselves into the square would make the variance of a steady hazard vanish.

    :param cost: E[c]
    :param second_moment: E[c^2]
    :param joint: E[c k], see :func:`indicator_joint`
    :param continues: E[k]
    :param mean: Q, the critic's current value
    :param next_mean: Q', the value of the state reached
    :param gamma: discount of the cost
    :return: the expected squared one-step error, of the common shape
    """
    first = cost + gamma * continues * next_mean
    second = second_moment + 2.0 * gamma * joint * next_mean + gamma**2 * continues * next_mean**2
    return second - 2.0 * mean * first + mean**2


def cost_variance_target(
    cost: th.Tensor,
    continues: th.Tensor,
    mean: th.Tensor,
    next_mean: th.Tensor,
    next_variance: th.Tensor,
    gamma: float,
    continue_after_cost: float = 0.0,
) -> th.Tensor:
    """
    One-step target of the variance of the discounted cost, for a cost in {0, 1}.

    The direct form E[(c + gamma k Q' - Q)^2] + gamma^2 k V' (Sherstan et al. 2018), which is never negative, in place of the
    clamped projection of arXiv 2407.06317. Samples in {0, 1} are the special case of certain expectations. For several steps
    pass :func:`expected_squared_error` and gamma^2 to :func:`sb3_esad.common.returns.lambda_return`.

    :param cost: E[c] in [0, 1]
    :param continues: E[k] in [0, 1]
    :param mean: Q, the critic's current value, without gradient
    :param next_mean: Q' of the state reached
    :param next_variance: V' of the state reached
    :param gamma: discount of the cost
    :param continue_after_cost: P(k = 1 | c = 1)
    :return: the target, of the common shape
    """
    joint = indicator_joint(cost, continues, continue_after_cost)
    squared_error = expected_squared_error(cost, cost, joint, continues, mean, next_mean, gamma)
    return squared_error + gamma**2 * continues * next_variance


def sampled_variance_target(
    cost: th.Tensor, continues: th.Tensor, mean: th.Tensor, next_mean: th.Tensor, next_variance: th.Tensor, gamma: float
) -> th.Tensor:
    """
    One-step target of the variance of the discounted cost from a real transition of any cost.

    (c + gamma k Q' - Q)^2 + gamma^2 k V' (Sherstan et al. 2018); unbiased under a squared loss.

    :param cost: c of the transition
    :param continues: k in {0, 1} of the transition
    :param mean: Q, the critic's current value, without gradient
    :param next_mean: Q' of the state reached
    :param next_variance: V' of the state reached
    :param gamma: discount of the cost
    :return: the target, of the common shape
    """
    return (cost + gamma * continues * next_mean - mean) ** 2 + gamma**2 * continues * next_variance


def barrier_residual(risk_next: th.Tensor, risk_now: th.Tensor, budget: float | th.Tensor, barrier_decay: float) -> th.Tensor:
    """
    By how much the barrier condition h' <= (1 - alpha_b) h on h = Gamma - d is violated.

    The discrete control barrier function of arXiv 2407.06317, whose literal form is the case d = 0.

    :param risk_next: Gamma some steps ahead
    :param risk_now: Gamma now, of the same shape
    :param budget: d, the discounted budget
    :param barrier_decay: alpha_b in (0, 1], larger is less conservative
    :return: the residual, of the same shape; <= 0 where the condition holds
    """
    return risk_next - (1.0 - barrier_decay) * risk_now - barrier_decay * budget


def correct_logit(logit: th.Tensor, positive_weight: float) -> th.Tensor:
    """
    Undo the bias of a cross-entropy whose positive class was weighted: p = p' / (p' + w (1 - p')).

    :param logit: output of the head that was trained with the weight
    :param positive_weight: w > 0
    :return: the logit of the true probability, of the same shape
    """
    return logit - math.log(positive_weight)
