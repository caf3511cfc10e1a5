"""Storage of observations that keeps every frame only once."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_obs_shape

ObservationArray = np.ndarray | dict[str, np.ndarray]


def padded(rows: np.ndarray, n: int) -> np.ndarray:
    """
    Add rows of zeros.

    :param rows: (m, ...), m <= n
    :param n: how many there shall be
    :return: (n, ...)
    """
    whole = np.zeros((n, *rows.shape[1:]), dtype=rows.dtype)
    whole[: len(rows)] = rows
    return whole


class FrameStore:
    """
    Ring of frames in which the successor of a frame is the next frame of the ring; a pickle of it has those written only.

    The exceptions are kept aside: the successor of the newest frame, and the last frame of each episode, which the first
    frame of the following one would otherwise replace.

    :param buffer_size: steps in the ring
    :param n_envs: number of parallel environments
    :param space: space of a single observation, not a Dict
    """

    def __init__(self, buffer_size: int, n_envs: int, space: spaces.Space) -> None:
        shape: Any = get_obs_shape(space)
        self.frames = np.zeros((buffer_size, n_envs, *shape), dtype=space.dtype)
        self._heads = np.zeros((n_envs, *shape), dtype=space.dtype)
        self.clear()

    def clear(self) -> None:
        """Forget all frames."""
        self._newest, self._n_written = -1, 0
        self._set_aside: dict[tuple[int, int], np.ndarray] = {}

    def add(self, step: int, obs: np.ndarray, next_obs: np.ndarray) -> np.ndarray:
        """
        Store one step of all environments.

        :param step: index in the ring, one after the newest
        :param obs: (n_envs, ...)
        :param next_obs: (n_envs, ...), the last frame of the episode where it has ended
        :return: (n_envs,) bool, True where ``obs`` does not continue the previous step
        """
        obs = np.asarray(obs, dtype=self.frames.dtype).reshape(self._heads.shape)
        jumps = (obs != self._heads).reshape(len(obs), -1).any(axis=1) | (self._newest < 0)
        for env in range(len(obs)):
            if jumps[env] and self._newest >= 0:
                self._set_aside[self._newest, env] = self._heads[env].copy()
            self._set_aside.pop((step, env), None)
        self.frames[step] = obs
        self._heads[:] = np.asarray(next_obs).reshape(self._heads.shape)
        self._newest, self._n_written = step, max(self._n_written, step + 1)
        return jumps

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "frames": self.frames[: self._n_written], "buffer_size": len(self.frames)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        buffer_size = state.pop("buffer_size")
        vars(self).update(state)
        self.frames = padded(self.frames, buffer_size)

    def get(self, steps: np.ndarray, envs: np.ndarray) -> np.ndarray:
        """
        Read the frames in which steps were taken.

        :param steps: indices in the ring, of any shape S
        :param envs: broadcastable to S
        :return: (*S, ...) frames
        """
        return self.frames[steps, envs]

    def get_next(self, steps: np.ndarray, envs: np.ndarray, jumps: np.ndarray) -> np.ndarray:
        """
        Read the frames that steps have led to.

        :param steps: indices in the ring, of any shape S
        :param envs: broadcastable to S
        :param jumps: bool, of shape S, the frame after the step opens another episode
        :return: (*S, ...) frames
        """
        envs = np.broadcast_to(envs, steps.shape)
        following = self.frames[(steps + 1) % len(self.frames), envs]
        newest = steps == self._newest
        following[newest] = self._heads[envs[newest]]
        for index in zip(*np.nonzero(jumps & ~newest), strict=True):
            key = int(steps[index]), int(envs[index])
            following[index] = self._set_aside.get(key, following[index])
        return following


class DictFrameStore:
    """
    One :class:`FrameStore` for each key of a Dict space, with the same methods.

    :param buffer_size: steps in the ring
    :param n_envs: number of parallel environments
    :param space: the Dict space
    """

    def __init__(self, buffer_size: int, n_envs: int, space: spaces.Dict) -> None:
        self._stores = {key: FrameStore(buffer_size, n_envs, part) for key, part in space.spaces.items()}

    @property
    def frames(self) -> dict[str, np.ndarray]:
        """The ring of each key."""
        return {key: store.frames for key, store in self._stores.items()}

    def clear(self) -> None:
        """Forget all frames."""
        for store in self._stores.values():
            store.clear()

    def add(self, step: int, obs: dict[str, np.ndarray], next_obs: dict[str, np.ndarray]) -> np.ndarray:
        """See :meth:`FrameStore.add`; any key may tell that an episode does not continue."""
        return np.any([store.add(step, obs[key], next_obs[key]) for key, store in self._stores.items()], axis=0)

    def get(self, steps: np.ndarray, envs: np.ndarray) -> dict[str, np.ndarray]:
        """See :meth:`FrameStore.get`."""
        return {key: store.get(steps, envs) for key, store in self._stores.items()}

    def get_next(self, steps: np.ndarray, envs: np.ndarray, jumps: np.ndarray) -> dict[str, np.ndarray]:
        """See :meth:`FrameStore.get_next`."""
        return {key: store.get_next(steps, envs, jumps) for key, store in self._stores.items()}


def make_frame_store(buffer_size: int, n_envs: int, space: spaces.Space) -> Any:
    """
    Build the store that fits the observations.

    :param buffer_size: steps in the ring
    :param n_envs: number of parallel environments
    :param space: space of the observations
    :return: a :class:`FrameStore` or a :class:`DictFrameStore`
    """
    if isinstance(space, spaces.Dict):
        return DictFrameStore(buffer_size, n_envs, space)
    return FrameStore(buffer_size, n_envs, space)
