"""Where an action leads: a few imagined steps, judged by the critics at their end."""

from typing import NamedTuple

import torch as th

from sb3_esad.common.agent import LatentAgent
from sb3_esad.common.functional import barrier_residual
from sb3_esad.common.returns import lambda_return
from sb3_esad.common.type_aliases import Imagination, LatentState


class Outlook(NamedTuple):
    """
    What is expected of actions, fields of the same shape.

    :param risks: Gamma, the conditional value at risk of the cost to come, as imagined
    :param critic_risks: the same as the critics see it at once
    :param next_risks: as they see it where the actions lead to in m steps, 0 where an episode is over by then
    """

    risks: th.Tensor
    critic_risks: th.Tensor
    next_risks: th.Tensor


class Foresight:
    """
    Imagines an action and what the actor would do after it.

    The cost to come is that of the imagined steps and of the critic at their end, as in training: what a single action does,
    critics see less well than a world model (docs/experiments.md, section 5).

    :param steps: m, imagined steps
    :param gamma: discount of the return
    :param cost_gamma: discount of the cost
    :param risk_level: worst fraction of outcomes
    :param barrier_decay: alpha_b, how fast the risk must return to the budget
    """

    def __init__(self, steps: int, gamma: float, cost_gamma: float, risk_level: float, barrier_decay: float) -> None:
        self.steps = steps
        self.gamma = gamma
        self.cost_gamma = cost_gamma
        self.risk_level = risk_level
        self.barrier_decay = barrier_decay

    def imagine(self, agent: LatentAgent, start: LatentState) -> Imagination:
        """
        Look ahead.

        :param agent: whose model and actor imagine
        :param start: N states and the actions taken in them
        :return: the m steps
        """
        return agent.world_model.imagine(start, lambda grid: agent.actor(grid, deterministic=True), self.steps, self.gamma)

    def outlook(self, agent: LatentAgent, imagined: Imagination) -> Outlook:
        """
        Tell how dangerous what was imagined is.

        :param agent: whose critics judge
        :param imagined: m steps from N states
        :return: fields of shape (N,)
        """
        _, costs, continues = imagined.predictions
        # Beginning and end at once: for so few states it is the number of calls that takes time
        begin_and_end = (th.cat([field[0], field[-1]]) for field in (imagined.grids, imagined.actions))
        means, variances = agent.cost_critic(*begin_and_end)
        critic_risks, end_risks = agent.cost_critic.risk(means, variances, self.risk_level).chunk(2)
        cost_to_come = _sum_up(costs, continues, means.chunk(2, 1)[1].max(0).values, self.cost_gamma)
        risks = agent.cost_critic.risk(cost_to_come[None], variances.chunk(2)[0], self.risk_level)
        return Outlook(risks, critic_risks, continues.prod(0) * end_risks)

    def values(self, agent: LatentAgent, imagined: Imagination) -> th.Tensor:
        """
        Tell the return to come.

        :param agent: whose critics judge
        :param imagined: m steps from N states
        :return: shape (N,)
        """
        rewards, _, continues = imagined.predictions
        end = agent.critic(imagined.grids[-1], imagined.actions[-1]).min(0).values
        return _sum_up(rewards, continues, end, self.gamma)

    def risk(self, agent: LatentAgent, grids: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Safety measure Gamma of actions, as the critics see it.

        :param agent: whose critics judge
        :param grids: features of N states, of shape (N, C, H, W)
        :param actions: shape (N, A)
        :return: shape (N,)
        """
        means, variance = agent.cost_critic(grids, actions)
        return agent.cost_critic.risk(means, variance, self.risk_level)

    def barrier(self, outlook: Outlook, budget: float) -> th.Tensor:
        """
        By how much the barrier condition is violated, by what critics see at both ends: what is imagined differs from it.

        :param outlook: of actions
        :param budget: d, the discounted budget
        :return: residual, <= 0 where the condition holds, of the shape of its fields
        """
        return barrier_residual(outlook.next_risks, outlook.critic_risks, budget, self.barrier_decay)


def _sum_up(amounts: th.Tensor, continues: th.Tensor, end: th.Tensor, gamma: float) -> th.Tensor:
    """What H steps bring, fields of shape (H, N), and what is expected after the last one, of shape (N,)."""
    expected = end[:, None].expand(-1, len(amounts))  # of which only the last column counts where lambda is 1
    return lambda_return(amounts.T, continues.T, expected, gamma, lambda_=1.0)[:, 0]
