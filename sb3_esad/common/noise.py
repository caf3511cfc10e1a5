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
    # th.manual_seed would start the numbers of all devices anew, and note the stack of calls for each that is not there
    generator = default_generator(device)
    state = generator.get_state()
    generator.manual_seed(0)
    try:
        yield
    finally:
        generator.set_state(state)


def default_generator(device: th.device) -> th.Generator:
    """
    Give the random numbers that torch draws when it is told of none.

    :param device: where they are drawn, CPU or GPU
    :return: their generator
    """
    if device.type == "cuda":
        return th.cuda.default_generators[th.cuda.current_device() if device.index is None else device.index]
    return th.default_generator
