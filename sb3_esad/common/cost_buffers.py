"""Replay of steps with their costs."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_esad.common.costs import CostReader
from sb3_esad.common.frames import ObservationArray, make_frame_store, padded
from sb3_esad.common.type_aliases import CostReplaySamples

ROWS = ("actions", "rewards", "costs", "dones", "timeouts", "episode_starts")
"""Arrays of a buffer that have a row for each step."""


class CostBuffer(ReplayBuffer):
    """
    Base of the replay buffers of this package: steps with their costs, and observations of any space.

    Each frame is stored once, for ``next_obs`` of a step is ``obs`` of the next one; only the last frame of an episode, which
    the reset hides, and the newest ``next_obs`` are stored apart. If ``obs`` does not continue the previous step although that
    was not done (the environment was reset from outside), the step opens an episode, too.

    :param buffer_size: number of steps, all environments together
    :param observation_space: Box, Discrete, MultiDiscrete, MultiBinary or a Dict of these
    :param action_space: space of the actions
    :param device: where samples are put
    :param n_envs: number of parallel environments
    :param optimize_memory_usage: must be False, for SB3's way would overwrite the last frame of an episode
    :param handle_timeout_termination: a step that was truncated by a time limit is not terminal
    :param cost_key: key of the cost in the info dict
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
        cost_key: str = "cost",
    ) -> None:
        # Not ReplayBuffer's constructor: it would allocate every frame twice.
        super(ReplayBuffer, self).__init__(buffer_size, observation_space, action_space, device, n_envs=n_envs)
        if optimize_memory_usage:
            raise ValueError(
                "optimize_memory_usage=True would lose the last frames of episodes; leave it False, frames are unique here."
            )
        self.buffer_size = max(buffer_size // n_envs, 1)
        self.optimize_memory_usage = optimize_memory_usage
        self.handle_timeout_termination = handle_timeout_termination
        self.read_costs = CostReader(cost_key)
        self._frames = make_frame_store(self.buffer_size, n_envs, observation_space)
        self.observations = self._frames.frames
        shape = (self.buffer_size, n_envs)
        self.actions = np.zeros((*shape, self.action_dim), dtype=np.float32)  # scaled, whatever the type of the space
        self.rewards = np.zeros(shape, dtype=np.float32)
        self.costs = np.zeros(shape, dtype=np.float32)
        self.dones = np.zeros(shape, dtype=np.float32)
        self.timeouts = np.zeros(shape, dtype=np.float32)
        self.episode_starts = np.zeros(shape, dtype=bool)
        self._n_events = self._n_continued = 0.0

    def __getstate__(self) -> dict[str, Any]:
        # Rows that no step has reached yet are most of a young buffer, and would be written to each file
        return {**vars(self), "observations": None, **{name: getattr(self, name)[: self.size()] for name in ROWS}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.observations = self._frames.frames
        vars(self).update({name: padded(getattr(self, name), self.buffer_size) for name in ROWS})

    def take_settings_of(self, other: "CostBuffer") -> None:
        """
        Read costs by the same key as another buffer.

        :param other: the buffer whose place this one takes
        """
        self.read_costs = other.read_costs

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self._frames.clear()
        self._n_events = self._n_continued = 0.0
        self.costs[:] = 0.0

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
        self._count_events(-1)
        self.actions[self.pos] = np.reshape(action, (self.n_envs, self.action_dim))
        self.rewards[self.pos] = reward
        self.costs[self.pos] = costs
        self.dones[self.pos] = done
        if self.handle_timeout_termination:
            # Arrays of one entry as well, which SB3's extend() may be given
            self.timeouts[self.pos] = np.array([info.get("TimeLimit.truncated", False) for info in infos]).reshape(-1)
        self._count_events(1)
        self.pos = (self.pos + 1) % self.buffer_size
        self.full = self.full or self.pos == 0

    @property
    def continue_after_cost(self) -> float:
        """How often an episode goes on after a step with a cost: a share of the stored steps, 0 if none has a cost."""
        return self._n_continued / self._n_events if self._n_events else 0.0

    def _count_events(self, sign: int) -> None:
        """Count the costs of the present row, or take them back before it is overwritten."""
        events = self.costs[self.pos] > 0
        self._n_events += sign * float(events.sum())
        self._n_continued += sign * float(self._continues(self.pos, slice(None))[events].sum())

    def _continues(self, steps: np.ndarray | int, envs: np.ndarray | slice) -> np.ndarray:
        return 1.0 - self.dones[steps, envs] * (1.0 - self.timeouts[steps, envs])

    def _jumps(self, steps: np.ndarray, envs: np.ndarray) -> np.ndarray:
        # After the newest step this reads the oldest one; the frame store and a window's end make that harmless.
        return self.episode_starts[(steps + 1) % self.buffer_size, envs]

    def _read_observations(
        self, steps: np.ndarray, envs: np.ndarray, env: VecNormalize | None
    ) -> tuple[th.Tensor | TensorDict, th.Tensor | TensorDict]:
        """Observations of steps and those they have led to, normalised by ``env`` if there is one."""
        arrays = self._frames.get(steps, envs), self._frames.get_next(steps, envs, self._jumps(steps, envs))
        before, after = (self._to_tensors(self._normalize_obs(array, env)) for array in arrays)
        return before, after

    def _read_rewards(self, steps: np.ndarray, envs: np.ndarray, env: VecNormalize | None) -> th.Tensor:
        return self.to_torch(self._normalize_reward(self.rewards[steps, envs], env), copy=False)

    def _to_tensors(self, observations: ObservationArray) -> th.Tensor | TensorDict:
        if isinstance(observations, dict):
            return {key: self.to_torch(array, copy=False) for key, array in observations.items()}
        return self.to_torch(observations, copy=False)


class CostReplayBuffer(CostBuffer):
    """SB3's ``ReplayBuffer`` and ``DictReplayBuffer`` in one, with costs: single steps, all of them equally likely."""

    def _get_samples(  # type: ignore[override]
        self, batch_inds: np.ndarray, env: VecNormalize | None = None
    ) -> CostReplaySamples:
        # Drawn as SB3 draws them: the same seed gives the same batches
        steps, envs = batch_inds, np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))
        observations, next_observations = self._read_observations(steps, envs, env)
        return CostReplaySamples(
            observations=observations,
            actions=self.to_torch(self.actions[steps, envs], copy=False),
            next_observations=next_observations,
            dones=self.to_torch(1.0 - self._continues(steps, envs)[:, None], copy=False),
            rewards=self._read_rewards(steps, envs, env)[:, None],
            costs=self.to_torch(self.costs[steps, envs][:, None], copy=False),
        )


def refuse_other_buffer(loaded: ReplayBuffer, own: CostBuffer) -> None:
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
