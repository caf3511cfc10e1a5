"""How a cost limit enters learning and acting, and the absence of one."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from torch import nn

from sb3_esad.common.type_aliases import Logs


class Penalty(nn.Module, ABC):
    """How a cost limit enters the actor's loss and the choice of actions."""

    cost_limit: float | None
    """Undiscounted cost allowed per episode; None is no limit."""

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """
        Go on from a saved state; a limit where there was none begins anew, and where there is none now nothing is needed.

        :param state_dict: of any penalty, empty for that of :class:`NoPenalty`
        :param strict: see torch's ``Module.load_state_dict``
        :param assign: likewise
        :return: likewise
        """
        own = self.state_dict()
        return super().load_state_dict(state_dict if bool(state_dict) == bool(own) else own, strict, assign)

    @property
    @abstractmethod
    def budget(self) -> float:
        """d, the discounted cost that is allowed."""

    @property
    @abstractmethod
    def budget_scale(self) -> float:
        """d_s > 0, by which violations are normalised."""

    @abstractmethod
    def trusts_critics(self, n_updates: int) -> bool:
        """
        Tell whether what the critics expect may decide about actions.

        :param n_updates: before which it may not
        :return: whether there have been as many, and predictions come true
        """

    @abstractmethod
    def forward(self, violation: th.Tensor) -> th.Tensor:
        """
        Penalise a violation; :meth:`combine` weighs risks by the derivative of this.

        :param violation: Gamma - d, <= 0 where the limit is kept
        :return: psi, the penalty of the violation, of the same shape
        """

    @abstractmethod
    def combine(self, objective: th.Tensor, risk: th.Tensor, barrier: th.Tensor) -> th.Tensor:
        """
        Weigh the risk of each imagined step beside what the actor wants.

        :param objective: what the actor minimises apart from safety
        :param risk: Gamma of each imagined step, of the same shape
        :param barrier: residual of the barrier condition, of the same shape
        :return: the loss of the actor, of the same shape
        """

    @abstractmethod
    def admissible(self, risk: th.Tensor, barrier: th.Tensor) -> th.Tensor:
        """
        Tell which actions may be executed.

        :param risk: estimated Gamma of candidate actions
        :param barrier: residual of the barrier condition, of the same shape
        :return: bool, whether each candidate may be executed
        """

    @abstractmethod
    def observe(self, costs: np.ndarray, dones: np.ndarray, truncated: np.ndarray | None = None) -> None:
        """
        Take note of one step of the environments.

        :param costs: (n_envs,)
        :param dones: (n_envs,)
        :param truncated: (n_envs,), whether only time was up; None for none
        """

    @abstractmethod
    def pass_over(self, dones: np.ndarray) -> None:
        """
        Let a step of random actions go by, whose costs say nothing about the policy.

        :param dones: (n_envs,)
        """

    @abstractmethod
    def forget_unfinished(self) -> None:
        """Drop the episodes under way, for the environments have been reset."""

    @abstractmethod
    def note_prediction(self, values: th.Tensor) -> None:
        """
        Take note of what the critic expects where the policy is.

        :param values: Q^c(s, a) of the states visited, of shape (n_envs,)
        """

    @abstractmethod
    def update(self, violation: float | th.Tensor | None, gradient_steps: int = 1) -> Logs:
        """
        Move the multiplier.

        :param violation: mean of Gamma - d over the states visited since the last call, None if there is none
        :param gradient_steps: number of updates since the last call
        :return: values to log
        """


def kept_limit(model: BaseAlgorithm) -> float | None:
    """
    Tell what limit a model keeps, if it is one of ours; what it was given may be of no effect.

    :param model: of any algorithm
    :return: undiscounted cost allowed per episode, None for no limit
    """
    limit: float | None = getattr(getattr(model, "penalty", model), "cost_limit", None)
    return limit


class NoPenalty(Penalty):
    """
    The absence of a limit: nothing is penalised, everything is admissible.

    :param settings: those of :class:`AugmentedLagrangian`, so that either can be built by the same call; ignored
    """

    cost_limit = None
    budget = 0.0
    budget_scale = 1.0

    def __init__(self, **settings: Any) -> None:
        super().__init__()

    def trusts_critics(self, n_updates: int) -> bool:
        return True

    def forward(self, violation: th.Tensor) -> th.Tensor:
        return th.zeros_like(violation)  # not 0 * violation: nan must not leak

    def combine(self, objective: th.Tensor, risk: th.Tensor, barrier: th.Tensor) -> th.Tensor:
        return objective

    def admissible(self, risk: th.Tensor, barrier: th.Tensor) -> th.Tensor:
        return th.ones_like(risk, dtype=th.bool)

    def observe(self, costs: np.ndarray, dones: np.ndarray, truncated: np.ndarray | None = None) -> None:
        pass

    def pass_over(self, dones: np.ndarray) -> None:
        pass

    def forget_unfinished(self) -> None:
        pass

    def note_prediction(self, values: th.Tensor) -> None:
        pass

    def update(self, violation: float | th.Tensor | None, gradient_steps: int = 1) -> Logs:
        return {}
