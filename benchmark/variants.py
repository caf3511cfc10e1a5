"""ESAD-LEND with a part replaced that the package has no other for: what experiments compare it with."""

from typing import ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_esad import ESADLEND
from sb3_esad.common.critics import CostCritic
from sb3_esad.common.functional import gaussian_cvar
from sb3_esad.common.imagined_returns import imagined_costs, taken
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.type_aliases import Imagination, Logs
from sb3_esad.esad_lend.policies import CnnPolicy


class GaussianCostCritic(CostCritic):
    """Cost critic whose risk is that of a Gaussian, however improbable a cost is (arXiv 2407.06317)."""

    def risk(self, means: th.Tensor, variance: th.Tensor, risk_level: float) -> th.Tensor:
        """
        Conditional value at risk by the more pessimistic mean, without the bound of :func:`capped_cvar`.

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
    """E2: the risk of a Gaussian, for actor, multiplier and filter."""

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": GaussianRiskPolicy}

    def _imagined_risk(self, imagined: Imagination) -> th.Tensor:
        costs = imagined_costs(self.policy.cost_critic, imagined, self.discount_of_cost, self.lambda_return)
        _, variance = self.policy.cost_critic(*taken(imagined))
        return gaussian_cvar(costs, variance.view_as(costs).detach(), self.risk_level)


class OneSignal(AugmentedLagrangian):
    """Multiplier that follows one of its two signals."""

    signal: ClassVar[str]

    def _signals(self, violation: float) -> Logs:
        return {name: value for name, value in super()._signals(violation).items() if name == self.signal}


class ModelSignalPenalty(OneSignal):
    """Multiplier that follows what the critics expect."""

    signal = "violation_model"


class RoadSignalPenalty(OneSignal):
    """Multiplier that follows what the road has shown."""

    signal = "violation_road"


class ModelSignal(ESADLEND):
    """E3: the critics alone move the multiplier."""

    penalty_class = ModelSignalPenalty


class RoadSignal(ESADLEND):
    """E3: the road alone moves the multiplier."""

    penalty_class = RoadSignalPenalty


VARIANTS: dict[str, type[ESADLEND]] = {
    "gaussian_risk": GaussianRisk,
    "model_signal": ModelSignal,
    "road_signal": RoadSignal,
}
