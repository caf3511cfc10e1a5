"""Averages of networks over their own learning: slower, and steadier."""

from copy import deepcopy
from typing import TypeVar

from stable_baselines3.common.utils import polyak_update
from torch import nn

Module = TypeVar("Module", bound=nn.Module)


def make_target(network: Module) -> Module:
    """
    Copy a network as the moving average of its own learning.

    :param network: the network that learns
    :return: a copy without gradients, in evaluation mode
    """
    return deepcopy(network).requires_grad_(False).eval()


def update_target(network: nn.Module, target: nn.Module, tau: float) -> None:
    """
    Let an average follow the network that learns.

    :param network: the network that learns
    :param target: its average
    :param tau: share of the network in its average, in (0, 1]
    """
    polyak_update(network.parameters(), target.parameters(), tau)
    for buffer, copy in zip(network.buffers(), target.buffers(), strict=True):
        copy.copy_(buffer)
