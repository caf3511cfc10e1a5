"""WCSAC and SAC-Lag: SB3's SAC within a budget of cost, the model-free controls of ESAD-LEND."""

from collections import defaultdict
from typing import Any, ClassVar

import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, Schedule
from torch.nn import functional as F

from sb3_esad.common.checks import require
from sb3_esad.common.cost_buffers import CostReplayBuffer
from sb3_esad.common.cost_limited_algorithm import CostLimitedAlgorithm
from sb3_esad.common.functional import rising_cvar
from sb3_esad.common.optimizers import differentiate
from sb3_esad.common.target_networks import update_target
from sb3_esad.common.type_aliases import CostReplaySamples, TensorLogs
from sb3_esad.wcsac.policies import CnnPolicy, MlpPolicy, MultiInputPolicy, WCSACPolicy


class WCSAC(CostLimitedAlgorithm, SAC):
    """
    WCSAC: Worst-Case Soft Actor Critic for Safety-Constrained Reinforcement Learning (Yang et al., AAAI 2021).

    SB3's SAC beside critics of the mean and the variance of the cost to come. The actor minimises SAC's loss plus the weighted
    conditional value at risk of that cost; an augmented Lagrangian moves the weight. Without a limit it acts and learns as SAC
    does, bit by bit. From the paper differ, all of it as in :class:`ESADLEND`: the risk is capped, and its gradient is that of
    the mean alone, the larger of two; the variance is learned by the squared error; targets stop at the end of an episode; and
    the multiplier follows two signals.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"`` or a :class:`WCSACPolicy`
    :param env: environment with a Box action space, whose info dict holds a cost in [0, 1]
    :param learning_rate: of all networks, a number or a function of the remaining progress
    :param cost_limit: undiscounted cost allowed per episode; 0 is strict, None is no limit
    :param risk_level: worst fraction of outcomes that shall keep the limit, in (0, 1]; 1 limits the mean
    :param kwargs: see :class:`CostLimitedAlgorithm` and SB3's ``SAC``; ``n_steps`` must be 1
    :raises ValueError: if an argument is out of its range
    """

    saved_marks = ("cost_limit", "target_update_interval")
    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MlpPolicy,
        "CnnPolicy": CnnPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy: WCSACPolicy
    replay_buffer: CostReplayBuffer

    def __init__(
        self,
        policy: str | type[WCSACPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        *,
        cost_limit: float | None = 0.05,
        risk_level: float = 0.5,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, learning_rate, cost_limit, risk_level, _init_setup_model=False, **kwargs)
        if _init_setup_model:
            self._setup_model()

    def _check_arguments(self) -> None:
        super()._check_arguments()
        require(self.n_steps == 1, "n_steps", self.n_steps, "1, for the cost critics learn from single steps")

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        """
        Update entropy coefficient, critics and actor.

        :param gradient_steps: number of updates
        :param batch_size: steps in a batch
        """
        if not self._has_enough_steps():
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(self._optimizers())
        logs: dict[str, list[th.Tensor]] = defaultdict(list)
        for step in range(gradient_steps):
            samples: Any = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            for name, value in self._update(samples).items():
                logs[name].append(value)
            if step % self.target_update_interval == 0:
                update_target(self.critic, self.critic_target, self.tau)
                update_target(self.policy.cost_critic, self.policy.cost_critic_target, self.tau)
        self._n_updates += gradient_steps
        self._record(logs)

    def _update(self, samples: CostReplaySamples) -> TensorLogs:
        if self.use_sde:
            self.actor.reset_noise()
        # The actions are drawn in SAC's order, and before anything has been learned from the batch
        actions, log_prob = self.actor.action_log_prob(samples.observations)
        ent_coef, ent_coef_logs = self._update_ent_coef(log_prob[:, None])
        with th.no_grad():
            next_actions, next_log_prob = self.actor.action_log_prob(samples.next_observations)
        return {
            **ent_coef_logs,
            **self._update_critic(samples, next_actions, ent_coef * next_log_prob[:, None]),
            **self._update_cost_critic(samples, next_actions),
            **self._update_actor(samples.observations, actions, ent_coef * log_prob[:, None]),
        }

    def _update_ent_coef(self, log_prob: th.Tensor) -> tuple[th.Tensor, TensorLogs]:
        """The coefficient before its update, as SAC uses it, and what to log."""
        if self.ent_coef_optimizer is None or self.log_ent_coef is None:
            return self.ent_coef_tensor, {"ent_coef": self.ent_coef_tensor.detach()}
        ent_coef = self.log_ent_coef.detach().exp()
        loss = -(self.log_ent_coef * (log_prob.detach() + float(self.target_entropy))).mean()
        self.ent_coef_optimizer.zero_grad()
        loss.backward()
        self.ent_coef_optimizer.step()
        return ent_coef, {"ent_coef": ent_coef.detach(), "ent_coef_loss": loss.detach()}

    def _update_critic(self, samples: CostReplaySamples, next_actions: th.Tensor, entropy_term: th.Tensor) -> TensorLogs:
        with th.no_grad():
            next_values = th.cat(self.critic_target(samples.next_observations, next_actions), dim=1)
            next_value = next_values.min(dim=1, keepdim=True).values - entropy_term
            targets = samples.rewards + (1 - samples.dones) * self.gamma * next_value
        values = self.critic(samples.observations, samples.actions)
        loss = 0.5 * th.stack([F.mse_loss(value, targets) for value in values]).sum()
        self._minimize(loss, self.critic.optimizer)
        return {"critic_loss": loss.detach()}

    def _update_cost_critic(self, samples: CostReplaySamples, next_actions: th.Tensor) -> TensorLogs:
        self._raise_cost_bound()
        taken, reached = (samples.observations, samples.actions), (samples.next_observations, next_actions)
        costs, continues = samples.costs.flatten(), 1 - samples.dones.flatten()
        targets = self.policy.cost_critic_target.targets(taken, reached, costs, continues, self.discount_of_cost)
        mean_loss, variance_loss = self.policy.cost_critic.loss(*taken, *targets)
        self._minimize((mean_loss + variance_loss).mean(), self.policy.cost_critic.optimizer)
        return {"cost_critic_loss": mean_loss.mean().detach(), "cost_var_loss": variance_loss.mean().detach()}

    def _update_actor(self, observations: PyTorchObs, actions: th.Tensor, entropy_term: th.Tensor) -> TensorLogs:
        value = th.cat(self.critic(observations, actions), dim=1).min(dim=1, keepdim=True).values
        means, variance = self.policy.cost_critic(observations, actions)
        risk = rising_cvar(means, variance, self.risk_level).max(0).values[:, None]
        loss = self.penalty.combine(entropy_term - value, risk, th.zeros_like(risk)).mean()
        self._minimize(loss, self.actor.optimizer)
        return {"actor_loss": loss.detach(), "safety/replayed_risk": risk.mean().detach()}

    @staticmethod
    def _minimize(loss: th.Tensor, optimizer: th.optim.Optimizer) -> None:
        differentiate(loss, optimizer)
        optimizer.step()

    def _last_state(self) -> PyTorchObs:
        assert self._last_obs is not None
        return self.policy.obs_to_tensor(self._last_obs)[0]

    def _optimizers(self) -> list[th.optim.Optimizer]:
        learned = [] if self.ent_coef_optimizer is None else [self.ent_coef_optimizer]
        return [self.actor.optimizer, self.critic.optimizer, self.policy.cost_critic.optimizer, *learned]

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names, variables = super()._get_torch_save_params()
        return [*names, "policy.cost_critic.optimizer"], variables


class SACLag(WCSAC):
    """
    SAC-Lag: :class:`WCSAC` that limits the mean of the cost, not that of its worst outcomes.

    :param args: see :class:`WCSAC`
    :param kwargs: likewise; the default of ``risk_level`` is 1
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **{"risk_level": 1.0, **kwargs})
