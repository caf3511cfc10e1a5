"""Two jobs at the same time: small operations fill two cores better if each core has its own."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch as th

First = TypeVar("First")
Second = TypeVar("Second")


def side_by_side(first: Callable[[], First], second: Callable[[], Second], device: th.device) -> tuple[First, Second]:
    """
    Do two jobs that do not touch what the other writes, on half of torch's threads each.

    With a single thread, or on a device that has its own queue of work, they are done one after the other. Both ways give
    the same if at most one of them draws from torch's global generator.

    :param first: done by the calling thread
    :param second: done by another one
    :param device: where their tensors live
    :return: what they returned
    """
    threads = th.get_num_threads()
    if device.type != "cpu" or threads < 2:
        return first(), second()
    with torch_threads(threads // 2), ThreadPoolExecutor(1) as other:
        outcome = other.submit(second)
        return first(), outcome.result()


@contextmanager
def torch_threads(n: int) -> Iterator[None]:
    """
    Let torch compute with so many threads.

    :param n: of the calling thread's operations, and of those that start meanwhile
    """
    before = th.get_num_threads()
    th.set_num_threads(n)
    try:
        yield
    finally:
        th.set_num_threads(before)
