"""Spaces, schedules and numbers as JSON, so that they can be read back without running code."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.type_aliases import TrainFreq
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule

from sb3_esad.common.checks import require
from sb3_esad.common.schedules import HoldThenFall

LARGEST_SPACE = 2**22
"""Numbers in an observation; an image of 2048x2048 pixels has as many."""


class Form(NamedTuple):
    """
    How values of one kind are described in JSON.

    :param describe: gives the arguments of a value
    :param build: makes a value of them
    """

    describe: Callable[[Any], dict[str, Any]]
    build: Callable[..., Any]


def to_plain(value: Any) -> Any:
    """
    Describe a value in JSON, as ``{kind: arguments}``.

    :param value: a space, a schedule, a ``TrainFreq`` or a NumPy scalar, which becomes a number
    :return: the description
    :raises TypeError: if there is none
    """
    if isinstance(value, np.generic):
        return value.item()
    if type(value).__name__ == "SimpleLinearSchedule":  # of RL Zoo, for lin_x
        value = LinearSchedule(value.initial_value, end=0.0, end_fraction=1.0)
    for kind, form in FORMS.items():
        # A space of a subclass is compared by what it holds, a schedule of a subclass would go another way
        if type(value) is kind or (issubclass(kind, spaces.Space) and isinstance(value, kind)):
            return {kind.__name__: form.describe(value)}
    raise TypeError(f"A {type(value).__name__} has no plain form.")


def from_plain(plain: Any) -> Any:
    """
    Make what :func:`to_plain` has described.

    :param plain: a description by anyone
    :return: the value; a tuple for a ``TrainFreq``, as it is given to a constructor
    :raises ValueError: if it is of no known kind
    """
    if not isinstance(plain, dict):
        return plain
    forms = {kind.__name__: form for kind, form in FORMS.items()}
    kind, arguments = next(iter(plain.items()), ("nothing", {}))
    require(kind in forms, "The kind of a saved value", kind, f"one of {', '.join(forms)}")
    return forms[kind].build(**arguments)


def _dtype(name: str) -> Any:
    kind = np.dtype(name)
    require(kind.kind in "biuf", "The dtype of a space", name, "one of numbers")
    return kind.type


def _describe_box(box: spaces.Box) -> dict[str, Any]:
    return {"low": _bound(box.low), "high": _bound(box.high), "shape": list(box.shape), "dtype": box.dtype.name}


def _bound(bound: np.ndarray) -> Any:
    """Bound of a box, a single number if it is the same everywhere; words where it is infinite, which JSON cannot express."""
    finite = bound if np.isfinite(bound).all() else bound.astype(str)
    return finite.flat[0].item() if (bound == bound.flat[0]).all() else finite.tolist()


def _build_box(low: Any, high: Any, shape: list[int], dtype: str) -> spaces.Box:
    _check_size(math.prod(shape))
    low, high = (np.full(shape, np.asarray(bound, dtype=_dtype(dtype))) for bound in (low, high))
    return spaces.Box(low, high, dtype=_dtype(dtype))


def _check_size(size: int) -> None:
    require(0 <= size <= LARGEST_SPACE, "The size of a space", size, f"one of at most {LARGEST_SPACE} numbers")


def _build_discrete(n: int, start: int, dtype: str) -> spaces.Discrete:
    unusual = {} if dtype == "int64" else {"dtype": _dtype(dtype)}  # no argument in former versions of gymnasium
    return spaces.Discrete(n, start=start, **unusual)


def _build_multi_discrete(nvec: list[Any], start: list[Any], dtype: str) -> spaces.MultiDiscrete:
    return spaces.MultiDiscrete(np.asarray(nvec), dtype=_dtype(dtype), start=np.asarray(start))


def _describe_schedule(schedule: Any) -> dict[str, float]:
    return {name: float(value) for name, value in vars(schedule).items()}


def _build_dict(**parts: Any) -> spaces.Dict:
    built, size = [], 0
    for key, part in parts.items():
        space = from_plain(part)
        size += math.prod(space.shape)
        _check_size(size)
        built.append((key, space))
    return spaces.Dict(built)  # in this order, which a dictionary would not keep


FORMS: dict[type, Form] = {
    spaces.Box: Form(_describe_box, _build_box),
    spaces.Discrete: Form(
        lambda space: {"n": int(space.n), "start": int(space.start), "dtype": space.dtype.name}, _build_discrete
    ),
    spaces.MultiDiscrete: Form(
        lambda space: {"nvec": space.nvec.tolist(), "start": space.start.tolist(), "dtype": space.dtype.name},
        _build_multi_discrete,
    ),
    spaces.MultiBinary: Form(lambda space: {"n": np.asarray(space.n).tolist()}, spaces.MultiBinary),
    spaces.Dict: Form(lambda space: {key: to_plain(part) for key, part in space.spaces.items()}, _build_dict),
    HoldThenFall: Form(_describe_schedule, HoldThenFall),
    LinearSchedule: Form(_describe_schedule, LinearSchedule),
    ConstantSchedule: Form(_describe_schedule, ConstantSchedule),
    TrainFreq: Form(
        lambda train_freq: {"frequency": train_freq.frequency, "unit": train_freq.unit.value},
        lambda frequency, unit: (frequency, unit),
    ),
}
"""What can be described, by its class."""
