"""The base of the algorithms that learn from imagination within a budget of cost."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_esad.common.callbacks import LagrangeCallback, prepend
from sb3_esad.common.checks import require
from sb3_esad.common.foresight import Foresight
from sb3_esad.common.functional import barrier_residual, tail_factor
from sb3_esad.common.latent_algorithm import FALLING_RATE, LatentAlgorithm
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.penalties import NoPenalty, Penalty
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.selection import CALMEST, ActionFilter, NoFilter, SafetyFilter, SelectionRates
from sb3_esad.common.type_aliases import Belief

UNKNOWN_LENGTH = 1000.0


class ConstrainedLatentAlgorithm(LatentAlgorithm):
    """
    Base of the algorithms whose risk, as their cost critics see it, shall stay within a budget.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"`` or a :class:`LatentPolicy`
    :param env: environment with a Box action space, whose info dict holds a cost in [0, 1]
    :param learning_rate: of all networks, a number or a function of the remaining progress
    :param cost_limit: undiscounted cost allowed per episode; 0 is strict, None is no limit
    :param risk_level: worst fraction of outcomes that shall keep the limit, in (0, 1]; 1 limits the mean
    :param cost_gamma: discount of the cost; None for ``gamma``
    :param lagrangian_multiplier_init: initial multiplier
    :param lambda_lr: step of the multiplier per update
    :param lagrangian_upper_bound: largest multiplier
    :param penalty_coef: proportional gain of the augmented Lagrangian; 0 is the plain Lagrangian
    :param penalty_warmup: updates during which the multiplier is held
    :param barrier_decay: alpha_b in (0, 1], how fast the risk must return to the budget; larger is less conservative
    :param barrier_steps: m, steps over which the barrier condition is taken
    :param barrier_coef: weight of a violated barrier condition; 0 drops it
    :param filter_start: updates after which an action that is not admissible is replaced; None for never
    :param n_candidates: latents of which the worst decide whether an action is admissible
    :param n_proposals: samples of the actor, and as many uniform actions, to choose from where its own is not admissible
    :param kwargs: see :class:`LatentAlgorithm`
    :raises ValueError: if an argument is out of its range
    """

    penalty_class: ClassVar[type[Penalty]] = AugmentedLagrangian
    filter_class: ClassVar[type[ActionFilter]] = SafetyFilter

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = FALLING_RATE,
        cost_limit: float | None = 0.05,
        risk_level: float = 0.5,
        cost_gamma: float | None = None,
        lagrangian_multiplier_init: float = 2.0,
        lambda_lr: float = 0.01,
        lagrangian_upper_bound: float = 50.0,
        penalty_coef: float = 1.0,
        penalty_warmup: int = 100,
        barrier_decay: float = 0.3,
        barrier_steps: int = 2,
        barrier_coef: float = 0.0,
        filter_start: int | None = 2000,
        n_candidates: int = 8,
        n_proposals: int = 16,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, learning_rate, _init_setup_model=False, **kwargs)
        self.cost_limit = cost_limit
        self.risk_level = risk_level
        self.cost_gamma = cost_gamma
        self.lagrangian_multiplier_init = lagrangian_multiplier_init
        self.lambda_lr = lambda_lr
        self.lagrangian_upper_bound = lagrangian_upper_bound
        self.penalty_coef = penalty_coef
        self.penalty_warmup = penalty_warmup
        self.barrier_decay = barrier_decay
        self.barrier_steps = barrier_steps
        self.barrier_coef = barrier_coef
        self.filter_start = filter_start
        self.n_candidates = n_candidates
        self.n_proposals = n_proposals
        self._n_updates_penalized = 0
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        tail_factor(self.risk_level)  # refuses a level outside (0, 1], with and without a limit
        require(
            0 <= self.discount_of_cost < 1, "cost_gamma", self.discount_of_cost, "a discount in [0, 1), also where it is gamma"
        )
        require(0 < self.barrier_decay <= 1, "barrier_decay", self.barrier_decay, "a rate in (0, 1]")
        require(self.barrier_steps >= 1, "barrier_steps", self.barrier_steps, "a number of steps >= 1")
        start = self.filter_start
        require(start is None or start >= 0, "filter_start", start, "a number of updates >= 0, or None for no filter")
        require(self.n_candidates >= 1, "n_candidates", self.n_candidates, "a number of latents >= 1")
        require(self.n_proposals >= CALMEST, "n_proposals", self.n_proposals, f"a number of actions >= {CALMEST}")

    def _setup_model(self) -> None:
        super()._setup_model()
        self.penalty = self._make_penalty().to(self.device)
        self.policy.action_filter = self._make_filter()
        self._violations: list[th.Tensor] = []
        self._selections = SelectionRates()

    def _make_penalty(self) -> Penalty:
        penalty_class = NoPenalty if self.cost_limit is None else self.penalty_class
        return penalty_class(
            cost_limit=self.cost_limit,
            risk_level=self.risk_level,
            cost_gamma=self.discount_of_cost,
            episode_length=self._episode_length(),
            barrier_coef=self.barrier_coef,
            lambda_lr=self.lambda_lr,
            lagrangian_multiplier_init=self.lagrangian_multiplier_init,
            multiplier_bounds=(max(0.0, min(0.05, self.lagrangian_multiplier_init)), self.lagrangian_upper_bound),
            penalty_coef=self.penalty_coef,
            penalty_warmup=self.penalty_warmup,
        )

    def _make_filter(self) -> ActionFilter:
        filter_class = NoFilter if self.cost_limit is None or self.filter_start is None else self.filter_class
        return filter_class(
            penalty=self.penalty,
            is_active=self._filter_is_active,
            foresight=Foresight(self.barrier_steps, self.gamma, self.discount_of_cost, self.risk_level, self.barrier_decay),
            risk_level=self.risk_level,
            n_candidates=self.n_candidates,
            n_proposals=self.n_proposals,
        )

    def _filter_is_active(self) -> bool:
        assert self.filter_start is not None
        return self._n_updates >= self.filter_start and self.penalty.calibrated

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

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        sampled = super()._sample_action(learning_starts, action_noise, n_envs)
        if self._n_updates > 0 and self.num_timesteps >= learning_starts:
            self._note_risk()
        return sampled

    def _select(self, belief: Belief, proposed: th.Tensor) -> th.Tensor:
        selection = self.policy.action_filter.select(self.policy.learner, belief, proposed)
        self._selections.note(selection)
        return selection.actions

    def dump_logs(self) -> None:
        """Write the log, rates of the filter included."""
        for name, value in self._selections.take().items():
            self.logger.record(f"rollout/{name}", value)
        super().dump_logs()

    @th.no_grad()
    def _note_risk(self) -> None:
        """Note what the critics expect where the policy really is: replayed states are those of policies that are gone."""
        assert self._last_latent is not None
        grids, actions = self.policy.world_model.features(self._last_latent), self._last_latent.action
        means, variance = self.policy.cost_critic_target(grids, actions)
        risk = self.policy.cost_critic_target.risk(means, variance, self.risk_level)
        self._violations.append(risk.mean() - self.penalty.budget)
        self.penalty.note_prediction(means.mean(0))

    def risk(self, grids: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Safety measure Gamma: conditional value at risk of the cost to come, by the more pessimistic target critic.

        :param grids: features of N states, of shape (N, C, H, W)
        :param actions: their actions, of shape (N, A)
        :return: shape (N,)
        """
        means, variance = self.policy.cost_critic_target(grids, actions)
        return self.policy.cost_critic_target.risk(means, variance, self.risk_level)

    def _barrier(self, risk: th.Tensor) -> th.Tensor:
        """Residual at each imagined step, of shape (H, N); the last m steps look too far ahead and count as safe."""
        residual = th.zeros_like(risk)
        steps = self.barrier_steps
        residual[:-steps] = barrier_residual(risk[steps:], risk[:-steps], self.penalty.budget, self.barrier_decay)
        return residual

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "penalty"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "penalty", "_violations", "_selections"]
