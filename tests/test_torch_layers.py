"""Layers compute what torch's do."""

import pytest
import torch as th

from sb3_esad.common.torch_layers import same_conv


@pytest.mark.parametrize("n_images", [0, 1, 5])
@pytest.mark.parametrize(("size", "kernel"), [(1, 1), (1, 3), (4, 1), (4, 3)])
def test_a_grid_is_convolved_as_torch_does(n_images: int, size: int, kernel: int) -> None:
    th.manual_seed(0)
    conv, grid = same_conv(3, 7, kernel), th.randn(n_images, 3, size, size)
    expected = th.nn.functional.conv2d(grid, conv.weight, conv.bias, padding=kernel // 2)
    assert conv(grid).shape == (n_images, 7, size, size)
    th.testing.assert_close(conv(grid), expected)
