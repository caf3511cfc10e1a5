"""ESAD-LEND with a part replaced that the package has no other for: what experiments compare it with."""

from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_esad import ESADLEND
from sb3_esad.common.critics import MIN_VARIANCE, CostCritic
from sb3_esad.common.functional import gaussian_cvar
from sb3_esad.common.imagined_returns import imagined_costs, taken
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.type_aliases import Imagination, Logs
from sb3_esad.esad_lend.policies import CnnPolicy

SMALLEST_VARIANCE = 1e-6
"""With ``MIN_VARIANCE`` the risk of a Gaussian would be .008 at least, and the highway's budget is .0037."""


class GaussianCostCritic(CostCritic):
    """Cost critic whose risk is that of a Gaussian, bounded neither by mean / alpha nor by the largest cost."""

    def raw(self, state: PyTorchObs, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        What the losses are taken on, with variances that may be smaller.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :return: logits of shape (n_critics, N), variance of shape (N,)
        """
        logits, variance = super().raw(state, action)
        return logits, variance - MIN_VARIANCE + SMALLEST_VARIANCE

    def risk(self, means: th.Tensor, variance: th.Tensor, risk_level: float) -> th.Tensor:
        """
        Conditional value at risk of a Gaussian by the more pessimistic mean (arXiv 2407.06317).

        :param means: shape (n_critics, N)
        :param variance: shape (N,)
        :param risk_level: worst fraction of outcomes, in (0, 1]
        :return: shape (N,)
        """
        return gaussian_cvar(means, variance, risk_level).max(0).values


class GaussianRiskPolicy(CnnPolicy):
    """Policy with that critic."""

    cost_critic_class = GaussianCostCritic


class GaussianRisk(ESADLEND):
    """
    E2: the risk of a Gaussian for actor and multiplier, from images.

    As in :func:`rising_cvar` the variance has no gradient; without the bound the risk rises by 1 with the mean, with it by
    1 / alpha where crashes are rare.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": GaussianRiskPolicy}

    def _imagined_risk(self, imagined: Imagination) -> th.Tensor:
        costs = imagined_costs(self.policy.cost_critic, imagined, self.discount_of_cost, self.lambda_return)
        _, variance = self.policy.cost_critic(*taken(imagined))
        return gaussian_cvar(costs, variance.view_as(costs).detach(), self.risk_level)


class SingleSignalPenalty(AugmentedLagrangian):
    """Multiplier that follows one of its two signals."""

    signal: ClassVar[str]

    def _signals(self, violation: float) -> Logs:
        return {name: value for name, value in super()._signals(violation).items() if name == self.signal}


class CriticsOnlyPenalty(SingleSignalPenalty):
    """Multiplier that follows what the critics expect, as long as the road finds them calibrated; it holds still else."""

    signal = "violation_model"


class RoadOnlyPenalty(SingleSignalPenalty):
    """Multiplier that follows what the road has shown."""

    signal = "violation_road"


class CriticsOnly(ESADLEND):
    """E3: the critics alone move the multiplier, where they are calibrated."""

    penalty_class = CriticsOnlyPenalty


class RoadOnly(ESADLEND):
    """E3: the road alone moves the multiplier."""

    penalty_class = RoadOnlyPenalty


class SteadyModel(ESADLEND):
    """Crawl: the rate of the world model, too, does not fall below ``min_cost_critic_rate`` of the first one."""

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        for group in self.policy.world_model.optimizer.param_groups:
            group["lr"] = max(group["lr"], self.min_cost_critic_rate * self.lr_schedule(1))


VARIANTS: dict[str, type[ESADLEND]] = {
    "gaussian_risk": GaussianRisk,
    "critics_only": CriticsOnly,
    "road_only": RoadOnly,
    "steady_model": SteadyModel,
}
