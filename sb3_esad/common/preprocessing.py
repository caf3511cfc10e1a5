"""What a world model makes of observations before it encodes or reconstructs them."""

from collections.abc import Callable, ItemsView
from typing import Any, cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space, preprocess_obs
from stable_baselines3.common.type_aliases import TensorDict
from torch import nn

from sb3_esad.common.precision import working_dtype
from sb3_esad.common.running_scale import RunningScale

Observations = th.Tensor | TensorDict


class Preprocessing(nn.Module):
    """
    SB3's preprocessing; thereafter all but images is standardised.

    :param observation_space: space of the observations, images channel-first
    :param normalize_images: whether images are bytes to be divided by 255
    """

    def __init__(self, observation_space: spaces.Space, normalize_images: bool) -> None:
        super().__init__()
        self.observation_space = observation_space
        self.normalize_images = normalize_images
        self.spaces = spaces_by_key(observation_space)
        self.image_keys = [
            key for key, space in self.spaces.items() if is_image_space(space, normalized_image=not normalize_images)
        ]
        vectors = {key: space for key, space in self.spaces.items() if key not in self.image_keys}
        self.scales = nn.ModuleDict({key: RunningScale(get_flattened_obs_dim(space)) for key, space in vectors.items()})

    def forward(self, observations: Observations) -> Observations:
        """
        Prepare observations for the networks.

        :param observations: as stored, of shape (N, ...)
        :return: of the same shapes, images first
        """
        preprocessed = by_key(preprocess_obs(observations, self.observation_space, normalize_images=self.normalize_images))
        # Images are as exact in bfloat16 as they were as bytes, and half as large
        prepared = {key: image.to(working_dtype(image.device)) for key, image in self.images(preprocessed).items()}
        prepared |= {key: scale(preprocessed[key].flatten(1)).view_as(preprocessed[key]) for key, scale in self._scales()}
        return prepared if isinstance(observations, dict) else prepared["observation"]

    def follow(self, observations: Observations) -> None:
        """
        Take note of how vectors vary.

        :param observations: as stored, of shape (N, ...)
        """
        for key, scale in self._scales():
            vectors = preprocess_obs(by_key(observations)[key], self.spaces[key], normalize_images=self.normalize_images)
            assert isinstance(vectors, th.Tensor)
            scale.follow(vectors.flatten(1))

    def invert(self, prepared: TensorDict) -> TensorDict:
        """
        Show vectors as they were before they were standardised.

        :param prepared: images and standardised vectors by key
        :return: images and flat vectors by key
        """
        return {**prepared, **{key: scale.invert(prepared[key]) for key, scale in self._scales()}}

    def images(self, observations: dict[str, Any] | Any) -> dict[str, Any]:
        """
        Pick out what is shown as an image.

        :param observations: one observation of any type, or one for each key of a Dict space
        :return: the images by key, the key of a single observation is "observation"
        """
        return {key: by_key(observations)[key] for key in self.image_keys}

    def _scales(self) -> ItemsView[str, RunningScale]:
        return cast(ItemsView[str, RunningScale], self.scales.items())


def by_key(observations: Observations) -> TensorDict:
    """
    Give observations of any space by their keys.

    :param observations: a tensor, or one for each key of a Dict space
    :return: by key, the key of a single observation is "observation"
    """
    return observations if isinstance(observations, dict) else {"observation": observations}


def spaces_by_key(space: spaces.Space) -> dict[str, spaces.Space]:
    """
    Give the parts of a space by their keys.

    :param space: any space
    :return: by key, the key of a space that is no Dict is "observation"
    """
    return space.spaces if isinstance(space, spaces.Dict) else {"observation": space}


def map_observations(observations: Observations, function: Callable[[th.Tensor], th.Tensor]) -> Observations:
    """
    Apply a function to each part of observations.

    :param observations: a tensor, or one for each key of a Dict space
    :param function: of a tensor
    :return: the results
    """
    if isinstance(observations, dict):
        return {key: function(value) for key, value in observations.items()}
    return function(observations)
