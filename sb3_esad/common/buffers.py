"""Replay of consecutive steps with their costs."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_esad.common.costs import CostReader
from sb3_esad.common.frames import ObservationArray, make_frame_store
from sb3_esad.common.type_aliases import SequenceSamples
from sb3_esad.common.windows import WindowIndex, event_weights, time_to_event


class SequenceReplayBuffer(ReplayBuffer):
    """
    Replay buffer that returns windows of consecutive steps, half of them with a cost event.

    Reward, cost and done belong to the observation that the step arrives at::

        step          0             1             2             3              4
        obs           o0            o1            o2            p0             p1       p: the next episode
                        \\ a0         \\ a1         \\ a2         \\ a0'         \\ a1'
        next_obs          o1            o2            o3            p1             p2
        reward, cost      of o1         of o2         of o3         of p1          of p2
        done              no            no            yes           no             no
        is_first      yes           no            no            yes            no

    Each frame is stored once: ``next_obs`` of step 0 is ``obs`` of step 1. Only o3, which the reset hides, and the newest
    ``next_obs`` are stored apart. If ``obs`` does not continue the previous step although that was not done (the environment
    was reset from outside), the step opens an episode, too.

    Crashes are rare, so ``event_fraction`` of a batch is drawn among the windows with a cost, as soon as there is one; the
    ``event_weights`` of the samples take the bias out again.

    :param buffer_size: number of steps, all environments together
    :param observation_space: Box, Discrete, MultiDiscrete, MultiBinary or a Dict of these
    :param action_space: space of the actions
    :param device: where samples are put
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: must be False, for SB3's way would overwrite the last frame of an episode
    :param handle_timeout_termination: a step that was truncated by a time limit is not terminal
    :param sequence_length: T, steps of a window; fewer while the buffer is younger
    :param cost_key: key of the cost in the info dict
    :param event_fraction: share of a batch drawn among windows with a cost, in [0, 1)
    :raises ValueError: if an argument cannot be honoured
    """

    observation_space: spaces.Space
    observations: ObservationArray  # type: ignore[assignment]

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        sequence_length: int = 32,
        cost_key: str = "cost",
        event_fraction: float = 0.5,
    ) -> None:
        # Not ReplayBuffer's constructor: it would allocate every frame twice.
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        self.buffer_size = max(buffer_size // n_envs, 1)
        _check(self.buffer_size, sequence_length, optimize_memory_usage, event_fraction)
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.sequence_length = sequence_length
        self.event_fraction = event_fraction
        self.read_costs = CostReader(cost_key)
        self._frames = make_frame_store(self.buffer_size, n_envs, observation_space)
        self.observations = self._frames.frames
        shape = (self.buffer_size, n_envs)
        self.actions = np.zeros((*shape, self.action_dim), dtype=self._maybe_cast_dtype(action_space.dtype))
        self.rewards = np.zeros(shape, dtype=np.float32)
        self.costs = np.zeros(shape, dtype=np.float32)
        self.dones = np.zeros(shape, dtype=np.float32)
        self.timeouts = np.zeros(shape, dtype=np.float32)
        self.episode_starts = np.zeros(shape, dtype=bool)
        self._windows: WindowIndex | None = None

    def take_settings_of(self, other: "SequenceReplayBuffer") -> None:
        """
        Return windows as long, and read costs by the same key, as another buffer.

        :param other: the buffer whose place this one takes
        """
        self.sequence_length, self.read_costs = other.sequence_length, other.read_costs
        self._windows = None  # those drawn last were for the former length

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self._frames.clear()
        self._windows = None

    def add(
        self,
        obs: ObservationArray,
        next_obs: ObservationArray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """
        Store one step of all environments.

        :param obs: (n_envs, ...)
        :param next_obs: (n_envs, ...), the last frame of the episode where ``done``
        :param action: (n_envs, A)
        :param reward: (n_envs,)
        :param done: (n_envs,)
        :param infos: info dicts, which hold the cost and ``TimeLimit.truncated``
        """
        costs = self.read_costs(infos)
        jumps = self._frames.add(self.pos, obs, next_obs)
        # The step before the very first one is zero, hence not done, but the first one is a jump.
        self.episode_starts[self.pos] = jumps | (self.dones[self.pos - 1] > 0)
        self.actions[self.pos] = np.reshape(action, (self.n_envs, self.action_dim))
        self.rewards[self.pos] = reward
        self.costs[self.pos] = costs
        self.dones[self.pos] = done
        if self.handle_timeout_termination:
            self.timeouts[self.pos] = [info.get("TimeLimit.truncated", False) for info in infos]
        self.pos = (self.pos + 1) % self.buffer_size
        self.full = self.full or self.pos == 0
        self._windows = None

    @property
    def continue_after_cost(self) -> float:
        """How often an episode goes on after a step with a cost: a share of the stored steps, 0 if none has a cost."""
        events = self.costs[: self.size()] > 0
        continues = self._continues(slice(self.size()), slice(None))[events]
        return float(continues.mean()) if len(continues) else 0.0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceSamples:  # type: ignore[override]
        """
        Draw windows of ``min(sequence_length, size())`` steps.

        :param batch_size: B, number of windows
        :param env: normalises observations and rewards, never costs
        :return: the windows
        :raises ValueError: if nothing is stored yet
        """
        if self.size() == 0:
            raise ValueError("The replay buffer is empty; add steps before sampling.")
        length = min(self.sequence_length, self.size())
        if self._windows is None:
            self._windows = WindowIndex(self._events_in_order(), length)
        n_events = int(batch_size * self.event_fraction) if self._windows.n_event_windows else 0
        drawn = self._windows.draw(batch_size - n_events), self._windows.draw_events(n_events)
        starts, envs = map(np.concatenate, zip(*drawn, strict=True))
        steps = starts[:, None] + np.arange(length)
        if self.full:
            steps = (steps + self.pos) % self.buffer_size
        return self._get_sequences(steps, envs[:, None], n_events, env)

    def _events_in_order(self) -> np.ndarray:
        """(size, n_envs) bool, oldest step first; a young buffer is rolled once around."""
        return np.roll(self.costs[: self.size()] > 0, -self.pos, axis=0)

    def _continues(self, steps: np.ndarray | slice, envs: np.ndarray | slice) -> np.ndarray:
        return 1.0 - self.dones[steps, envs] * (1.0 - self.timeouts[steps, envs])

    def _get_sequences(self, steps: np.ndarray, envs: np.ndarray, n_events: int, env: VecNormalize | None) -> SequenceSamples:
        assert self._windows is not None
        costs = self.costs[steps, envs]
        events = costs > 0
        # After the newest step this reads the oldest one; the frame store and a window's end make that harmless.
        jumps = self.episode_starts[(steps + 1) % self.buffer_size, envs]
        weights = event_weights(
            events.any(axis=1), n_events / len(steps), self._windows.n_windows, self._windows.n_event_windows
        )
        return SequenceSamples(
            observations=self._to_tensors(self._normalize_obs(self._frames.get(steps, envs), env)),
            next_observations=self._to_tensors(self._normalize_obs(self._frames.get_next(steps, envs, jumps), env)),
            actions=self.to_torch(self.actions[steps, envs], copy=False),
            rewards=self.to_torch(self._normalize_reward(self.rewards[steps, envs], env), copy=False),
            costs=self.to_torch(costs, copy=False),
            continues=self.to_torch(self._continues(steps, envs), copy=False),
            is_first=self.to_torch(self.episode_starts[steps, envs], copy=False),
            event_weights=self.to_torch(weights, copy=False),
            uniform=self.to_torch(np.arange(len(steps)) < len(steps) - n_events, copy=False),
            time_to_event=self.to_torch(time_to_event(events, jumps), copy=False),
        )

    def _to_tensors(self, observations: ObservationArray) -> th.Tensor | TensorDict:
        if isinstance(observations, dict):
            return {key: self.to_torch(array, copy=False) for key, array in observations.items()}
        return self.to_torch(observations, copy=False)


def refuse_other_buffer(loaded: ReplayBuffer, own: SequenceReplayBuffer) -> None:
    """
    Refuse a replay buffer that cannot take the place of another.

    :param loaded: the buffer
    :param own: the one whose place it shall take
    :raises ValueError: if it is of another kind, or holds steps of other environments
    """

    def describe(buffer: ReplayBuffer) -> tuple[str, int, object, object]:
        return type(buffer).__name__, buffer.n_envs, buffer.observation_space, buffer.action_space

    if describe(loaded) != describe(own):
        named = [
            f"a {kind} of {n} environments, observations {seen} and actions {done}"
            for kind, n, seen, done in map(describe, (loaded, own))
        ]
        raise ValueError(f"The replay buffer is {named[0]}, but the model needs {named[1]}; load the one that belongs to it.")


def _check(buffer_size: int, sequence_length: int, optimize_memory_usage: bool, event_fraction: float) -> None:
    if optimize_memory_usage:
        raise ValueError(
            "optimize_memory_usage=True would lose the last frames of episodes; leave it False, frames are unique here."
        )
    if not 1 <= sequence_length <= buffer_size:
        raise ValueError(
            f"sequence_length is {sequence_length}; choose it from 1 to {buffer_size}, the steps stored per environment."
        )
    if not 0.0 <= event_fraction < 1.0:
        raise ValueError(f"event_fraction is {event_fraction}; choose the share of windows with a cost in [0, 1).")
