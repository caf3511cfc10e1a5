"""Features extractors that keep a picture's geometry: SB3's ``BaseFeaturesExtractor`` whose features are a grid, flattened."""

import math

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_esad.common.torch_layers import ChannelNorm, GridShape, mlp
from sb3_esad.common.transforms import symlog

MIN_PIXELS = 16


def check_image(space: spaces.Space, normalized_image: bool) -> tuple[int, int, int]:
    """
    Refuse what is no image, and images that are too small to be divided into cells.

    :param space: channel-first image space
    :param normalized_image: whether images are floats already
    :return: channels, height and width
    :raises ValueError: if the space is no image space, or if height or width is below 16 pixels
    """
    if not is_image_space(space, normalized_image=normalized_image):
        remedy = "use MlpPolicy or MultiInputPolicy, or normalize_images=False for images that are floats already"
        raise ValueError(f"CnnPolicy needs images of bytes from 0 to 255, not {space}: {remedy}.")
    assert space.shape is not None
    channels, height, width = space.shape
    if min(height, width) < MIN_PIXELS:
        needed = f"the encoder needs at least {MIN_PIXELS}x{MIN_PIXELS} pixels, so render it larger or use MlpPolicy"
        raise ValueError(f"The image of shape {space.shape} (channels, height, width) is too small: {needed}.")
    return channels, height, width


class SpatialCnn(BaseFeaturesExtractor):
    """
    Encode an image as a grid of features, one cell for 8x8 pixels.

    :param observation_space: channel-first image space
    :param channels: channels of each cell
    :param hidden_channels: channels of the hidden layer, whose cells are 4x4 pixels
    :param normalized_image: whether the images are floats already
    :raises ValueError: if the space is no image space, or the image smaller than 16x16 pixels
    """

    def __init__(
        self, observation_space: spaces.Space, channels: int = 48, hidden_channels: int = 32, normalized_image: bool = False
    ) -> None:
        image_channels, height, width = check_image(observation_space, normalized_image)
        self.grid_shape: GridShape = (channels, math.ceil(height / 8), math.ceil(width / 8))
        super().__init__(observation_space, math.prod(self.grid_shape))
        self.layers = nn.Sequential(
            nn.ZeroPad2d((0, -width % 8, 0, -height % 8)),
            nn.Conv2d(image_channels, hidden_channels, 4, stride=4),
            ChannelNorm(hidden_channels),
            nn.SiLU(),
            nn.Conv2d(hidden_channels, channels, 4, stride=2, padding=1),
            ChannelNorm(channels),
            nn.SiLU(),
        )

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Encode images.

        :param observations: preprocessed images, of shape (N, C, H, W)
        :return: flattened grids, of shape (N, features_dim)
        """
        return self.layers(observations).flatten(1)


class VectorExtractor(BaseFeaturesExtractor):
    """
    Encode a vector by a perceptron on its symmetric logarithm.

    :param observation_space: any space without images
    :param features_dim: number of features
    """

    def __init__(self, observation_space: spaces.Space, features_dim: int = 256) -> None:
        super().__init__(observation_space, features_dim)
        self.layers = nn.Sequential(
            nn.Flatten(), mlp(get_flattened_obs_dim(observation_space), [features_dim], features_dim), nn.SiLU()
        )

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        Encode vectors.

        :param observations: preprocessed observations, of shape (N, ...)
        :return: features, of shape (N, features_dim)
        """
        return self.layers(symlog(observations))


class CombinedExtractor(BaseFeaturesExtractor):
    """
    Encode a dictionary: images as grids, and every vector repeated in all cells.

    :param observation_space: dictionary of images and vectors
    :param channels: channels of each image's cells
    :param vector_features: number of features of each vector
    :param normalized_image: whether the images are floats already
    :raises ValueError: if the space is no dictionary, or an image smaller than 16x16 pixels
    """

    def __init__(
        self, observation_space: spaces.Space, channels: int = 48, vector_features: int = 64, normalized_image: bool = False
    ) -> None:
        if not isinstance(observation_space, spaces.Dict):
            raise ValueError(
                f"MultiInputPolicy needs a Dict of observations, not {observation_space}: use MlpPolicy or CnnPolicy."
            )
        extractors: dict[str, BaseFeaturesExtractor] = {}
        for key, space in observation_space.spaces.items():
            if is_image_space(space, normalized_image=normalized_image):
                extractors[key] = SpatialCnn(space, channels, normalized_image=normalized_image)
            else:
                extractors[key] = VectorExtractor(space, vector_features)
        shapes = {key: grid_shape(extractor) for key, extractor in extractors.items()}
        height, width = (max(shape[axis] for shape in shapes.values()) for axis in (1, 2))
        self.grid_shape: GridShape = (sum(shape[0] for shape in shapes.values()), height, width)
        super().__init__(observation_space, math.prod(self.grid_shape))
        self.extractors = nn.ModuleDict(extractors)
        self.shapes = shapes

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """
        Encode dictionaries.

        :param observations: preprocessed observations by key, of shapes (N, ...)
        :return: flattened grids, of shape (N, features_dim)
        """
        grids = []
        for key, extractor in self.extractors.items():
            grid = extractor(observations[key]).unflatten(1, self.shapes[key])
            grids.append(nn.functional.interpolate(grid, self.grid_shape[1:]))
        return th.cat(grids, dim=1).flatten(1)


def grid_shape(extractor: BaseFeaturesExtractor) -> GridShape:
    """
    Tell the grid that an extractor's flat features stand for.

    :param extractor: any SB3 features extractor
    :return: its own grid, or a single cell with all its features
    """
    return getattr(extractor, "grid_shape", (extractor.features_dim, 1, 1))
