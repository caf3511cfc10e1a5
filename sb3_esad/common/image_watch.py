"""Cameras that break down during a training are noticed."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_esad.common.warn_once import WarnOnce

PATIENCE = 1000
"""Steps in a row, resets included, for which an image may be blank or the same: at a red light little happens."""


class ImageWatch:
    """
    Warns once of each image that has shown nothing, or nothing new, for ``PATIENCE`` steps of an environment.

    :param space: of a single observation
    :param normalize_images: whether images are bytes to be divided by 255
    """

    def __init__(self, space: spaces.Space, normalize_images: bool) -> None:
        parts = space.spaces if isinstance(space, spaces.Dict) else {"observation": space}
        self._keys = [key for key, part in parts.items() if is_image_space(part, normalized_image=not normalize_images)]
        self._steps = {key: np.zeros(0, dtype=np.int64) for key in self._keys}
        self._warn = WarnOnce()

    def observe(self, before: Any, after: Any) -> None:
        """
        Take note of one step.

        :param before: observations of all environments, or those under each key of a Dict space
        :param after: those that followed, of new episodes where old ones have ended
        """
        for key in self._keys:
            old, new = (each[key] if isinstance(each, dict) else each for each in (before, after))
            if len(self._steps[key]) != len(new):
                self._steps[key] = np.zeros(len(new), dtype=np.int64)
            nothing = [_shows_nothing(*pair) for pair in zip(old, new, strict=True)]
            self._steps[key] = (self._steps[key] + 1) * nothing
            if self._steps[key].max() >= PATIENCE:
                self._complain(key, int(self._steps[key].argmax()))

    def _complain(self, key: str, env: int) -> None:
        what = f"The image '{key}' of environment {env} has been blank or the same for {PATIENCE} steps"
        self._warn(key, f"{what}, so nothing is learned from it: look at what its camera or renderer returns.")


def _shows_nothing(before: np.ndarray, after: np.ndarray) -> bool:
    return np.array_equal(before, after) or after.min() == after.max()
