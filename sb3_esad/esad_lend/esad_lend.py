"""ESAD-LEND: safe driving from imagined risk (arXiv 2407.06317)."""

from functools import partial
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import update_learning_rate

from sb3_esad.common.checks import require
from sb3_esad.common.constrained_algorithm import ConstrainedLatentAlgorithm
from sb3_esad.common.critics import CostTargets
from sb3_esad.common.entropy import make_entropy_coefficient
from sb3_esad.common.functional import rising_cvar
from sb3_esad.common.imagined_returns import imagined_costs, imagined_returns, taken
from sb3_esad.common.latent_algorithm import FALLING_RATE
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.precision import autocast
from sb3_esad.common.rssm import Filtered
from sb3_esad.common.side_by_side import side_by_side
from sb3_esad.common.type_aliases import Imagination, LatentState, SequenceSamples, TensorLogs
from sb3_esad.esad_lend.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_esad.esad_lend.targets import (
    Transitions,
    cost_targets,
    recorded_cost_targets,
    recorded_return_targets,
    recorded_transitions,
)


class ESADLEND(ConstrainedLatentAlgorithm):
    """
    Enhanced Safety in Autonomous Driving: Latent State Diffusion Model for End-to-End Navigation (arXiv 2407.06317).

    The actor follows the gradient of imagined return and risk through the steps of a world model, as Dreamer's (arXiv
    1912.01603). Cost critics predict mean and variance of the cost to come; an augmented Lagrangian keeps their conditional
    value at risk within a budget.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"`` or a :class:`LatentPolicy`
    :param env: environment with a Box action space, whose info dict holds a cost in [0, 1]
    :param learning_rate: of all networks, a number or a function of the remaining progress; 0.006 by default, which
        falls to 0 in the second half of the training, that of the cost critics to ``min_cost_critic_rate`` of it
    :param cost_limit: undiscounted cost allowed per episode; 0 is strict, None is no limit
    :param risk_level: worst fraction of outcomes that shall keep the limit, in (0, 1]; 1 limits the mean
    :param ent_coef: weight of the entropy; a number, ``"auto"`` to learn it, or ``"auto_0.1"`` to learn it from 0.1
    :param target_entropy: entropy that a learned weight maintains, in nats; ``"auto"`` for minus the size of the action
    :param replay_critic_coef: weight of recorded transitions in the loss of the reward critics
    :param replay_cost_critic_coef: weight of recorded transitions in the loss of the cost critics, beside 1 of imagined ones,
        which foresee too many costs
    :param replay_lambda: mixing of n-step returns of recorded costs, in [0, 1]
    :param min_cost_critic_rate: share of the first learning rate below which that of the cost critics does not fall, so that
        they catch up with a policy that hardly moves any more
    :param uniform_action_prob: probability that an imagined trajectory starts with a uniformly random action
    :param kwargs: see :class:`ConstrainedLatentAlgorithm`
    :raises ValueError: if an argument is out of its range
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = FALLING_RATE,
        *,
        cost_limit: float | None = 0.05,
        risk_level: float = 0.5,
        ent_coef: str | float = "auto_0.03",
        target_entropy: str | float = "auto",
        replay_critic_coef: float = 0.3,
        replay_cost_critic_coef: float = 10.0,
        replay_lambda: float = 0.95,
        min_cost_critic_rate: float = 1 / 3,
        uniform_action_prob: float = 0.3,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, learning_rate, cost_limit, risk_level, _init_setup_model=False, **kwargs)
        self.ent_coef = ent_coef
        self.target_entropy = target_entropy
        self.replay_critic_coef = replay_critic_coef
        self.replay_cost_critic_coef = replay_cost_critic_coef
        self.replay_lambda = replay_lambda
        self.min_cost_critic_rate = min_cost_critic_rate
        self.uniform_action_prob = uniform_action_prob
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        uniform = self.uniform_action_prob
        require(0 <= uniform <= 1, "uniform_action_prob", uniform, "a probability in [0, 1]")
        require(0 <= self.replay_lambda <= 1, "replay_lambda", self.replay_lambda, "a number in [0, 1]")
        for name in ("replay_critic_coef", "replay_cost_critic_coef"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a weight >= 0")
        share = self.min_cost_critic_rate
        require(0 <= share <= 1, "min_cost_critic_rate", share, "a share of the first learning rate in [0, 1]")
        target, remedy = self.target_entropy, 'a number of nats, or "auto"'
        require(target == "auto" or isinstance(target, int | float), "target_entropy", target, remedy)

    def _setup_model(self) -> None:
        super()._setup_model()
        target = -float(self.policy.actor.action_dim) if self.target_entropy == "auto" else float(self.target_entropy)
        self.entropy = make_entropy_coefficient(self.ent_coef, target, self.lr_schedule(1)).to(self.device)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        least = self.min_cost_critic_rate * self.lr_schedule(1)
        for group in self.policy.cost_critic.optimizer.param_groups:
            group["lr"] = max(group["lr"], least)

    def _first_actions(self, start: LatentState) -> th.Tensor:
        # The critics must know what actions lead to that the policy would never take
        actions = super()._first_actions(start)
        explore = th.rand(len(actions), 1, device=actions.device) < self.uniform_action_prob
        return th.where(explore, 2 * th.rand_like(actions) - 1, actions)

    def _update_behavior(self, samples: SequenceSamples, filtered: Filtered, imagined: Imagination) -> TensorLogs:
        recorded, fixed = recorded_transitions(self.policy, samples, filtered), imagined.detach()
        return {
            **self._update_critic(fixed, recorded),
            **self._update_cost_critic(fixed, recorded),
            **self._update_actor(imagined),
        }

    def _update_critic(self, imagined: Imagination, recorded: Transitions) -> TensorLogs:
        critic, target = self.policy.critic, self.policy.critic_target
        with th.no_grad():
            targets = imagined_returns(target, imagined, self.gamma, self.lambda_return)
        recorded_targets = recorded_return_targets(target, recorded, self.gamma)
        critic.follow_scale(targets)
        dreamed = (imagined.weights.flatten() * critic.loss(*taken(imagined), targets.flatten())).mean()
        anchored = (recorded.event_weights * critic.loss(recorded.grids, recorded.actions, recorded_targets)).mean()
        self._step("critic", dreamed + self.replay_critic_coef * anchored)
        return {
            "critic_loss": dreamed.detach(),
            "replay_critic_loss": anchored.detach(),
            "imagination/return": targets[0].mean().detach(),
            "imagination/reward": imagined.predictions.rewards.mean().detach(),
        }

    def _update_cost_critic(self, imagined: Imagination, recorded: Transitions) -> TensorLogs:
        targets = self._imagined_cost_targets(imagined, self._raise_cost_bound())
        dreamed = self._imagined_cost_losses(imagined, targets)
        anchored = self._recorded_cost_losses(recorded, self.replay_lambda)
        self._step("cost_critic", dreamed.sum() + self.replay_cost_critic_coef * anchored.sum())
        return {
            "cost_critic_loss": dreamed[0].detach(),
            "cost_var_loss": dreamed[1].detach(),
            "replay_cost_critic_loss": anchored[0].detach(),
            "replay_cost_var_loss": anchored[1].detach(),
            "imagination/cost": targets.means[0].mean().detach(),
        }

    def _imagined_cost_targets(self, imagined: Imagination, continue_after_cost: float) -> CostTargets:
        target = self.policy.cost_critic_target
        return cost_targets(target, imagined, self.discount_of_cost, self.lambda_return, continue_after_cost)

    def _imagined_cost_losses(self, imagined: Imagination, targets: CostTargets) -> th.Tensor:
        return self._cost_losses(*taken(imagined), targets, imagined.weights.flatten())

    def _recorded_cost_losses(self, recorded: Transitions, replay_lambda: float) -> th.Tensor:
        targets = recorded_cost_targets(self.policy.cost_critic_target, recorded, self.discount_of_cost, replay_lambda)
        return self._cost_losses(recorded.grids, recorded.actions, targets, recorded.event_weights)

    def _cost_losses(self, grids: th.Tensor, actions: th.Tensor, targets: CostTargets, weights: th.Tensor) -> th.Tensor:
        """Weighted losses of mean and variance, of shape (2,)."""
        losses = self.policy.cost_critic.loss(grids, actions, *(each.flatten() for each in targets))
        return th.stack([(weights * loss).mean() for loss in losses])

    def fit_cost_critic(
        self,
        gradient_steps: int,
        learning_rate: float = 0.002,
        replay_lambda: float = 0.95,
        imagined_coef: float = 0.0,
    ) -> None:
        """
        Let the cost critics alone learn what the present policy costs.

        Whether the filter trusts them is still judged by what they expected before, until more steps have been made.

        :param gradient_steps: number of updates, about 300; with more, recorded costs are overfitted and too little is
            expected of what is new, or, with imagined ones, too much (docs/experiments.md, sections 20 and 21)
        :param learning_rate: of the cost critics, until :meth:`train` sets it again
        :param replay_lambda: mixing of n-step returns, in [0, 1]
        :param imagined_coef: weight of imagined transitions beside 1 of recorded ones, the inverse of
            ``replay_cost_critic_coef``, so that 0 leaves them out: a world model exaggerates costs after a thousand updates,
            after thousands 0.33 was best on the highway
        :raises ValueError: if an argument is out of its range, or fewer than ``learning_starts`` steps have been recorded
        """
        require(gradient_steps >= 1, "gradient_steps", gradient_steps, "a number of updates >= 1")
        require(0 <= replay_lambda <= 1, "replay_lambda", replay_lambda, "a number in [0, 1]")
        require(imagined_coef >= 0, "imagined_coef", imagined_coef, "a weight >= 0")
        steps = self.replay_buffer.size() * self.n_envs
        require(self._has_enough_steps(), "replay_buffer.size()", steps, f"{self.learning_starts} steps or more to learn from")
        self.policy.set_training_mode(False)  # statistics of batches and dropout are the world model's, which stays as it is
        continue_after_cost = self._raise_cost_bound()
        update_learning_rate(self.policy.cost_critic.optimizer, learning_rate)
        learn = partial(self._fit_to, replay_lambda, imagined_coef, continue_after_cost)
        samples = self._sample(self.batch_size)
        filtered = self._observing(samples)()
        for _ in range(gradient_steps - 1):
            following = self._sample(self.batch_size)
            _, next_filtered = side_by_side(partial(learn, samples, filtered), self._observing(following), self.device)
            samples, filtered = following, next_filtered
        learn(samples, filtered)

    def _fit_to(
        self,
        replay_lambda: float,
        imagined_coef: float,
        continue_after_cost: float,
        samples: SequenceSamples,
        filtered: Filtered,
    ) -> None:
        """Move the cost critics once; see :meth:`fit_cost_critic`."""
        with autocast(self.device):
            recorded = recorded_transitions(self.policy, samples, filtered)
            loss = self._recorded_cost_losses(recorded, replay_lambda).sum()
            if imagined_coef > 0:
                with th.no_grad():
                    imagined = self._imagine(samples, filtered)
                targets = self._imagined_cost_targets(imagined, continue_after_cost)
                loss = loss + imagined_coef * self._imagined_cost_losses(imagined, targets).sum()
            self._step("cost_critic", loss)

    def _update_actor(self, imagined: Imagination) -> TensorLogs:
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
            "actor_loss": loss.detach(),
            "imagination/risk": usual_risk.mean().detach(),
            "imagination/barrier_residual": barrier.relu().mean().detach(),
            "entropy": -log_prob.mean().detach(),
            "return_scale": self.policy.critic.scale.clone(),
            **self.entropy.update(log_prob.detach()),
        }

    def _imagined_risk(self, imagined: Imagination) -> th.Tensor:
        """Safety measure of each imagined step, of shape (H, N); :meth:`risk`, which moves the multiplier, is the critics'."""
        costs = imagined_costs(self.policy.cost_critic, imagined, self.discount_of_cost, self.lambda_return)
        _, variance = self.policy.cost_critic(*taken(imagined))
        return rising_cvar(costs, variance.view_as(costs), self.risk_level)

    def _optimizers(self) -> dict[str, th.optim.Optimizer]:
        own = {f"entropy.{name}": getattr(self.entropy, name) for name in self.entropy.optimizer_names}
        return {**super()._optimizers(), **own}

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "entropy"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "entropy"]
