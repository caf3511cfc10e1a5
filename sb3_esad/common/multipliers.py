"""What a violated cost limit costs the policy, by an augmented Lagrangian."""

import math
from numbers import Real

import numpy as np
import torch as th

from sb3_esad.common.checks import require
from sb3_esad.common.episode_record import EpisodeRecord
from sb3_esad.common.functional import discounted_budget, tail_factor
from sb3_esad.common.log_keys import grouped
from sb3_esad.common.penalties import Penalty
from sb3_esad.common.type_aliases import Logs
from sb3_esad.common.warn_once import WarnOnce

ENOUGH_ROAD = 0.2
"""How much of the latest steps must have been driven before their cost rate has a say."""
PATIENCE = 500
"""Updates for which the multiplier must have been at its upper bound, or the critics blind, before the user is warned."""
BLINDNESS = 3.0
"""How far beyond the band of calibration critics are not only mistrusted, but called blind."""


class AugmentedLagrangian(Penalty):
    """
    psi(g) for the constraint g <= 0 (Nocedal & Wright 2006, Eq. 17.65), g = Gamma - d.

    The multiplier integrates two signals, each normalised and clipped: what the critics expect and what the road has shown.
    It holds still where they disagree or one of them is content, where neither is available and during a warm-up, lest it wind
    up on a violation that the actor cannot, or need not, mend.

    :param cost_limit: D >= 0, undiscounted cost allowed per episode
    :param risk_level: alpha in (0, 1], worst fraction of episodes that shall keep the limit
    :param cost_gamma: discount of the cost
    :param episode_length: steps of an episode, assumed until one has ended otherwise than by a cost
    :param barrier_coef: weight of the violated barrier condition
    :param lambda_lr: step of the multiplier per update, its integral gain
    :param lagrangian_multiplier_init: initial multiplier
    :param multiplier_bounds: lowest and highest multiplier
    :param penalty_coef: rho >= 0, the proportional gain; 0 is the plain Lagrangian
    :param penalty_warmup: updates during which the multiplier holds still
    :param window: episodes remembered
    :param road_steps: steps over which the present cost rate is averaged; more if two episodes of each environment are longer
    :param min_episodes: finished episodes without which the critics are not trusted
    :param calibration_band: predicted over observed cost within which the critics are trusted
    :raises ValueError: if an argument is out of its range
    """

    cost_limit: float
    multiplier: th.Tensor
    mean_violation: th.Tensor
    n_updates: th.Tensor
    updates_at_bound: th.Tensor

    def __init__(
        self,
        cost_limit: float,
        risk_level: float = 0.5,
        cost_gamma: float = 0.97,
        episode_length: float = 1000.0,
        barrier_coef: float = 0.0,
        lambda_lr: float = 0.01,
        lagrangian_multiplier_init: float = 2.0,
        multiplier_bounds: tuple[float, float] = (0.05, 50.0),
        penalty_coef: float = 1.0,
        penalty_warmup: int = 100,
        window: int = 50,
        road_steps: int = 2000,
        min_episodes: int = 20,
        calibration_band: tuple[float, float] = (1 / 3, 3.0),
    ) -> None:
        super().__init__()
        tail_factor(risk_level)  # refuses a level outside (0, 1]
        finite = isinstance(cost_limit, Real) and 0 <= cost_limit < math.inf
        require(finite, "cost_limit", cost_limit, "the cost allowed per episode, a number >= 0, or None for no limit")
        require(0 <= cost_gamma <= 1, "cost_gamma", cost_gamma, "a discount in [0, 1]")
        require(episode_length >= 1, "episode_length", episode_length, "a number of steps >= 1")
        require(barrier_coef >= 0, "barrier_coef", barrier_coef, "a weight >= 0")
        require(lambda_lr >= 0, "lambda_lr", lambda_lr, "a step >= 0")
        require(penalty_coef >= 0, "penalty_coef", penalty_coef, "a gain >= 0")
        low, high = multiplier_bounds
        within, init = f"one within {low} and {high}", lagrangian_multiplier_init
        require(0 <= low <= init <= high, "lagrangian_multiplier_init", init, within)
        self.cost_limit = cost_limit
        self.risk_level = risk_level
        self.cost_gamma = cost_gamma
        self.barrier_coef = barrier_coef
        self.lambda_lr = lambda_lr
        self.lower_bound, self.upper_bound = multiplier_bounds
        self.penalty_coef = penalty_coef
        self.penalty_warmup = penalty_warmup
        self.min_episodes = min(min_episodes, window)
        self.calibration_band = calibration_band
        self.episodes = EpisodeRecord(cost_gamma, episode_length, window, road_steps)
        self.register_buffer("multiplier", th.tensor(float(lagrangian_multiplier_init)))
        self.register_buffer("mean_violation", th.zeros(()))
        self.register_buffer("n_updates", th.zeros(()))
        self.register_buffer("updates_at_bound", th.zeros(()))
        self._updates_blind = 0
        self._warn = WarnOnce()

    @property
    def budget(self) -> float:
        record = self.episodes
        return discounted_budget(self.cost_limit, self.cost_gamma, record.episode_length, record.timeouts.item())

    @property
    def budget_scale(self) -> float:
        return max(self.budget, 0.01)

    @property
    def calibration(self) -> float:
        return self.episodes.calibration(epsilon=max(self.budget, 0.005))

    @property
    def calibrated(self) -> bool:
        low, high = self.calibration_band
        return self._enough_episodes and self.episodes.has_prediction and low <= self.calibration <= high

    def trusts_critics(self, n_updates: int) -> bool:
        return bool(self.n_updates >= n_updates) and self.calibrated

    @property
    def _enough_episodes(self) -> bool:
        return self.episodes.size >= self.min_episodes

    @property
    def base_weight(self) -> th.Tensor:
        """Weight of the risk where the barrier condition holds: integral plus proportional part, never a reward for cost."""
        return (self.multiplier + self.penalty_coef * self.mean_violation).clamp(0.0, self.upper_bound)

    def forward(self, violation: th.Tensor) -> th.Tensor:
        # (relu(kappa + rho g)^2 - kappa^2) / (2 rho), written so that rho = 0 is the plain Lagrangian.
        active = violation.clamp(min=-self.multiplier.item() / max(self.penalty_coef, 1e-12))
        return self.multiplier * active + 0.5 * self.penalty_coef * active**2

    def combine(self, objective: th.Tensor, risk: th.Tensor, barrier: th.Tensor) -> th.Tensor:
        excess = self.barrier_coef * th.relu(barrier.detach()) / self.budget_scale
        weight = (self.base_weight + excess).clamp(max=self.upper_bound)
        return (objective + weight * risk) / (1.0 + weight.mean())

    def admissible(self, risk: th.Tensor, barrier: th.Tensor) -> th.Tensor:
        # The scale, not the budget: under a limit of 0 no estimate is ever exactly 0.
        return (risk <= self.budget_scale) & (barrier <= 0.0)

    def observe(self, costs: np.ndarray, dones: np.ndarray, truncated: np.ndarray | None = None) -> None:
        self.episodes.observe(costs, dones, truncated)

    def pass_over(self, dones: np.ndarray) -> None:
        self.episodes.pass_over(dones)

    def forget_unfinished(self) -> None:
        self.episodes.forget_unfinished()

    def note_prediction(self, values: th.Tensor) -> None:
        self.episodes.note_prediction(values)

    @th.no_grad()
    def update(self, violation: float | th.Tensor | None, gradient_steps: int = 1) -> Logs:
        if violation is None:
            return self._logs({})
        violation = float(violation)
        signals = self._signals(violation)
        if self.n_updates >= self.penalty_warmup and signals:
            self._move(list(signals.values()), gradient_steps)
        self.n_updates += gradient_steps
        self._watch_bound(gradient_steps)
        self._watch_critics(gradient_steps)
        return {**self._logs(signals), "cvar": violation + self.budget}

    def _signals(self, violation: float) -> Logs:
        signals = {}
        if self.calibrated:
            signals["violation_model"] = violation / self.budget_scale
        if self.episodes.seen >= ENOUGH_ROAD:
            excess = self.episodes.tail_cost(self.risk_level) - self.cost_limit
            # Bounded below a single cost the signal would be a switch, and rest at twice the cost that is allowed
            single = self.episodes.resolution / self.risk_level
            if excess >= 0 or self.episodes.has_seen_episodes:  # that nothing has happened yet says nothing
                signals["violation_road"] = excess / max(self.cost_limit, single, 0.02)
        return {name: min(max(signal, -1.0), 1.0) for name, signal in signals.items()}

    def _move(self, signals: list[float], gradient_steps: int) -> None:
        mean = sum(signals) / len(signals)
        self.mean_violation += (1.0 - 0.9**gradient_steps) * (mean - self.mean_violation)
        if min(signals) * max(signals) > 0.0:
            step = self.lambda_lr * gradient_steps * mean
            self.multiplier.add_(step).clamp_(self.lower_bound, self.upper_bound)

    def _watch_bound(self, gradient_steps: int) -> None:
        self.updates_at_bound.add_(gradient_steps).mul_(self.multiplier >= self.upper_bound)
        if self.updates_at_bound < PATIENCE or self.episodes.seen < ENOUGH_ROAD or self.lambda_lr == 0:
            return
        cost, length = self.episodes.expected_cost, self.episodes.episode_length
        what = f"The multiplier has been at its upper bound {self.upper_bound} for {PATIENCE} updates"
        if cost > self.cost_limit:
            remedy = "looks infeasible: allow more, or make sure that some behaviour could keep it"
            worse = f"and an episode of {length:.0f} steps still costs {cost:.3g}"
            self._warn("limit", f"{what}, {worse}: cost_limit={self.cost_limit} {remedy}.")
        elif "limit" not in self._warn:
            remedy = f"the critics expect {self.calibration:.2g} times what came: learn more often, or raise the bound"
            better = f"though an episode of {length:.0f} steps costs {cost:.3g} of {self.cost_limit} allowed"
            self._warn("bound", f"{what} {better}; {remedy}.")

    def _watch_critics(self, gradient_steps: int) -> None:
        low, high = self.calibration_band[0] / BLINDNESS, self.calibration_band[1] * BLINDNESS
        judged = self._enough_episodes and self.episodes.has_prediction and self.episodes.seen >= ENOUGH_ROAD
        blind = judged and not low <= self.calibration <= high
        self._updates_blind = (self._updates_blind + gradient_steps) * blind
        if self._updates_blind >= PATIENCE:
            expected, came = self.episodes.predicted, self.episodes.observed
            what = f"For {PATIENCE} updates the cost critics have expected {expected:.3g} where {came:.3g} came"
            remedy = "learn more often (gradient_steps), or make sure that what leads to a cost can be observed"
            self._warn("critics", f"{what}, in discounted cost to come: {remedy}.")

    def _logs(self, signals: Logs) -> Logs:
        return {
            "lagrangian_multiplier": self.multiplier.item(),
            "budget": self.budget,
            "safety/penalty_weight": self.base_weight.item(),
            "safety/cost_calibration": self.calibration,
            "safety/horizon": self.episodes.episode_length,
            **grouped("safety", signals),
        }
