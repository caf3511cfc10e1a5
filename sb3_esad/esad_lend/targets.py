"""
What the critics of ESAD-LEND learn: targets from imagined trajectories and from recorded transitions.

Critics bootstrap from their slow averages, as in SAC.
"""

from typing import NamedTuple

import torch as th

from sb3_esad.common.critics import CostCritic, CostTargets, QEnsemble
from sb3_esad.common.functional import expected_squared_error, indicator_joint
from sb3_esad.common.imagined_returns import reached, taken
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.returns import corrected_return, lambda_return
from sb3_esad.common.rssm import Filtered
from sb3_esad.common.type_aliases import Imagination, Predictions, SequenceSamples


class Transitions(NamedTuple):
    """
    N = T * B recorded steps, time-major, with the states before and after.

    :param grids: features of the states, of shape (N, C, H, W)
    :param actions: executed in them, of shape (N, A)
    :param next_grids: features of the states reached, of shape (N, C, H, W)
    :param next_actions: of the present policy, of shape (N, A)
    :param outcomes: reward, cost and continuation of the step, fields of shape (N,)
    :param event_weights: correct the over-representation of costs, of shape (N,)
    :param followed: whether the next step of the window goes on from the state reached, of shape (T, B)
    """

    grids: th.Tensor
    actions: th.Tensor
    next_grids: th.Tensor
    next_actions: th.Tensor
    outcomes: Predictions
    event_weights: th.Tensor
    followed: th.Tensor


@th.no_grad()
def recorded_transitions(policy: LatentPolicy, samples: SequenceSamples, filtered: Filtered) -> Transitions:
    """
    Pair the filtered states of recorded windows.

    :param policy: draws the next actions
    :param samples: windows
    :param filtered: their states
    :return: T * B transitions
    """
    before, after = (state.map(lambda field: field.flatten(0, 1)) for state in (filtered.before, filtered.states))
    grids, next_grids = policy.world_model.features(before), policy.world_model.features(after)
    outcomes = Predictions(*(field.T.flatten() for field in (samples.rewards, samples.costs, samples.continues)))
    weights = samples.event_weights.expand_as(samples.rewards.T).flatten()
    followed = th.cat([~filtered.is_first[1:], th.zeros_like(filtered.is_first[:1])])
    return Transitions(grids, before.action, next_grids, policy.actor(next_grids), outcomes, weights, followed)


@th.no_grad()
def cost_targets(
    critic: CostCritic, imagined: Imagination, gamma: float, lambda_: float, continue_after_cost: float
) -> CostTargets:
    """
    Lambda-returns of the cost and of its variance (Sherstan et al. 2018), bootstrapped by the mean of the estimates.

    :param critic: ensemble to bootstrap from
    :param imagined: trajectories of H steps
    :param gamma: discount of the cost
    :param lambda_: mixing of n-step returns
    :param continue_after_cost: how often an episode goes on after a cost
    :return: fields of shape (H, N)
    """
    _, costs, continues = imagined.predictions
    next_means, next_variances = critic(*reached(imagined))
    next_mean, next_variance = next_means.mean(0).view_as(costs), next_variances.view_as(costs)
    means, _ = critic(*taken(imagined))
    joint = indicator_joint(costs, continues, continue_after_cost)
    error = expected_squared_error(costs, costs, joint, continues, means.mean(0).view_as(costs), next_mean, gamma)
    return CostTargets(
        lambda_return(costs.T, continues.T, next_mean.T, gamma, lambda_).T,
        lambda_return(error.T, continues.T, next_variance.T, gamma**2, lambda_).T,
    )


@th.no_grad()
def recorded_return_targets(critic: QEnsemble, recorded: Transitions, gamma: float) -> th.Tensor:
    """
    One-step targets of the reward critics from what really happened.

    :param critic: ensemble to bootstrap from
    :param recorded: N transitions
    :param gamma: discount
    :return: shape (N,)
    """
    rewards, _, continues = recorded.outcomes
    return rewards + gamma * continues * critic(recorded.next_grids, recorded.next_actions).min(0).values


@th.no_grad()
def recorded_cost_targets(critic: CostCritic, recorded: Transitions, gamma: float, lambda_: float) -> CostTargets:
    """
    Corrected returns of what really happened: they keep the critics honest when the model is not.

    Mean and variance (Sherstan et al. 2018) by the same recursion, the latter over squared one-step errors with gamma^2.
    One-step targets would be outvoted by dreams, in which ten predicted costs add up, and follow them slowly; returns without
    the correction blame a policy for what it would not do (docs/experiments.md, section 18).

    :param critic: ensemble to bootstrap from
    :param recorded: N transitions
    :param gamma: discount of the cost
    :param lambda_: mixing of n-step returns
    :return: fields of shape (N,)
    """
    means, variance = critic(recorded.grids, recorded.actions)
    next_means, next_variance = critic(recorded.next_grids, recorded.next_actions)
    _, costs, continues = recorded.outcomes
    fields = (costs, continues, means.mean(0), variance, next_means.mean(0), next_variance)
    costs, continues, mean, variance, next_mean, next_variance = (field.view_as(recorded.followed).T for field in fields)
    traces = lambda_ * recorded.followed.T
    error = (costs + gamma * continues * next_mean - mean) ** 2
    costs_to_come = corrected_return(costs, continues, mean, next_mean, traces, gamma)
    # Negative where corrections exceed what is left. Cut like means outside [0, bound], in CostCritic.loss: that leaves a
    # little of what was corrected, and keeps critics that are wrong from driving each other on
    variance_to_come = corrected_return(error, continues, variance, next_variance, traces, gamma**2).clamp(min=0)
    return CostTargets(costs_to_come.T.flatten(), variance_to_come.T.flatten())
