"""Random numbers that are the same each time."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th


@contextmanager
def fixed_seed(device: th.device) -> Iterator[None]:
    """
    Draw the same random numbers in every such block, and leave those outside as they would be without it.

    :param device: where they are drawn
    """
    with th.random.fork_rng([device] if device.type == "cuda" else []):
        th.manual_seed(0)
        yield
