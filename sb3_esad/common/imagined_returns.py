"""What imagined trajectories earn and cost, by what the model predicts on the way and the critics at its end."""

import torch as th

from sb3_esad.common.critics import CostCritic, QEnsemble
from sb3_esad.common.returns import lambda_return
from sb3_esad.common.type_aliases import Imagination


def taken(imagined: Imagination) -> tuple[th.Tensor, th.Tensor]:
    """
    Line up the imagined steps.

    :param imagined: trajectories of H steps
    :return: features of the H * N states and the actions taken in them
    """
    return imagined.grids[:-1].flatten(0, 1), imagined.actions[:-1].flatten(0, 1)


def reached(imagined: Imagination) -> tuple[th.Tensor, th.Tensor]:
    """
    Line up the states that the imagined steps reach.

    :param imagined: trajectories of H steps
    :return: features of the H * N states and the actions that follow
    """
    return imagined.grids[1:].flatten(0, 1), imagined.actions[1:].flatten(0, 1)


def imagined_returns(critic: QEnsemble, imagined: Imagination, gamma: float, lambda_: float) -> th.Tensor:
    """
    Lambda-returns of the reward, bootstrapped by the smallest estimate.

    :param critic: ensemble to bootstrap from
    :param imagined: trajectories of H steps
    :param gamma: discount
    :param lambda_: mixing of n-step returns
    :return: shape (H, N)
    """
    rewards, _, continues = imagined.predictions
    values = critic(*reached(imagined)).min(0).values.view_as(rewards)
    return lambda_return(rewards.T, continues.T, values.T, gamma, lambda_).T


def imagined_costs(critic: CostCritic, imagined: Imagination, gamma: float, lambda_: float) -> th.Tensor:
    """
    Lambda-returns of the cost, bootstrapped by the largest estimate: pessimism belongs to decisions, not to targets.

    :param critic: ensemble to bootstrap from
    :param imagined: trajectories of H steps
    :param gamma: discount of the cost
    :param lambda_: mixing of n-step returns
    :return: shape (H, N)
    """
    _, costs, continues = imagined.predictions
    means, _ = critic(*reached(imagined))
    return lambda_return(costs.T, continues.T, means.max(0).values.view_as(costs).T, gamma, lambda_).T
