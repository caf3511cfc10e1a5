"""An off-policy algorithm that learns within a budget of cost."""

from abc import abstractmethod
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, PyTorchObs, Schedule

from sb3_esad.common.callbacks import LagrangeCallback, prepend
from sb3_esad.common.checks import require
from sb3_esad.common.cost_aware_algorithm import CostAwareAlgorithm
from sb3_esad.common.functional import tail_factor
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.penalties import NoPenalty, Penalty

UNKNOWN_LENGTH = 1000.0


class CostLimitedAlgorithm(CostAwareAlgorithm):
    """
    An algorithm of SB3 whose risk, as its cost critics see it, shall stay within a budget.

    A mixin, to be named before the algorithm that it extends. The policy of that one has a ``cost_critic`` and its average, a
    ``cost_critic_target``; both are a :class:`CostCritic`.

    :param policy: policy with a cost critic, or the alias of one
    :param env: environment whose info dict holds a cost in [0, 1]
    :param learning_rate: of all networks, a number or a function of the remaining progress
    :param cost_limit: undiscounted cost allowed per episode; 0 is strict, None is no limit
    :param risk_level: worst fraction of outcomes that shall keep the limit, in (0, 1]; 1 limits the mean
    :param cost_gamma: discount of the cost; None for ``gamma``
    :param lagrangian_multiplier_init: initial multiplier
    :param lambda_lr: step of the multiplier per update
    :param lagrangian_upper_bound: largest multiplier
    :param penalty_coef: proportional gain of the augmented Lagrangian; 0 is the plain Lagrangian
    :param penalty_warmup: updates during which the multiplier is held
    :param kwargs: see :class:`CostAwareAlgorithm`
    :raises ValueError: if an argument is out of its range
    """

    penalty_class: ClassVar[type[Penalty]] = AugmentedLagrangian
    policy: Any

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule,
        cost_limit: float | None = 0.05,
        risk_level: float = 0.5,
        cost_gamma: float | None = None,
        lagrangian_multiplier_init: float = 2.0,
        lambda_lr: float = 0.01,
        lagrangian_upper_bound: float = 50.0,
        penalty_coef: float = 1.0,
        penalty_warmup: int = 100,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, learning_rate, **kwargs)
        self.cost_limit = cost_limit
        self.risk_level = risk_level
        self.cost_gamma = cost_gamma
        self.lagrangian_multiplier_init = lagrangian_multiplier_init
        self.lambda_lr = lambda_lr
        self.lagrangian_upper_bound = lagrangian_upper_bound
        self.penalty_coef = penalty_coef
        self.penalty_warmup = penalty_warmup
        self._n_updates_penalized = 0

    def _check_arguments(self) -> None:
        super()._check_arguments()
        tail_factor(self.risk_level)  # refuses a level outside (0, 1], with and without a limit
        discount = self.discount_of_cost
        require(0 <= discount < 1, "cost_gamma", discount, "a discount in [0, 1), also where it is gamma")

    def _setup_model(self) -> None:
        super()._setup_model()
        self.penalty = self._make_penalty()  # on the CPU: single numbers, which are read at every step
        self._violations: list[th.Tensor] = []
        self.last_risk: th.Tensor | None = None

    def _make_penalty(self, **further: Any) -> Penalty:
        penalty_class = NoPenalty if self.cost_limit is None else self.penalty_class
        return penalty_class(
            cost_limit=self.cost_limit,
            risk_level=self.risk_level,
            cost_gamma=self.discount_of_cost,
            episode_length=self._episode_length(),
            lambda_lr=self.lambda_lr,
            lagrangian_multiplier_init=self.lagrangian_multiplier_init,
            multiplier_bounds=(max(0.0, min(0.05, self.lagrangian_multiplier_init)), self.lagrangian_upper_bound),
            penalty_coef=self.penalty_coef,
            penalty_warmup=self.penalty_warmup,
            **further,
        )

    def _episode_length(self) -> float:
        """Longest episode the environment admits, until episodes have been seen."""
        if self.env is None:
            return UNKNOWN_LENGTH
        for name in ("max_episode_steps", "_max_episode_steps"):  # of a scenario, and of gymnasium's TimeLimit
            if self.env.has_attr(name):
                return float(self.env.get_attr(name)[0] or UNKNOWN_LENGTH)
        return UNKNOWN_LENGTH

    @property
    def discount_of_cost(self) -> float:
        """``cost_gamma``, or ``gamma`` where it is None."""
        return self.gamma if self.cost_gamma is None else self.cost_gamma

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        return super()._init_callback(prepend(LagrangeCallback(), callback), progress_bar)

    def begin_anew(self, seed: int) -> None:
        """
        Begin new episodes, and forget what the penalty has seen of those under way.

        :param seed: see :meth:`CostAwareAlgorithm.begin_anew`
        """
        super().begin_anew(seed)
        self.penalty.forget_unfinished()

    def take_violation(self) -> tuple[th.Tensor | None, int]:
        """
        Hand over how far the expected risk exceeded the budget since the last call.

        :return: mean of Gamma - d over the states visited, None if there were none or the critics have not been updated yet,
            and the number of updates since the last call
        """
        violations, self._violations = self._violations, []
        # Not counted by the callback: the last update of one learn() is seen by the first rollout of the next
        n_updates, self._n_updates_penalized = self._n_updates - self._n_updates_penalized, self._n_updates
        return th.stack(violations).mean() if violations else None, n_updates

    @abstractmethod
    def _last_state(self) -> PyTorchObs:
        """Present states of the environments, as the cost critics are shown them."""

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        actions, buffer_actions = super()._sample_action(learning_starts, action_noise, n_envs)
        self.last_risk = None
        if self._n_updates > 0 and self.num_timesteps >= learning_starts:
            self._note_risk(th.as_tensor(buffer_actions, dtype=th.float32, device=self.device).flatten(1))
        return actions, buffer_actions

    @th.no_grad()
    def _note_risk(self, actions: th.Tensor) -> None:
        """Note what the critics expect where the policy really is: replayed states are those of policies that are gone."""
        means, variance = self.policy.cost_critic_target(self._last_state(), actions)
        self.last_risk = self.policy.cost_critic_target.risk(means, variance, self.risk_level)
        self._violations.append(self.last_risk.mean() - self.penalty.budget)
        self.penalty.note_prediction(means.mean(0))

    def risk(self, states: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        Safety measure Gamma: conditional value at risk of the cost to come, by the more pessimistic target critic.

        :param states: N states, as the cost critics are shown them
        :param actions: their actions, scaled to [-1, 1], of shape (N, A)
        :return: shape (N,)
        """
        means, variance = self.policy.cost_critic_target(states, actions)
        return self.policy.cost_critic_target.risk(means, variance, self.risk_level)

    def _raise_cost_bound(self) -> float:
        """
        Make room for discounted costs above one where an episode goes on after a cost.

        :return: how often it does
        """
        continue_after_cost = self.replay_buffer.continue_after_cost
        if continue_after_cost > 0:
            for critic in (self.policy.cost_critic, self.policy.cost_critic_target):
                critic.raise_bound(1 / (1 - self.discount_of_cost))
        return continue_after_cost

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "penalty"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "penalty", "_violations", "last_risk"]
