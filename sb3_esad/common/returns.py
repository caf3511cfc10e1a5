"""What is to come along a trajectory, each step judged by those that followed it."""

import torch as th


def lambda_return(rewards: th.Tensor, continues: th.Tensor, next_values: th.Tensor, gamma: float, lambda_: float) -> th.Tensor:
    """
    Mixture of all n-step returns along a trajectory (Sutton & Barto 2018, Sec. 12.1; Hafner et al., Dreamer, 2020).

    y_t = r_t + gamma k_t [(1 - lambda) v_t + lambda y_{t+1}], where r_t, k_t, v_t belong to the state reached by step t.

    :param rewards: (..., T), reward or cost of each step
    :param continues: (..., T), probability that the episode goes on after the step
    :param next_values: (..., T), value of the state that the step reaches
    :param gamma: discount
    :param lambda_: in [0, 1]; 0 is the one-step target, 1 the discounted sum
    :return: (..., T)
    """
    returns = []
    following = next_values[..., -1]
    for t in reversed(range(rewards.shape[-1])):
        bootstrap = (1.0 - lambda_) * next_values[..., t] + lambda_ * following
        following = rewards[..., t] + gamma * continues[..., t] * bootstrap
        returns.append(following)
    return th.stack(returns[::-1], dim=-1)


def corrected_return(
    rewards: th.Tensor, continues: th.Tensor, values: th.Tensor, next_values: th.Tensor, traces: th.Tensor, gamma: float
) -> th.Tensor:
    """
    Mixture of n-step returns along what another policy did, corrected by what the present one would do.

    Q(lambda) with off-policy corrections (Harutyunyan et al. 2016, arXiv 1602.04951).

    y_t = r_t + gamma k_t v_t + gamma k_t l_t (y_{t+1} - q_{t+1}): what a later action earns more or less than the present
    policy's own is known to q, and not put down to the steps before it. As far as it is not known it is, until q has learned
    it; where policies differ much nothing but slow targets keeps that from swinging.

    :param rewards: (..., T), reward or cost of each step
    :param continues: (..., T), 0 where the step ended the episode, 1 elsewhere
    :param values: (..., T), q of each state and the action that was taken in it
    :param next_values: (..., T), v of the state that the step reached, q of an action of the present policy if sampled
    :param traces: (..., T), l in [0, 1], how much what follows the step may say about it; 0 is the one-step target
    :param gamma: discount
    :return: (..., T)
    """
    returns = []
    surprise = th.zeros_like(rewards[..., -1])
    for t in reversed(range(rewards.shape[-1])):
        bootstrap = next_values[..., t] + traces[..., t] * surprise
        returns.append(rewards[..., t] + gamma * continues[..., t] * bootstrap)
        surprise = returns[-1] - values[..., t]
    return th.stack(returns[::-1], dim=-1)
