"""Bad arguments are refused with their value and a remedy."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space


def require(valid: bool, name: str, value: Any, remedy: str) -> None:
    """
    Refuse an argument that makes no sense.

    :param valid: whether it does
    :param name: of the argument
    :param value: as it was given
    :param remedy: what to choose instead, the rest of the sentence "choose ..."
    :raises ValueError: if it is not valid
    """
    if not valid:
        raise ValueError(f"{name} is {value!r}; choose {remedy}.")


def refuse_unknown(algorithm: str, arguments: dict[str, Any], not_offered: dict[str, str]) -> None:
    """
    Refuse arguments that a constructor does not know.

    :param algorithm: name of the class
    :param arguments: that were given although they are unknown
    :param not_offered: what to do without the arguments that other algorithms have
    :raises ValueError: at an argument of other algorithms
    :raises TypeError: at any other
    """
    for name, value in arguments.items():
        if name in not_offered:
            raise ValueError(f"{algorithm} cannot take {name}={value!r}: {not_offered[name]}.")
        raise TypeError(f"{algorithm} has no argument '{name}'.")


def refuse_blank_images(observations: np.ndarray | dict[str, np.ndarray], space: spaces.Space, normalize_images: bool) -> None:
    """
    Refuse images without any content.

    :param observations: those of all environments, or those under each key of a Dict space
    :param space: of a single one
    :param normalize_images: whether images are bytes to be divided by 255
    :raises ValueError: if each image, or each under a key, has the same value in all of its pixels
    """
    remedy = "with highway-env, unset SDL_VIDEODRIVER, whose value 'dummy' makes all images black"
    for key, batch, shown in _parts(observations, space):
        is_image = is_image_space(shown, normalized_image=not normalize_images)
        if is_image and all(np.max(image) == np.min(image) for image in batch):
            reason = f"Every pixel of the first image '{key}' is {np.max(batch[0])}, nothing can be learned from it"
            raise ValueError(f"{reason}: {remedy}.")


def refuse_other_shapes(originals: np.ndarray | dict[str, np.ndarray], space: spaces.Space) -> None:
    """
    Refuse observations that ``VecNormalize`` keeps in another order of their axes than the model sees.

    SB3 puts the channels of images first above all wrappers, and stores what ``VecNormalize`` has seen below.

    :param originals: those that ``VecNormalize`` has seen, of all environments, or those under each key of a Dict space
    :param space: of a single one, as the model sees it
    :raises ValueError: if their shapes differ
    """
    for key, batch, shown in _parts(originals, space):
        if batch.shape[1:] != shown.shape:
            reason = f"VecNormalize has '{key}' of shape {batch.shape[1:]}, but the model is shown {shown.shape}"
            raise ValueError(
                f"{reason}: put the channels first before you normalise, by VecNormalize(VecTransposeImage(env))."
            )


def _parts(
    observations: np.ndarray | dict[str, np.ndarray], space: spaces.Space
) -> Iterator[tuple[str, np.ndarray, spaces.Space]]:
    """Name, observations and space of each key, or of all where there are no keys."""
    parts = observations if isinstance(observations, dict) else {"observation": observations}
    for key, batch in parts.items():
        yield key, batch, space[key] if isinstance(space, spaces.Dict) else space
