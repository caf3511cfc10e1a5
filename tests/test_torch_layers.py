"""Layers compute what torch's do."""

import pytest
import torch as th

from sb3_esad.common.torch_layers import SameConv2d


def differentiated(conv: th.nn.Conv2d, grid: th.Tensor) -> list[th.Tensor]:
    """Output, and its gradient in input, weight and bias."""
    inputs = [grid, conv.weight, conv.bias]
    output = conv(grid)
    return [output, *th.autograd.grad(output.square().sum(), inputs)]


@pytest.mark.parametrize("n_images", [0, 1, 5])
@pytest.mark.parametrize(("size", "kernel"), [(1, 1), (1, 3), (4, 1), (4, 3)])
def test_a_grid_is_convolved_as_torch_does(n_images: int, size: int, kernel: int) -> None:
    th.manual_seed(0)
    conv, reference = SameConv2d(3, 7, kernel), th.nn.Conv2d(3, 7, kernel, padding=kernel // 2)
    reference.load_state_dict(conv.state_dict())
    grid = th.randn(n_images, 3, size, size, requires_grad=True)
    assert conv(grid).shape == (n_images, 7, size, size)
    th.testing.assert_close(differentiated(conv, grid), differentiated(reference, grid))


def test_a_single_cell_is_not_convolved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(th.nn.Conv2d, "forward", None)
    assert SameConv2d(3, 7, 1)(th.randn(5, 3, 1, 1)).shape == (5, 7, 1, 1)
