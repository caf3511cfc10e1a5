"""An off-policy algorithm whose policy remembers."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import GymEnv, Schedule

from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.checks import refuse_unknown, require
from sb3_esad.common.cost_aware_algorithm import CostAwareAlgorithm
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.type_aliases import Belief, LatentState

NOT_OFFERED = {
    "use_sde": "gSDE is not offered, pass an action_noise instead",
    "sde_sample_freq": "gSDE is not offered, pass an action_noise instead",
    "use_sde_at_warmup": "gSDE is not offered, set random_hold instead",
    "n_steps": "n-step returns are mixed by lambda_return instead",
}
"""Arguments that other algorithms of SB3 have, and what to do without them."""


class RecurrentOffPolicyAlgorithm(CostAwareAlgorithm):
    """
    SB3's off-policy algorithm with what it lacks: a memory between two actions, and windows of steps to learn from.

    :param policy: a :class:`LatentPolicy`, or the alias of one
    :param env: environment with a Box action space
    :param learning_rate: of all networks, a number or a function of the remaining progress
    :param buffer_size: number of steps to remember
    :param learning_starts: steps of random actions of random amplitude, each held for ``random_hold`` steps, before learning;
        a loaded model without its replay buffer that goes on (``reset_num_timesteps=False``) first collects as many of its own
    :param batch_size: windows in a batch
    :param sequence_length: steps in a window
    :param tau: share of the learned networks in their targets at each update
    :param gamma: discount
    :param train_freq: steps of each environment between updates
    :param gradient_steps: updates each time; -1 for as many as steps were made
    :param action_noise: added to the actions while training
    :param replay_buffer_class: a :class:`SequenceReplayBuffer`
    :param replay_buffer_kwargs: its further arguments
    :param optimize_memory_usage: must be False: frames are stored once anyway
    :param random_hold: steps for which a random action of the warm-up is held
    :param cost_key: key of the cost in the info dict; the cost of a step lies in [0, 1]
    :param policy_kwargs: further arguments of the policy
    :param stats_window_size: episodes over which the log averages
    :param tensorboard_log: where to write TensorBoard logs
    :param verbose: 0 silent, 1 info, 2 debug
    :param device: where to compute
    :param seed: of all random numbers
    :param _init_setup_model: whether to build the networks at once
    :param unknown: refused; arguments of other SB3 algorithms with what to use instead
    :raises ValueError: if an argument is out of its range
    """

    saved_marks = ("random_hold",)
    buffer_class = SequenceReplayBuffer
    buffer_arguments = (*CostAwareAlgorithm.buffer_arguments, "sequence_length")
    policy: LatentPolicy
    replay_buffer: SequenceReplayBuffer
    action_space: spaces.Box
    _last_latent: LatentState | None

    def __init__(
        self,
        policy: str | type[LatentPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule,
        buffer_size: int = 100_000,
        learning_starts: int = 1000,
        batch_size: int = 16,
        sequence_length: int = 16,
        tau: float = 0.02,
        gamma: float = 0.97,
        train_freq: int | tuple[int, str] = 4,
        gradient_steps: int = 1,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[SequenceReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        random_hold: int = 3,
        cost_key: str = "cost",
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        device: th.device | str = "auto",
        seed: int | None = None,
        _init_setup_model: bool = True,
        **unknown: Any,
    ) -> None:
        refuse_unknown(type(self).__name__, unknown, NOT_OFFERED)
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            tau,
            gamma,
            train_freq,
            gradient_steps,
            action_noise,
            replay_buffer_class,
            replay_buffer_kwargs,
            optimize_memory_usage,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            sde_support=False,
            cost_key=cost_key,
        )
        self._check_action_space()
        self.sequence_length = sequence_length
        self.random_hold = random_hold
        if _init_setup_model:
            self._setup_model()

    def _check_action_space(self) -> None:
        if self.env is None:
            return  # as in load: the spaces are those of the saved model
        if not isinstance(self.action_space, spaces.Box):
            remedy = "with highway-env, configure its action as {'type': 'ContinuousAction'}, or wrap the environment"
            raise ValueError(f"{type(self).__name__} needs a Box of actions, not {self.action_space}: {remedy}.")
        if not np.issubdtype(self.action_space.dtype, np.floating):
            remedy = "give it another dtype, and round in the environment"
            raise ValueError(f"{type(self).__name__} needs actions of floating point, not {self.action_space}: {remedy}.")

    def _check_arguments(self) -> None:
        super()._check_arguments()
        require(self.random_hold >= 1, "random_hold", self.random_hold, "a number of steps >= 1")

    def _setup_model(self) -> None:
        super()._setup_model()
        self._last_latent = None
        self._random_actions: np.ndarray | None = None

    def begin_anew(self, seed: int) -> None:
        """
        Begin new episodes, of which nothing is remembered.

        :param seed: see :meth:`CostAwareAlgorithm.begin_anew`
        """
        super().begin_anew(seed)
        self._last_latent = self._random_actions = None

    # Acting: SB3 asks for an action without a memory

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        belief = self._take_in_last_observation(n_envs)
        warm_up = self.num_timesteps < learning_starts
        actions = self._held_random_actions(n_envs) if warm_up else self.policy.learner.act(belief.state)
        if action_noise is not None:
            noise = th.as_tensor(action_noise(), dtype=actions.dtype, device=actions.device)
            actions = (actions + noise.view_as(actions)).clamp(-1, 1)
        # The memory must hold the action that is executed, or it would learn from a world that did not happen
        executed = actions if warm_up else self._select(belief, actions)
        self._last_latent = belief.state._replace(action=executed)
        shaped = executed.cpu().numpy().reshape(n_envs, *self.action_space.shape)
        if not np.isfinite(shaped).all():
            found = f"An action is {shaped[~np.isfinite(shaped)][0]} after {self._n_updates} updates"
            raise ValueError(f"{found}: learning has diverged, choose a smaller learning_rate or max_grad_norm.")
        return self.policy.unscale_action(shaped).astype(self.action_space.dtype), shaped

    def _select(self, belief: Belief, proposed: th.Tensor) -> th.Tensor:
        """Choose what is executed where the actor proposes an action, of shape (N, A)."""
        return self.policy.action_filter.select(self.policy.learner, belief, proposed).actions

    def _take_in_last_observation(self, n_envs: int) -> Belief:
        starts = self._last_episode_starts
        if self._last_latent is None or starts is None:
            starts, self._last_latent = np.ones(n_envs, dtype=bool), self.policy.initial_state(n_envs)
        assert self._last_obs is not None
        observation, _ = self.policy.obs_to_tensor(self._last_obs)
        episode_start = th.as_tensor(starts, device=self.device)
        return self.policy.learner.observe(observation, self._last_latent, episode_start, False)

    def _held_random_actions(self, n_envs: int) -> th.Tensor:
        if self._random_actions is None or (self.num_timesteps // n_envs) % self.random_hold == 0:
            actions = np.stack([self.action_space.sample() for _ in range(n_envs)])
            scaled = self.policy.scale_action(actions).reshape(n_envs, -1)
            # With a random amplitude: full strokes alone would end every episode within seconds and show little of the world
            self._random_actions = (np.random.rand(n_envs, 1) * scaled).astype(np.float32)
        return th.as_tensor(self._random_actions, device=self.device)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_last_latent", "_random_actions"]
