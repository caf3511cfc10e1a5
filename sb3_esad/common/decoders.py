"""What a latent state looks like: reconstructions of images and vectors, and how wrong they are."""

import math
from abc import ABC, abstractmethod

import torch as th
from torch import nn

from sb3_esad.common.torch_layers import GridReadout, GridShape, conv_block
from sb3_esad.common.transforms import symexp, symlog

CHANNELS_OF_ONE_CELL = 32
"""Channels of each part of a picture, where a single cell remembers all of it."""
FOREGROUND_CONTRAST = 0.1
MEDIAN_SAMPLE = 32
MEDIAN_RATE = 0.02


class ObservationHead(nn.Module, ABC):
    """Reconstruction of one observation."""

    @abstractmethod
    def forward(self, grid: th.Tensor) -> th.Tensor:
        """
        Reconstruct.

        :param grid: latent states, of shape (N, C, H, W)
        :return: preprocessed observations, of shape (N, ...)
        """

    @abstractmethod
    def loss(self, grid: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """
        Measure how wrong the reconstruction is.

        :param grid: latent states, of shape (N, C, H, W)
        :param observations: preprocessed, of shape (N, ...)
        :return: scalar
        """


class ImageHead(ObservationHead):
    """
    Reconstruct an image, with more weight on what is rare.

    In each channel the pixels that differ from its median weigh as much together as those that do not, within bounds. A median
    of each pixel would be no background here: the agent's own car always stands in the same place.

    Squared errors are taken on patches of 4x4 pixels, as the network puts them out: to sort the pixels of a batch costs more
    than a layer.

    :param grid_shape: shape of the latent grid (C, H, W), one cell for 8x8 pixels
    :param image_shape: shape of the image (C, H, W)
    :param foreground_weight: largest additional weight of a pixel that differs from its channel's median by more than 0.1
    :param channels: channels of the hidden layers
    """

    background: th.Tensor

    def __init__(
        self, grid_shape: GridShape, image_shape: tuple[int, ...], foreground_weight: float, channels: int = 32
    ) -> None:
        super().__init__()
        self.image_shape = image_shape
        self.foreground_weight = foreground_weight
        self.cells = (math.ceil(image_shape[1] / 8), math.ceil(image_shape[2] / 8))
        self.spread, grid_channels = _spread(grid_shape, self.cells)
        self.layers = nn.Sequential(
            conv_block(grid_channels, 4 * channels, 1), nn.PixelShuffle(2), conv_block(channels, channels, 3)
        )
        self.pixels = nn.Linear(channels, 16 * image_shape[0])
        self.register_buffer("background", th.zeros(image_shape[0], 1))

    def forward(self, grid: th.Tensor) -> th.Tensor:
        """
        Reconstruct images.

        :param grid: latent states, of shape (N, C, H, W)
        :return: images scaled as SB3's preprocessing leaves them, of shape (N, *image_shape)
        """
        _, height, width = self.image_shape
        return nn.functional.pixel_shuffle(self._patches(grid).movedim(-1, 1), 4)[..., :height, :width]

    def loss(self, grid: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """
        Sum the weighted squared error over pixels, average it over the batch.

        :param grid: latent states, of shape (N, C, H, W)
        :param observations: preprocessed images, of shape (N, *image_shape)
        :return: scalar
        """
        _, height, width = self.image_shape
        padded = nn.functional.pad(observations, (0, -width % 8, 0, -height % 8))
        patches = nn.functional.pixel_unshuffle(padded, 4).movedim(1, -1).contiguous()
        pixels = patches.unflatten(-1, (-1, 16))
        weights = self._weights(pixels)
        error = self._patches(grid).unflatten(-1, (-1, 16)) - pixels
        return (weights * error.square()).sum(dtype=th.float32) / len(observations)

    @th.no_grad()
    def _weights(self, pixels: th.Tensor) -> th.Tensor:
        """Weights of pixels, both of shape (N, rows, columns, channels, 16)."""
        # The median's fixed point has as many values above as below: no memory of past images is needed
        sample = pixels[:: math.ceil(len(pixels) / MEDIAN_SAMPLE)]
        self.background += MEDIAN_RATE * (sample - self.background).sign().mean((0, 1, 2, 4))[:, None]
        foreground = ((pixels - self.background.to(pixels.dtype)).abs() > FOREGROUND_CONTRAST).to(pixels.dtype)
        share = foreground.mean((0, 1, 2, 4), dtype=th.float32)
        balance = ((1 - share) / share).clamp(1, 1 + self.foreground_weight)
        return 1 + (balance - 1).to(pixels.dtype)[:, None] * foreground

    def _patches(self, grid: th.Tensor) -> th.Tensor:
        """Patches of 4x4 pixels, of shape (N, rows, columns, 16 * channels)."""
        return self.pixels(self.layers(self.spread(grid)).movedim(1, -1))


def _spread(grid_shape: GridShape, cells: tuple[int, int]) -> tuple[nn.Module, int]:
    """Layer from a grid to the cells of a picture, and the channels that it gives."""
    channels, height, width = grid_shape
    if (height, width) == cells:
        return nn.Identity(), channels
    if height * width > 1:
        return nn.Upsample(cells), channels
    # A single cell knows the whole picture, and copies of it would all draw the same
    wanted = (CHANNELS_OF_ONE_CELL, *cells)
    return nn.Sequential(nn.Flatten(), nn.Linear(channels, math.prod(wanted)), nn.Unflatten(1, wanted)), wanted[0]


class VectorHead(ObservationHead):
    """
    Reconstruct a standardised vector as its symmetric logarithm.

    :param grid_shape: shape of the latent grid (C, H, W)
    :param size: length of the vector
    :param weight: of the squared errors
    :param units: units of the hidden layer
    """

    def __init__(self, grid_shape: GridShape, size: int, weight: float = 1.0, units: int = 256) -> None:
        super().__init__()
        self.weight = weight
        self.layers = nn.Sequential(GridReadout(grid_shape, units), nn.Linear(units, size))

    def forward(self, grid: th.Tensor) -> th.Tensor:
        """
        Reconstruct vectors.

        :param grid: latent states, of shape (N, C, H, W)
        :return: standardised vectors, of shape (N, size)
        """
        return symexp(self.layers(grid))

    def loss(self, grid: th.Tensor, observations: th.Tensor) -> th.Tensor:
        """
        Sum the weighted squared error over entries, average it over the batch.

        :param grid: latent states, of shape (N, C, H, W)
        :param observations: standardised, of shape (N, ...)
        :return: scalar
        """
        return self.weight * (self.layers(grid).float() - symlog(observations.flatten(1))).square().sum(1).mean()
