"""The template of all algorithms that learn from imagination: sample, fit the world model, imagine, improve the behaviour."""

from abc import abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_esad.common.checks import require
from sb3_esad.common.log_keys import grouped
from sb3_esad.common.optimizers import differentiate
from sb3_esad.common.policies import LatentCnnPolicy, LatentMultiInputPolicy, LatentPolicy
from sb3_esad.common.precision import autocast
from sb3_esad.common.recurrent_algorithm import RecurrentOffPolicyAlgorithm
from sb3_esad.common.rssm import Filtered
from sb3_esad.common.schedules import HoldThenFall
from sb3_esad.common.side_by_side import side_by_side
from sb3_esad.common.starts import choose_starts
from sb3_esad.common.target_networks import update_target
from sb3_esad.common.type_aliases import Imagination, LatentState, SequenceSamples, TensorLogs

FALLING_RATE = HoldThenFall(start=0.006, hold=0.5)
"""A constant rate, large enough to learn, swings between driving too fast and crawling (docs/experiments.md, section 5)."""


class LatentAlgorithm(RecurrentOffPolicyAlgorithm):
    """
    Base of the algorithms that improve their behaviour in the latent space of a world model.

    :param policy: ``"MlpPolicy"``, ``"CnnPolicy"``, ``"MultiInputPolicy"`` or a :class:`LatentPolicy`
    :param env: environment with a Box action space
    :param learning_rate: of all networks, a number or a function of the remaining progress; 0.006 by default, which
        falls to 0 in the second half of the training
    :param pretrain_steps: updates of the world model alone, before the first update of the behaviour
    :param pretrain_gradient_steps: additional updates of model and behaviour when learning starts
    :param imagination_horizon: H, imagined steps
    :param imagination_starts: number of imagined trajectories in an update
    :param lambda_return: mixing of n-step returns, in [0, 1]
    :param max_grad_norm: bound of the norm of each network's gradient
    :param kwargs: see :class:`RecurrentOffPolicyAlgorithm`
    :raises ValueError: if an argument is out of its range
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": LatentPolicy,
        "CnnPolicy": LatentCnnPolicy,
        "MultiInputPolicy": LatentMultiInputPolicy,
    }

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = FALLING_RATE,
        pretrain_steps: int = 100,
        pretrain_gradient_steps: int = 0,
        imagination_horizon: int = 10,
        imagination_starts: int = 48,
        lambda_return: float = 0.95,
        max_grad_norm: float = 100.0,
        _init_setup_model: bool = True,
        **kwargs: Any,
    ) -> None:
        super().__init__(policy, env, learning_rate, _init_setup_model=False, **kwargs)
        self.pretrain_steps = pretrain_steps
        self.pretrain_gradient_steps = pretrain_gradient_steps
        self.imagination_horizon = imagination_horizon
        self.imagination_starts = imagination_starts
        self.lambda_return = lambda_return
        self.max_grad_norm = max_grad_norm
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        self.actor, self.critic, self.critic_target = self.policy.actor, self.policy.critic, self.policy.critic_target

    def _check_arguments(self) -> None:
        super()._check_arguments()
        require(0 <= self.lambda_return <= 1, "lambda_return", self.lambda_return, "a number in [0, 1]")
        for name in ("pretrain_steps", "pretrain_gradient_steps"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a number of updates >= 0")
        require(self.imagination_horizon >= 1, "imagination_horizon", self.imagination_horizon, "a number of steps >= 1")
        require(self.imagination_starts >= 2, "imagination_starts", self.imagination_starts, "a number of trajectories >= 2")
        require(self.max_grad_norm > 0, "max_grad_norm", self.max_grad_norm, "a bound > 0")

    def train(self, gradient_steps: int, batch_size: int = 16) -> None:
        """
        Update the world model and, in its imagination, the behaviour.

        :param gradient_steps: number of updates
        :param batch_size: windows in a batch
        """
        if gradient_steps < 1 or not self._has_enough_steps():
            return
        self.policy.set_training_mode(True)
        self._update_learning_rate(list(self._optimizers().values()))
        if self._n_updates == 0:
            gradient_steps += self.pretrain_gradient_steps
            for _ in range(self.pretrain_steps):
                self._update_world_model(self._sample(batch_size))
        logs: dict[str, list[th.Tensor]] = defaultdict(list)
        for update_logs in self._updates(gradient_steps, batch_size):
            for name, value in update_logs.items():
                logs[name].append(value)
        self._n_updates += gradient_steps
        self._record(logs)

    def _updates(self, n: int, batch_size: int) -> Iterator[TensorLogs]:
        """
        Update model and behaviour in turns.

        While the behaviour learns, the model is not moved: its next gradient is computed meanwhile.
        """
        samples = self._sample(batch_size)
        filtered, model_logs = self._update_world_model(samples)
        for _ in range(n - 1):
            following = self._sample(batch_size)
            learn, fit = partial(self._learn_behavior, samples, filtered), self._fitting(following)
            behavior_logs, (next_filtered, next_logs) = side_by_side(learn, fit, self.device)
            next_logs["world_model/grad_norm"] = self._move_world_model()
            yield {**model_logs, **behavior_logs}
            samples, filtered, model_logs = following, next_filtered, next_logs
        yield {**model_logs, **self._learn_behavior(samples, filtered)}

    @abstractmethod
    def _update_behavior(self, samples: SequenceSamples, filtered: Filtered, imagined: Imagination) -> TensorLogs:
        """
        Improve actor and critics.

        :param samples: recorded windows
        :param filtered: their states, without gradient
        :param imagined: trajectories of the present policy, with the gradients of later states by earlier actions
        :return: values to log
        """

    def _sample(self, batch_size: int) -> SequenceSamples:
        return self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)

    def _learn_behavior(self, samples: SequenceSamples, filtered: Filtered) -> TensorLogs:
        with autocast(self.device):
            return self._update_behavior(samples, filtered, self._imagine(samples, filtered))

    def _update_world_model(self, samples: SequenceSamples) -> tuple[Filtered, TensorLogs]:
        filtered, logs = self._fitting(samples)()
        logs["world_model/grad_norm"] = self._move_world_model()
        return filtered, logs

    def _fitting(self, samples: SequenceSamples) -> Callable[[], tuple[Filtered, TensorLogs]]:
        """Draw what is random about a gradient of the world model, and give the job that computes it."""
        generator = self._own_generator()

        def fit() -> tuple[Filtered, TensorLogs]:
            with autocast(self.device):
                loss, filtered, logs = self.policy.world_model.loss(samples, generator)
            differentiate(loss, self.policy.world_model.optimizer)
            return filtered.detach(), grouped("world_model", logs)

        return fit

    def _observing(self, samples: SequenceSamples) -> Callable[[], Filtered]:
        """Draw what is random about the states of recorded windows, and give the job that finds them."""
        generator = self._own_generator()

        def observe() -> Filtered:
            nothing_hidden = th.zeros_like(samples.rewards.T, dtype=th.bool)
            with autocast(self.device), th.no_grad():
                return self.policy.world_model.observe(samples, nothing_hidden, generator)

        return observe

    def _own_generator(self) -> th.Generator:
        """Random numbers for a job beside others, started by torch's global ones."""
        return th.Generator(self.device).manual_seed(int(th.randint(2**62, ()).item()))

    def _step(self, name: str, loss: th.Tensor) -> th.Tensor:
        """Minimise a loss by one step of one network; whatever else it passed through stays."""
        differentiate(loss, getattr(self.policy, name).optimizer)
        return self._move(name)

    def _move(self, name: str) -> th.Tensor:
        """Move a network against its gradient, and its target after it."""
        network = getattr(self.policy, name)
        norm = th.nn.utils.clip_grad_norm_(network.parameters(), self.max_grad_norm)
        network.optimizer.step()
        update_target(network, getattr(self.policy, f"{name}_target"), self.tau)
        return norm

    def _imagine(self, samples: SequenceSamples, filtered: Filtered) -> Imagination:
        start = choose_starts(samples, filtered, self.imagination_starts)
        start = start._replace(action=self._first_actions(start))
        return self.policy.world_model.imagine(start, self.policy.actor, self.imagination_horizon, self.gamma)

    def _first_actions(self, start: LatentState) -> th.Tensor:
        return self.policy.actor(self.policy.world_model.features(start))

    def _move_world_model(self) -> th.Tensor:
        norm = self._move("world_model")
        self.policy.world_model.rssm.head.settle()
        return norm

    def _optimizers(self) -> dict[str, th.optim.Optimizer]:
        names = ("world_model", "actor", "critic", "cost_critic")
        return {f"policy.{name}.optimizer": getattr(self.policy, name).optimizer for name in names}

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", *self._optimizers()], []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "actor", "critic", "critic_target"]
