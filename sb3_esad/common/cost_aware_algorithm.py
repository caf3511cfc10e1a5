"""An off-policy algorithm whose every step may have a cost."""

from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, RolloutReturn
from stable_baselines3.common.utils import safe_mean

from sb3_esad.common.checkpoints import Progress, read_checkpoint, resume_callbacks
from sb3_esad.common.checks import refuse_blank_images, refuse_other_shapes, require
from sb3_esad.common.cost_buffers import CostBuffer, CostReplayBuffer
from sb3_esad.common.costs import EpisodeCosts
from sb3_esad.common.image_watch import ImageWatch
from sb3_esad.common.log_keys import key_of
from sb3_esad.common.memory import keep_freed_memory
from sb3_esad.common.whole_files import WholeFiles

SelfCostAware = TypeVar("SelfCostAware", bound="CostAwareAlgorithm")


class CostAwareAlgorithm(WholeFiles):
    """
    An algorithm of SB3 that remembers, counts and logs costs; a mixin, to be named before the algorithm that it extends.

    :param args: see the algorithm that is extended
    :param cost_key: key of the cost in the info dict; the cost of a step lies in [0, 1]
    :param kwargs: see the algorithm that is extended
    :raises ValueError: if an argument is out of its range
    """

    buffer_class: ClassVar[type[CostBuffer]] = CostReplayBuffer
    """Kind of replay buffer that the algorithm learns from, and which it has unless another is asked for."""
    buffer_arguments: ClassVar[tuple[str, ...]] = ("cost_key",)
    """Arguments of the algorithm that are handed to the replay buffer."""

    def __init__(self, *args: Any, cost_key: str = "cost", **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for name in self.buffer_arguments:
            given = self.replay_buffer_kwargs.get(name)
            require(given is None, f"replay_buffer_kwargs[{name!r}]", given, f"it as the argument {name}")
        self.cost_key = cost_key
        self.total_cost = 0.0
        self._interrupted: Progress | None = None

    def _check_arguments(self) -> None:
        require(self.batch_size >= 1, "batch_size", self.batch_size, "a number of samples >= 1")
        require(0 < self.tau <= 1, "tau", self.tau, "a share in (0, 1]")
        require(0 <= self.gamma <= 1, "gamma", self.gamma, "a discount in [0, 1]")
        chosen: Any = self.replay_buffer_class
        fitting = issubclass(chosen, self.buffer_class)
        require(fitting, "replay_buffer_class", chosen.__name__, f"a {self.buffer_class.__name__}, which keeps costs")

    def _setup_model(self) -> None:
        self.replay_buffer_class = self.replay_buffer_class or self.buffer_class
        self._check_arguments()
        own = {name: getattr(self, name) for name in self.buffer_arguments}
        self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, **own}
        super()._setup_model()
        self._episode_costs = EpisodeCosts()
        self._images = ImageWatch(self.observation_space, self.policy.normalize_images)

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        known = ", ".join(self.policy_aliases)
        require(policy_name in self.policy_aliases, "policy", policy_name, f"one of {known}")
        return super()._get_policy_from_name(policy_name)

    def learn(
        self: SelfCostAware,
        total_timesteps: int = 100_000,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfCostAware:
        """
        Learn from the environment; on a CPU with glibc the process keeps freed memory from then on.

        :param total_timesteps: number of environment steps
        :param callback: called at every step
        :param log_interval: episodes between two lines of the log
        :param tb_log_name: name of the TensorBoard run; None for the name of the class
        :param reset_num_timesteps: whether to count steps from zero
        :param progress_bar: whether to show one
        :return: the trained model
        """
        name = tb_log_name or type(self).__name__
        return super().learn(total_timesteps, callback, log_interval, name, reset_num_timesteps, progress_bar)

    @classmethod
    def resume(cls: type[SelfCostAware], path: str | Path, env: GymEnv, device: th.device | str = "auto") -> SelfCostAware:
        """
        Load the newest checkpoint of a run that was cut off, with all that a :class:`RunCheckpointCallback` has saved.

        The first ``learn`` of the model goes on with that run: hand it the same arguments as at first, for the steps that have
        been made count among its ``total_timesteps``. The checkpoint holds pickles of SB3, so resume your own runs only.

        :param path: folder of the run
        :param env: environment to go on with, built like the one of the run
        :param device: where to compute
        :return: the model
        :raises ValueError: if there is no checkpoint, or one of another algorithm or of other environments
        """
        model, progress = read_checkpoint(Path(path), cls, env, device)
        model._interrupted = progress
        return model

    def begin_anew(self, seed: int) -> None:
        """
        Begin new episodes in all environments: what follows depends on the seed and on what is saved, but on nothing else.

        :param seed: of all random numbers, those of the environments included
        """
        assert self.env is not None
        self.set_random_seed(seed)
        self._last_obs = self.env.reset()  # type: ignore[assignment]
        self._last_episode_starts = np.ones(self.env.num_envs, dtype=bool)
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._vec_normalize_env.get_original_obs()
        if self.action_noise is not None:
            self.action_noise.reset()
        self._episode_costs.clear()

    def collect_rollouts(self, *args: Any, **kwargs: Any) -> RolloutReturn:
        """
        Collect steps.

        :param args: see SB3's ``OffPolicyAlgorithm.collect_rollouts``
        :param kwargs: likewise
        :return: how many there were, and whether to go on
        """
        rollout = super().collect_rollouts(*args, **kwargs)
        if not rollout.continue_training:
            self._last_obs = None  # the step at which a callback stopped was not stored: to go on takes new episodes
        return rollout

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        self._images.observe(self._last_obs, new_obs)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._last_episode_starts = dones  # SB3 forgets which episodes have just begun

    def _has_enough_steps(self) -> bool:
        """Whether there is enough to learn from: a loaded model that came without its buffer would unlearn on a few steps."""
        buffer = self.replay_buffer
        return buffer.full or buffer.size() * self.n_envs >= self.learning_starts

    # Logging: what an episode costs stands beside what it earns

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        assert dones is not None
        costs = self.replay_buffer.read_costs(infos)
        self.total_cost += float(costs.sum())
        for episode in self._episode_costs.add(costs, dones):
            infos[episode.env].get("episode", {})["c"] = episode.cost
        super()._update_info_buffer(infos, dones)

    def dump_logs(self) -> None:
        """Write the log, costs included."""
        costs = [info["c"] for info in self.ep_info_buffer or [] if "c" in info]
        if costs:
            self.logger.record("rollout/ep_cost_mean", safe_mean(costs))
        self.logger.record("rollout/total_cost", self.total_cost)
        self.logger.record("rollout/cost_rate", self.total_cost / max(self.num_timesteps, 1))
        super().dump_logs()

    def _record(self, logs: dict[str, list[th.Tensor]]) -> None:
        """Log the means of what the updates since the last line have brought."""
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        if logs:
            means = th.stack([th.stack(values).float().mean() for values in logs.values()]).tolist()
            for name, mean in zip(logs, means, strict=True):
                self.logger.record_mean(key_of(name), mean)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args: Any,
        **kwargs: Any,
    ) -> tuple[int, BaseCallback]:
        if self.device.type == "cpu":
            keep_freed_memory()
        progress, start = self._interrupted, self._num_timesteps_at_start
        if progress is not None:
            self.begin_anew(progress.seed)
            total_timesteps, reset_num_timesteps = total_timesteps - (self.num_timesteps - start), False
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        if progress is not None:
            self._interrupted, self._num_timesteps_at_start = None, start
            self.start_time -= progress.elapsed
            resume_callbacks(result[1], progress)
        if self.num_timesteps == 0:
            self.total_cost = 0.0
        assert self._last_obs is not None and self._last_episode_starts is not None
        if self._last_episode_starts.all():
            self._episode_costs.clear()
        if self._last_original_obs is not None:
            refuse_other_shapes(self._last_original_obs, self.observation_space)
        refuse_blank_images(self._last_obs, self.observation_space, self.policy.normalize_images)
        return result

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_episode_costs", "_images", "_interrupted"]
