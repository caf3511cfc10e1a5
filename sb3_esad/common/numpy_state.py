"""The memory of a policy as ``predict`` hands it out: a tuple of arrays, as those of SB3's recurrent policies."""

import numpy as np
import torch as th

from sb3_esad.common.type_aliases import LatentState

NumpyState = tuple[np.ndarray, ...]


def to_numpy(state: LatentState) -> NumpyState:
    """
    Hand a memory out.

    :param state: N states and the actions executed in them
    :return: arrays of shape (1, N, size)
    """
    return tuple(field.flatten(1)[None].cpu().numpy() for field in state)


def from_numpy(arrays: NumpyState | None, initial: LatentState) -> LatentState:
    """
    Take a memory back.

    :param arrays: what :func:`to_numpy` made; None where episodes start
    :param initial: the memory that N episodes start with
    :return: fields of the shapes of ``initial``
    :raises ValueError: if the arrays are not those of N memories
    """
    if arrays is None:
        return initial
    n_envs = len(initial.memory)
    shapes = [tuple(np.shape(array)) for array in arrays]
    if shapes != [(1, n_envs, field[0].numel()) for field in initial]:
        remedy = "pass what the last call returned for these environments, or None to start afresh"
        raise ValueError(f"predict() was given {n_envs} observation(s) with a state of shapes {shapes}: {remedy}.")
    fields = (th.as_tensor(array[0]).to(zeros) for array, zeros in zip(arrays, initial, strict=True))
    return LatentState(*(field.view_as(zeros) for field, zeros in zip(fields, initial, strict=True)))
