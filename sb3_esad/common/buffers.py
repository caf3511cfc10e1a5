"""Replay of consecutive steps with their costs."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_esad.common.checks import require
from sb3_esad.common.cost_buffers import CostBuffer
from sb3_esad.common.type_aliases import SequenceSamples
from sb3_esad.common.windows import WindowIndex, event_weights, time_to_event


class SequenceReplayBuffer(CostBuffer):
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

    Crashes are rare, so ``event_fraction`` of a batch is drawn among the windows with a cost, as soon as there is one; the
    ``event_weights`` of the samples take the bias out again. Most crashes are those of random actions and of early policies,
    and where a model does not see clearly it expects what is usual: by ``recency`` what is newer is drawn more often
    (docs/experiments.md, section 23).

    :param buffer_size: number of steps, all environments together
    :param observation_space: Box, Discrete, MultiDiscrete, MultiBinary or a Dict of these
    :param action_space: space of the actions
    :param device: where samples are put
    :param n_envs: number of parallel environments
    :param sequence_length: T, steps of a window; fewer while the buffer is younger
    :param event_fraction: share of a batch drawn among windows with a cost, in [0, 1)
    :param recency: in [0, 100]; the probability of a window grows by e to this power from the beginning of the buffer to its
        end, 0 if all are equally likely
    :param kwargs: see :class:`CostBuffer`
    :raises ValueError: if an argument cannot be honoured
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        sequence_length: int = 16,
        event_fraction: float = 0.5,
        recency: float = 3.0,
        **kwargs: Any,
    ) -> None:
        super().__init__(buffer_size, observation_space, action_space, device, n_envs, **kwargs)
        _check(self.buffer_size, sequence_length, event_fraction)
        require(0 <= recency <= 100, "recency", recency, "a number from 0 to 100")
        self.sequence_length = sequence_length
        self.event_fraction = event_fraction
        self.recency = recency
        self._windows: WindowIndex | None = None

    def take_settings_of(self, other: CostBuffer) -> None:
        """
        Draw windows as another buffer does, and read costs by the same key.

        :param other: the buffer whose place this one takes
        """
        super().take_settings_of(other)
        assert isinstance(other, SequenceReplayBuffer)
        self.sequence_length = other.sequence_length
        self.event_fraction, self.recency = other.event_fraction, other.recency

    def __getstate__(self) -> dict[str, Any]:
        return {**super().__getstate__(), "_windows": None}

    def add(self, *args: Any, **kwargs: Any) -> None:
        """
        Store one step of all environments.

        :param args: see :meth:`CostBuffer.add`
        :param kwargs: likewise
        """
        super().add(*args, **kwargs)
        self._windows = None

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
        windows = self._index(min(self.sequence_length, self.size()))
        n_events = int(batch_size * self.event_fraction) if windows.event_share > 0 else 0
        drawn = windows.draw(batch_size - n_events), windows.draw_events(n_events)
        starts, envs = map(np.concatenate, zip(*drawn, strict=True))
        steps = starts[:, None] + np.arange(windows.length)
        if self.full:
            steps = (steps + self.pos) % self.buffer_size
        return self._get_sequences(steps, envs[:, None], n_events, windows.event_share, env)

    def latest_episode(
        self, length: int, env: VecNormalize | None = None
    ) -> tuple[th.Tensor | TensorDict, th.Tensor | TensorDict, th.Tensor] | None:
        """
        Give the opening of the episode that began last among those that have ended.

        :param length: L, steps at most
        :param env: normalises observations
        :return: observations, those that followed, of shape (L, ...), and the actions between them, in [-1, 1], of shape
            (L, A); None if no whole episode is stored
        """
        order = np.roll(np.arange(self.size()), -self.pos)  # oldest first; a young buffer is rolled once around
        openings = [np.flatnonzero(starts) for starts in self.episode_starts[order].T]
        whole = [(each[-2], each[-1], env_index) for env_index, each in enumerate(openings) if len(each) > 1]
        if not whole:
            return None
        begin, end, env_index = max(whole)
        steps, envs = order[begin : min(end, begin + length)], np.array(env_index)
        return *self._read_observations(steps, envs, env), self.to_torch(self.actions[steps, envs], copy=False)

    def _index(self, length: int) -> WindowIndex:
        """The windows of that length; drawn from again and again, until there are new steps or other settings."""
        known = self._windows
        if known is None or (known.length, known.recency) != (length, self.recency):
            known = self._windows = WindowIndex(self._events_in_order(), length, self.recency)
        return known

    def _events_in_order(self) -> np.ndarray:
        """(size, n_envs) bool, oldest step first; a young buffer is rolled once around."""
        return np.roll(self.costs[: self.size()] > 0, -self.pos, axis=0)

    def _get_sequences(
        self, steps: np.ndarray, envs: np.ndarray, n_events: int, event_share: float, env: VecNormalize | None
    ) -> SequenceSamples:
        costs = self.costs[steps, envs]
        events = costs > 0
        weights = event_weights(events.any(axis=1), n_events / len(steps), event_share)
        observations, next_observations = self._read_observations(steps, envs, env)
        return SequenceSamples(
            observations=observations,
            next_observations=next_observations,
            actions=self.to_torch(self.actions[steps, envs], copy=False),
            rewards=self._read_rewards(steps, envs, env),
            costs=self.to_torch(costs, copy=False),
            continues=self.to_torch(self._continues(steps, envs), copy=False),
            is_first=self.to_torch(self.episode_starts[steps, envs], copy=False),
            event_weights=self.to_torch(weights, copy=False),
            among_all=self.to_torch(np.arange(len(steps)) < len(steps) - n_events, copy=False),
            time_to_event=self.to_torch(time_to_event(events, self._jumps(steps, envs)), copy=False),
        )


def _check(buffer_size: int, sequence_length: int, event_fraction: float) -> None:
    if not 1 <= sequence_length <= buffer_size:
        raise ValueError(
            f"sequence_length is {sequence_length}; choose it from 1 to {buffer_size}, the steps stored per environment."
        )
    if not 0.0 <= event_fraction < 1.0:
        raise ValueError(f"event_fraction is {event_fraction}; choose the share of windows with a cost in [0, 1).")
