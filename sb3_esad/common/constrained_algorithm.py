"""The base of the algorithms that learn from imagination within a budget of cost."""

from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_esad.common.checks import require
from sb3_esad.common.cost_limited_algorithm import CostLimitedAlgorithm
from sb3_esad.common.foresight import Foresight
from sb3_esad.common.functional import barrier_residual
from sb3_esad.common.latent_algorithm import FALLING_RATE, LatentAlgorithm
from sb3_esad.common.penalties import Penalty
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.selection import CALMEST, LARGEST_CHOICE, ActionFilter, NoFilter, SafetyFilter, SelectionRates
from sb3_esad.common.type_aliases import Belief


class ConstrainedLatentAlgorithm(CostLimitedAlgorithm, LatentAlgorithm):
    """
    Base of the algorithms that imagine, and whose risk shall stay within a budget.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"`` or a :class:`LatentPolicy`
    :param env: environment with a Box action space, whose info dict holds a cost in [0, 1]
    :param learning_rate: of all networks, a number or a function of the remaining progress
    :param cost_limit: undiscounted cost allowed per episode; 0 is strict, None is no limit
    :param risk_level: worst fraction of outcomes that shall keep the limit, in (0, 1]; 1 limits the mean
    :param barrier_decay: alpha_b in (0, 1], how fast the risk must return to the budget; larger is less conservative
    :param barrier_steps: m, steps over which the barrier condition is taken
    :param barrier_coef: weight of a violated barrier condition; 0 drops it
    :param filter_start: updates after which an action that is not admissible is replaced; None for never
    :param n_candidates: latents of which the worst decide whether an action is admissible
    :param n_proposals: samples of the actor, and as many uniform actions, to choose from where its own is not admissible
    :param kwargs: see :class:`CostLimitedAlgorithm` and :class:`LatentAlgorithm`
    :raises ValueError: if an argument is out of its range
    """

    filter_class: ClassVar[type[ActionFilter]] = SafetyFilter

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = FALLING_RATE,
        cost_limit: float | None = 0.05,
        risk_level: float = 0.5,
        barrier_decay: float = 0.3,
        barrier_steps: int = 2,
        barrier_coef: float = 0.0,
        filter_start: int | None = None,
        n_candidates: int = 8,
        n_proposals: int = 16,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, learning_rate, cost_limit, risk_level, _init_setup_model=False, **kwargs)
        self.barrier_decay = barrier_decay
        self.barrier_steps = barrier_steps
        self.barrier_coef = barrier_coef
        self.filter_start = filter_start
        self.n_candidates = n_candidates
        self.n_proposals = n_proposals
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        require(0 < self.barrier_decay <= 1, "barrier_decay", self.barrier_decay, "a rate in (0, 1]")
        start = self.filter_start
        require(start is None or start >= 0, "filter_start", start, "a number of updates >= 0, or None for no filter")
        self._check_size("n_candidates", 1, LARGEST_CHOICE)
        self._check_size("n_proposals", CALMEST, LARGEST_CHOICE)
        self._check_size("barrier_steps", 1, LARGEST_CHOICE // self.n_candidates)
        steps, horizon = self.barrier_steps, self.imagination_horizon
        fits = self.barrier_coef == 0 or steps < horizon
        require(fits, "barrier_steps", steps, f"fewer than imagination_horizon={horizon}, or no barrier_coef")

    def _check_size(self, name: str, least: int, most: int) -> None:
        size = getattr(self, name)
        require(least <= size <= most, name, size, f"a number from {least} to {most}")

    def _setup_model(self) -> None:
        super()._setup_model()
        self.policy.action_filter = self._make_filter()
        self._selections = SelectionRates()

    def begin_anew(self, seed: int) -> None:
        """
        Begin new episodes, and count anew how often actions are replaced.

        :param seed: see :meth:`CostAwareAlgorithm.begin_anew`
        """
        super().begin_anew(seed)
        self._selections = SelectionRates()

    def _make_penalty(self, **further: Any) -> Penalty:
        return super()._make_penalty(barrier_coef=self.barrier_coef, **further)

    def _make_filter(self) -> ActionFilter:
        filter_class = NoFilter if self.cost_limit is None or self.filter_start is None else self.filter_class
        return filter_class(
            penalty=self.penalty,
            filter_start=self.filter_start,
            foresight=Foresight(self.barrier_steps, self.gamma, self.discount_of_cost, self.risk_level, self.barrier_decay),
            risk_level=self.risk_level,
            n_candidates=self.n_candidates,
            n_proposals=self.n_proposals,
        )

    def _last_state(self) -> th.Tensor:
        assert self._last_latent is not None
        return self.policy.world_model.features(self._last_latent)

    def _select(self, belief: Belief, proposed: th.Tensor) -> th.Tensor:
        selection = self.policy.action_filter.select(self.policy.learner, belief, proposed)
        self._selections.note(selection)
        return selection.actions

    def dump_logs(self) -> None:
        """Write the log, rates of the filter included."""
        for name, value in self._selections.take().items():
            self.logger.record(f"rollout/{name}", value)
        super().dump_logs()

    def _barrier(self, risk: th.Tensor) -> th.Tensor:
        """Residual at each imagined step, of shape (H, N); the last m steps look too far ahead and count as safe."""
        residual = th.zeros_like(risk)
        steps = self.barrier_steps
        residual[:-steps] = barrier_residual(risk[steps:], risk[:-steps], self.penalty.budget, self.barrier_decay)
        return residual

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_selections"]
