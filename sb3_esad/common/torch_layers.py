"""Building blocks of all networks: everything is a grid of cells, a vector is a grid of one cell."""

from collections.abc import Sequence

import torch as th
from torch import nn

GridShape = tuple[int, int, int]
"""Channels, height and width of a grid of features."""
FLAT_FEATURES = 512
"""How many numbers the cells of a grid may hold together before they are mixed."""


class LearningModule(nn.Module):
    """A network with an optimiser of its own."""

    optimizer: th.optim.Optimizer


class ChannelNorm(nn.LayerNorm):
    """Layer normalisation over the channels of each cell of a grid."""

    def forward(self, grid: th.Tensor) -> th.Tensor:
        """
        Normalise each cell.

        :param grid: features, of shape (N, C, H, W)
        :return: normalised features of the same shape
        """
        return super().forward(grid.movedim(1, -1)).movedim(-1, 1)


def kernel_size(shape: GridShape) -> int:
    """
    Give the width of a convolution that sees a cell's neighbours, where there are any.

    :param shape: shape of the grid
    :return: 3, or 1 for a grid of a single cell
    """
    return 3 if shape[1] * shape[2] > 1 else 1


class SameConv2d(nn.Conv2d):
    """
    Convolution that keeps height and width.

    :param in_channels: channels of the input
    :param out_channels: channels of the output
    :param kernel: odd width of the kernel
    :param bias: whether a bias is added
    """

    def __init__(self, in_channels: int, out_channels: int, kernel: int, bias: bool = True) -> None:
        super().__init__(in_channels, out_channels, kernel, padding=kernel // 2, bias=bias)

    def forward(self, grid: th.Tensor) -> th.Tensor:
        """
        Convolve.

        :param grid: features, of shape (N, in_channels, H, W)
        :return: features, of shape (N, out_channels, H, W)
        """
        if self.kernel_size == (1, 1) and grid.shape[2:] == (1, 1):
            # The memory of a vector is one cell, and a matrix product is faster than a convolution of it
            return nn.functional.linear(grid.flatten(1), self.weight.flatten(1), self.bias)[..., None, None]
        return super().forward(grid)


def conv_block(in_channels: int, out_channels: int, kernel: int) -> nn.Sequential:
    """
    Build convolution, normalisation and activation.

    :param in_channels: channels of the input
    :param out_channels: channels of the output
    :param kernel: odd width of the kernel
    :return: the block
    """
    return nn.Sequential(SameConv2d(in_channels, out_channels, kernel), ChannelNorm(out_channels), nn.SiLU())


def dense_block(input_dim: int, units: int) -> nn.Sequential:
    """
    Build linear layer, normalisation and activation.

    :param input_dim: number of inputs
    :param units: number of outputs
    :return: the block
    """
    return nn.Sequential(nn.Linear(input_dim, units), nn.LayerNorm(units), nn.SiLU())


def mlp(input_dim: int, net_arch: Sequence[int], output_dim: int, zero_output: bool = False) -> nn.Sequential:
    """
    Build a perceptron with normalised hidden layers.

    :param input_dim: number of inputs
    :param net_arch: units of each hidden layer
    :param output_dim: number of outputs
    :param zero_output: start with an output of zero, as heads that predict values do
    :return: the network
    """
    layers: list[nn.Module] = []
    for units in net_arch:
        layers += dense_block(input_dim, units)
        input_dim = units
    output = nn.Linear(input_dim, output_dim)
    if zero_output:
        nn.init.zeros_(output.weight)
        nn.init.zeros_(output.bias)
    return nn.Sequential(*layers, output)


class Readout(nn.Module):
    """A network that summarises what it is shown in one vector of ``features_dim`` numbers."""

    features_dim: int


class GridReadout(Readout):
    """
    Summarise a grid in one vector without losing what stands where.

    :param shape: shape of the grid (C, H, W)
    :param features_dim: length of the summary
    """

    def __init__(self, shape: GridShape, features_dim: int) -> None:
        super().__init__()
        channels, height, width = shape
        cell_features = max(1, min(channels, FLAT_FEATURES // (height * width)))
        self.features_dim = features_dim
        self.cells = nn.Sequential(SameConv2d(channels, cell_features, 1), nn.SiLU())
        self.mix = nn.Sequential(
            nn.Flatten(), nn.Linear(cell_features * height * width, features_dim), nn.LayerNorm(features_dim), nn.SiLU()
        )

    def forward(self, grid: th.Tensor) -> th.Tensor:
        """
        Summarise grids.

        :param grid: features, of shape (N, C, H, W)
        :return: summaries, of shape (N, features_dim)
        """
        return self.mix(self.cells(grid))

    def price(self) -> th.Tensor:
        """
        Price of looking at the cells.

        :return: 0
        """
        return next(self.parameters()).new_zeros(())


class SparseReadout(GridReadout):
    """
    Summarise those few cells of a grid that matter.

    Dozens of rare events differ in whatever stands anywhere: a readout that is free to look everywhere learns them by heart
    (docs/experiments.md, section 10). Here each cell has its price: the norm of the weights that look at it (group lasso, Yuan
    & Lin 2006), so that a cell which does not tell the events apart is left out.

    :param shape: shape of the grid (C, H, W)
    :param features_dim: length of the summary
    """

    def __init__(self, shape: GridShape, features_dim: int) -> None:
        super().__init__(shape, features_dim)
        flatten, linear, _, activation = self.mix
        self.cells[1] = ChannelNorm(self.cells[0].out_channels)
        # Not normalised once it is mixed, for that would give back what small weights take away
        self.mix = nn.Sequential(flatten, linear, activation)
        self.n_cells = shape[1] * shape[2]

    def price(self) -> th.Tensor:
        """
        Add up the prices of the cells.

        :return: scalar
        """
        weight, _ = self.mix.parameters()
        return th.linalg.vector_norm(weight.unflatten(1, (-1, self.n_cells)), dim=(0, 1)).sum()


def join(tensors: Sequence[th.Tensor]) -> th.Tensor:
    """
    Stack along a new first dimension, keeping channels last in memory, which ``th.stack`` would not.

    :param tensors: of shape (N, ...)
    :return: shape (len(tensors), N, ...)
    """
    return th.cat(list(tensors)).unflatten(0, (len(tensors), -1))
