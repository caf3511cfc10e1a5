"""What the critics of ESAD-LEND learn: targets from imagined trajectories and from recorded transitions."""

from typing import NamedTuple

import torch as th

from sb3_esad.common.functional import (
    expected_squared_error,
    indicator_joint,
    lambda_return,
    sampled_variance_target,
)
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.rssm import Filtered
from sb3_esad.common.type_aliases import Imagination, LatentState, Predictions, SequenceSamples


class Transitions(NamedTuple):
    """
    N steps with the states before and after.

    :param states: with the executed actions
    :param next_states: with actions of the present policy
    :param outcomes: reward, cost and continuation of the step, fields of shape (N,)
    :param event_weights: correct the over-representation of costs, of shape (N,)
    """

    states: LatentState
    next_states: LatentState
    outcomes: Predictions
    event_weights: th.Tensor


class CostTargets(NamedTuple):
    """
    Mean and variance of the discounted cost.

    :param means: shape (N,)
    :param variances: shape (N,)
    """

    means: th.Tensor
    variances: th.Tensor


@th.no_grad()
def recorded_transitions(policy: LatentPolicy, samples: SequenceSamples, filtered: Filtered) -> Transitions:
    """
    Pair the filtered states of recorded windows.

    :param policy: draws the next actions
    :param samples: windows
    :param filtered: their states
    :return: B * T transitions
    """
    states, reached = (state.map(lambda field: field.flatten(0, 1)) for state in (filtered.before, filtered.states))
    outcomes = Predictions(*(field.T.flatten() for field in (samples.rewards, samples.costs, samples.continues)))
    weights = samples.event_weights.expand_as(samples.rewards.T).flatten()
    return Transitions(states, reached._replace(action=policy.actor(reached)), outcomes, weights)


def imagined_transitions(imagined: Imagination) -> LatentState:
    """
    Line up the states from which imagined steps were made.

    :param imagined: trajectories of H steps
    :return: H * N states with their actions
    """
    return imagined.states.map(lambda field: field[:-1].flatten(0, 1))


@th.no_grad()
def return_targets(policy: LatentPolicy, imagined: Imagination, gamma: float, lambda_: float) -> th.Tensor:
    """
    Lambda-returns of the reward, bootstrapped by the smaller of the target critics.

    :param policy: owns the critics
    :param imagined: trajectories of H steps
    :param gamma: discount
    :param lambda_: mixing of n-step returns
    :return: shape (H, N)
    """
    reached = imagined.states.map(lambda field: field[1:].flatten(0, 1))
    rewards, _, continues = imagined.predictions
    values = policy.critic_target(reached).min(0).values.view_as(rewards)
    return lambda_return(rewards.T, continues.T, values.T, gamma, lambda_).T


@th.no_grad()
def cost_targets(
    policy: LatentPolicy, imagined: Imagination, gamma: float, lambda_: float, continue_after_cost: float
) -> CostTargets:
    """
    Lambda-returns of the cost and of its variance (Sherstan et al. 2018), bootstrapped by the mean of the target critics.

    :param policy: owns the critics
    :param imagined: trajectories of H steps
    :param gamma: discount of the cost
    :param lambda_: mixing of n-step returns
    :param continue_after_cost: how often an episode goes on after a cost
    :return: fields of shape (H, N)
    """
    reached = imagined.states.map(lambda field: field[1:].flatten(0, 1))
    _, costs, continues = imagined.predictions
    next_means, next_variances = policy.cost_critic_target(reached)
    next_mean, next_variance = next_means.mean(0).view_as(costs), next_variances.view_as(costs)
    means, _ = policy.cost_critic(imagined_transitions(imagined))
    joint = indicator_joint(costs, continues, continue_after_cost)
    error = expected_squared_error(costs, costs, joint, continues, means.mean(0).view_as(costs), next_mean, gamma)
    return CostTargets(
        lambda_return(costs.T, continues.T, next_mean.T, gamma, lambda_).T,
        lambda_return(error.T, continues.T, next_variance.T, gamma**2, lambda_).T,
    )


@th.no_grad()
def recorded_return_targets(policy: LatentPolicy, recorded: Transitions, gamma: float) -> th.Tensor:
    """
    One-step targets of the reward critics from what really happened.

    :param policy: owns the critics
    :param recorded: N transitions
    :param gamma: discount
    :return: shape (N,)
    """
    rewards, _, continues = recorded.outcomes
    return rewards + gamma * continues * policy.critic_target(recorded.next_states).min(0).values


@th.no_grad()
def recorded_cost_targets(policy: LatentPolicy, recorded: Transitions, gamma: float) -> CostTargets:
    """
    One-step targets of the cost critics from what really happened: they keep the critics honest when the model is not.

    :param policy: owns the critics
    :param recorded: N transitions
    :param gamma: discount of the cost
    :return: fields of shape (N,)
    """
    _, costs, continues = recorded.outcomes
    next_means, next_variance = policy.cost_critic_target(recorded.next_states)
    next_mean = next_means.mean(0)
    mean = policy.cost_critic(recorded.states)[0].mean(0)
    return CostTargets(
        costs + gamma * continues * next_mean,
        sampled_variance_target(costs, continues, mean, next_mean, next_variance, gamma),
    )
