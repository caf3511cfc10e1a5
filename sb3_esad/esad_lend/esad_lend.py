"""ESAD-LEND: safe driving from imagined risk (arXiv 2407.06317)."""

import math
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule

from sb3_esad.common.callbacks import LagrangeCallback, prepend
from sb3_esad.common.checks import require
from sb3_esad.common.entropy import make_entropy_coefficient
from sb3_esad.common.functional import barrier_residual, capped_cvar, tail_factor
from sb3_esad.common.latent_algorithm import FALLING_RATE, LatentAlgorithm
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.penalties import NoPenalty, Penalty
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.rssm import Filtered
from sb3_esad.common.type_aliases import Imagination, LatentState, Logs, SequenceSamples
from sb3_esad.esad_lend.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_esad.esad_lend.targets import (
    Transitions,
    cost_targets,
    imagined_costs,
    imagined_returns,
    recorded_cost_targets,
    recorded_return_targets,
    recorded_transitions,
    taken,
)

UNKNOWN_LENGTH = 1000.0


class ESADLEND(LatentAlgorithm):
    """
    Enhanced Safety in Autonomous Driving: Latent State Diffusion Model for End-to-End Navigation (arXiv 2407.06317).

    The actor follows the gradient of imagined return and risk through the steps of a world model, as Dreamer's (arXiv
    1912.01603). Cost critics predict mean and variance of the cost to come; an augmented Lagrangian keeps their conditional
    value at risk within a budget.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"`` or a :class:`LatentPolicy`
    :param env: environment with a Box action space, whose info dict holds a cost in [0, 1]
    :param learning_rate: of all networks, a number or a function of the remaining progress; 0.006 by default, which
        falls to 0 in the second half of the training
    :param cost_limit: undiscounted cost allowed per episode; 0 is strict, None is no limit
    :param risk_level: worst fraction of outcomes that shall keep the limit, in (0, 1]; 1 limits the mean
    :param cost_gamma: discount of the cost; None for ``gamma``
    :param ent_coef: weight of the entropy; a number, ``"auto"`` to learn it, or ``"auto_0.1"`` to learn it from 0.1
    :param target_entropy: entropy that a learned weight maintains, in nats; ``"auto"`` for minus the size of the action
    :param lagrangian_multiplier_init: initial multiplier
    :param lambda_lr: step of the multiplier per update
    :param lagrangian_upper_bound: largest multiplier
    :param penalty_coef: proportional gain of the augmented Lagrangian; 0 is the plain Lagrangian
    :param penalty_warmup: updates during which the multiplier is held
    :param barrier_decay: alpha_b in (0, 1], how fast the risk must return to the budget; larger is less conservative
    :param barrier_steps: m, steps over which the barrier condition is taken
    :param barrier_coef: weight of a violated barrier condition; 0 drops it
    :param replay_critic_coef: weight of recorded transitions in the loss of the reward critics
    :param replay_cost_critic_coef: weight of recorded transitions in the loss of the cost critics
    :param uniform_action_prob: probability that an imagined trajectory starts with a uniformly random action
    :param kwargs: see :class:`LatentAlgorithm`
    :raises ValueError: if an argument is out of its range
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    penalty_class: ClassVar[type[Penalty]] = AugmentedLagrangian

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = FALLING_RATE,
        cost_limit: float | None = 0.05,
        risk_level: float = 0.5,
        cost_gamma: float | None = None,
        ent_coef: str | float = "auto_0.03",
        target_entropy: str | float = "auto",
        lagrangian_multiplier_init: float = 2.0,
        lambda_lr: float = 0.01,
        lagrangian_upper_bound: float = 50.0,
        penalty_coef: float = 1.0,
        penalty_warmup: int = 100,
        barrier_decay: float = 0.3,
        barrier_steps: int = 2,
        barrier_coef: float = 0.0,
        replay_critic_coef: float = 0.3,
        replay_cost_critic_coef: float = 1.0,
        uniform_action_prob: float = 0.3,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, learning_rate, _init_setup_model=False, **kwargs)
        self.cost_limit = cost_limit
        self.risk_level = risk_level
        self.cost_gamma = cost_gamma
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        self.lagrangian_multiplier_init = lagrangian_multiplier_init
        self.lambda_lr = lambda_lr
        self.lagrangian_upper_bound = lagrangian_upper_bound
        self.penalty_coef = penalty_coef
        self.penalty_warmup = penalty_warmup
        self.barrier_decay = barrier_decay
        self.barrier_steps = barrier_steps
        self.barrier_coef = barrier_coef
        self.replay_critic_coef = replay_critic_coef
        self.replay_cost_critic_coef = replay_cost_critic_coef
        self.uniform_action_prob = uniform_action_prob
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        tail_factor(self.risk_level)  # refuses a level outside (0, 1], with and without a limit
        require(0 <= self._cost_gamma < 1, "cost_gamma", self._cost_gamma, "a discount in [0, 1), also where it is gamma")
        require(0 < self.barrier_decay <= 1, "barrier_decay", self.barrier_decay, "a rate in (0, 1]")
        require(self.barrier_steps >= 1, "barrier_steps", self.barrier_steps, "a number of steps >= 1")
        uniform = self.uniform_action_prob
        require(0 <= uniform <= 1, "uniform_action_prob", uniform, "a probability in [0, 1]")

    def _setup_model(self) -> None:
        super()._setup_model()
        self.penalty = self._make_penalty().to(self.device)
        target = -float(self.policy.actor.action_dim) if self.target_entropy == "auto" else float(self.target_entropy)
        self.entropy = make_entropy_coefficient(self.ent_coef, target, self.lr_schedule(1)).to(self.device)
        self._violations: list[th.Tensor] = []

    def _make_penalty(self) -> Penalty:
        penalty_class = NoPenalty if self.cost_limit is None else self.penalty_class
        return penalty_class(
            cost_limit=self.cost_limit,
            risk_level=self.risk_level,
            cost_gamma=self._cost_gamma,
            episode_length=self._episode_length(),
            barrier_coef=self.barrier_coef,
            lambda_lr=self.lambda_lr,
            lagrangian_multiplier_init=self.lagrangian_multiplier_init,
            multiplier_bounds=(min(0.05, self.lagrangian_multiplier_init), self.lagrangian_upper_bound),
            penalty_coef=self.penalty_coef,
            penalty_warmup=self.penalty_warmup,
        )

    def _episode_length(self) -> float:
        """Longest episode the environment admits, until episodes have been seen."""
        if self.env is None:
            return UNKNOWN_LENGTH
        if self.env.has_attr("max_episode_steps"):
            return float(self.env.get_attr("max_episode_steps")[0])
        spec = self.env.get_attr("spec")[0]
        return float(spec.max_episode_steps or UNKNOWN_LENGTH) if spec else UNKNOWN_LENGTH

    @property
    def _cost_gamma(self) -> float:
        return self.gamma if self.cost_gamma is None else self.cost_gamma

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        return super()._init_callback(prepend(LagrangeCallback(), callback), progress_bar)

    def take_violation(self) -> th.Tensor | None:
        """
        Hand over how far the expected risk exceeded the budget since the last call.

        :return: mean of Gamma - d over the states visited, None if there were none or the critics have not been updated yet
        """
        violations, self._violations = self._violations, []
        return th.stack(violations).mean() if violations else None

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        starts = self._last_episode_starts
        sampled = super()._sample_action(learning_starts, action_noise, n_envs)
        if self._n_updates > 0:
            self._note_risk(np.zeros(n_envs, dtype=bool) if starts is None else starts)
        return sampled

    @th.no_grad()
    def _note_risk(self, starts: np.ndarray) -> None:
        """
        Note what the critics expect where the policy really is: replayed states are those of policies that are gone.

        :param starts: which environments have just begun an episode, of shape (n_envs,)
        """
        assert self._last_latent is not None
        grids, actions = self.policy.world_model.features(self._last_latent), self._last_latent.action
        self._violations.append(self.risk(grids, actions).mean() - self.penalty.budget)
        means, _ = self.policy.cost_critic_target(grids, actions)
        self.penalty.note_prediction(means.mean(0)[th.as_tensor(starts, device=self.device).bool()])

    def _first_actions(self, start: LatentState) -> th.Tensor:
        # The critics must know what actions lead to that the policy would never take
        actions = super()._first_actions(start)
        explore = th.rand(len(actions), 1, device=actions.device) < self.uniform_action_prob
        return th.where(explore, 2 * th.rand_like(actions) - 1, actions)

    def _update_behavior(self, samples: SequenceSamples, filtered: Filtered, imagined: Imagination) -> Logs:
        recorded, fixed = recorded_transitions(self.policy, samples, filtered), imagined.detach()
        return {
            **self._update_critic(fixed, recorded),
            **self._update_cost_critic(fixed, recorded),
            **self._update_actor(imagined),
        }

    def _update_critic(self, imagined: Imagination, recorded: Transitions) -> Logs:
        critic = self.policy.critic
        with th.no_grad():
            targets = imagined_returns(critic, imagined, self.gamma, self.lambda_return)
        recorded_targets = recorded_return_targets(critic, recorded, self.gamma)
        critic.follow_scale(targets)
        dreamed = (imagined.weights.flatten() * critic.loss(*taken(imagined), targets.flatten())).mean()
        anchored = (recorded.event_weights * critic.loss(recorded.grids, recorded.actions, recorded_targets)).mean()
        self._step("critic", dreamed + self.replay_critic_coef * anchored)
        return {
            "critic_loss": dreamed.item(),
            "replay_critic_loss": anchored.item(),
            "imagined_return": targets[0].mean().item(),
            "imagined_reward": imagined.predictions.rewards.mean().item(),
        }

    def _update_cost_critic(self, imagined: Imagination, recorded: Transitions) -> Logs:
        continue_after_cost = self.replay_buffer.continue_after_cost
        critic = self.policy.cost_critic
        if continue_after_cost > 0:
            for each in (critic, self.policy.cost_critic_target):
                each.raise_bound(1 / (1 - self._cost_gamma))
        targets = cost_targets(critic, imagined, self._cost_gamma, self.lambda_return, continue_after_cost)
        anchors = recorded_cost_targets(critic, recorded, self._cost_gamma)
        weights = imagined.weights.flatten()
        mean_loss, variance_loss = critic.loss(*taken(imagined), *(each.flatten() for each in targets))
        anchor_mean_loss, anchor_variance_loss = critic.loss(recorded.grids, recorded.actions, *anchors)
        dreamed = (weights * (mean_loss + variance_loss)).mean()
        anchored = (recorded.event_weights * (anchor_mean_loss + anchor_variance_loss)).mean()
        self._step("cost_critic", dreamed + self.replay_cost_critic_coef * anchored)
        return {
            "cost_critic_loss": (weights * mean_loss).mean().item(),
            "cost_var_loss": (weights * variance_loss).mean().item(),
            "replay_cost_critic_loss": anchor_mean_loss.mean().item(),
            "imagined_cost": targets.means[0].mean().item(),
        }

    def _update_actor(self, imagined: Imagination) -> Logs:
        """
        Improve the actor by the gradient of imagined returns and costs, back through all the steps that lead to them.

        Not by the gradient of the critics in the action alone: what an action does in one step is less than their error, while
        what a change of behaviour does over many steps is what the world model knows best (docs/experiments.md, section 5).
        """
        _, log_prob = self.policy.actor.action_log_prob(imagined.grids[:-1].detach().flatten(0, 1))
        returns = imagined_returns(self.policy.critic, imagined, self.gamma, self.lambda_return)
        risk = self._imagined_risk(imagined)
        barrier = self._barrier(risk.detach())
        objective = self.entropy() * log_prob.view_as(returns) - returns / self.policy.critic.scale
        loss = (imagined.weights.detach() * self.penalty.combine(objective, risk, barrier)).mean()
        self._step("actor", loss)
        usual_risk = risk[0, : risk.shape[1] // 2]  # the other half starts shortly before a cost
        return {
            "actor_loss": loss.item(),
            "cvar": usual_risk.mean().item(),
            "barrier_residual": barrier.relu().mean().item(),
            "entropy": -log_prob.mean().item(),
            "return_scale": self.policy.critic.scale.item(),
            **self.entropy.update(log_prob.detach()),
        }

    def _imagined_risk(self, imagined: Imagination) -> th.Tensor:
        """
        Safety measure of each imagined step, of shape (H, N); :meth:`risk`, which moves the multiplier, is the critics' own.

        Where the worst outcomes are all crashes the bounded risk is flat, and an actor that always crashes would never learn
        from it to crash less often ("blindness to success", arXiv 2205.05138): hence without the bound.
        """
        costs = imagined_costs(self.policy.cost_critic, imagined, self._cost_gamma, self.lambda_return)
        _, variance = self.policy.cost_critic(*taken(imagined))
        return capped_cvar(costs, variance.view_as(costs), self.risk_level, math.inf)

    def risk(self, grids: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """
        Safety measure Gamma: conditional value at risk of the cost to come, by the more pessimistic target critic.

        :param grids: features of N states, of shape (N, C, H, W)
        :param actions: their actions, of shape (N, A)
        :return: shape (N,)
        """
        critic = self.policy.cost_critic_target
        means, variance = critic(grids, actions)
        return capped_cvar(means, variance, self.risk_level, critic.bound).max(0).values

    def _barrier(self, risk: th.Tensor) -> th.Tensor:
        """Residual at each imagined step, of shape (H, N); the last m steps look too far ahead and count as safe."""
        residual = th.zeros_like(risk)
        steps = self.barrier_steps
        residual[:-steps] = barrier_residual(risk[steps:], risk[:-steps], self.penalty.budget, self.barrier_decay)
        return residual

    def _optimizers(self) -> dict[str, th.optim.Optimizer]:
        own = {f"entropy.{name}": getattr(self.entropy, name) for name in self.entropy.optimizer_names}
        return {**super()._optimizers(), **own}

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "penalty", "entropy"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "penalty", "entropy", "_violations"]
