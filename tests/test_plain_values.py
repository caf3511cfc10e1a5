"""What is described in JSON comes back as it was, and nothing else can be made of a description."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule

from sb3_esad.common.plain_values import LARGEST_SPACE, from_plain, to_plain
from sb3_esad.common.schedules import HoldThenFall

SHAPES = st.lists(st.integers(1, 4), min_size=1, max_size=3).map(tuple)


@st.composite
def boxes(draw: st.DrawFn) -> spaces.Box:
    shape, dtype = draw(SHAPES), draw(st.sampled_from(["float32", "float64", "uint8", "int64"]))
    if dtype.startswith("float"):
        ends = st.one_of(st.floats(-1e6, 1e6, width=32), st.sampled_from([-np.inf, np.inf]))
    else:
        ends = st.integers(0, 255)
    one = draw(st.booleans())  # value for all
    pairs = [sorted(draw(st.tuples(ends, ends))) for _ in range(1 if one else int(np.prod(shape)))]
    low, high = (np.broadcast_to(np.array(end, dtype), np.prod(shape)).reshape(shape) for end in zip(*pairs, strict=True))
    return spaces.Box(low.copy(), high.copy(), dtype=getattr(np, dtype))


SINGLE_SPACES = st.one_of(
    boxes(),
    st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(1, 10**6), st.integers(-5, 5)),
    st.builds(spaces.MultiDiscrete, st.lists(st.integers(1, 9), min_size=1, max_size=4)),
    st.builds(spaces.MultiBinary, st.integers(1, 9) | st.lists(st.integers(1, 4), min_size=2, max_size=2)),
)
SPACES = SINGLE_SPACES | st.dictionaries(st.text(min_size=1, max_size=5), SINGLE_SPACES, min_size=1, max_size=4).map(
    spaces.Dict
)


def through_json(value: Any) -> Any:
    """Describe a value, and make it anew of JSON as the standard has it, without infinite numbers."""
    return from_plain(json.loads(json.dumps(to_plain(value), allow_nan=False)))


@given(SPACES)
@settings(max_examples=150, deadline=None)
def test_spaces(space: spaces.Space) -> None:
    again = through_json(space)
    assert again == space and type(again) is type(space)
    assert again.dtype == space.dtype and again.shape == space.shape
    if isinstance(space, spaces.Dict):
        assert list(again.spaces) == list(space.spaces), "extractors take them in this order"
    if isinstance(space, spaces.Box):
        np.testing.assert_array_equal(again.low, space.low)
        np.testing.assert_array_equal(again.high, space.high)


def test_spaces_that_are_not_as_usual() -> None:
    unsorted = spaces.Dict([("b", spaces.Discrete(2)), ("a", spaces.MultiDiscrete([[2, 3], [4, 5]], start=[[1, 1], [0, 0]]))])
    assert through_json(unsorted) == unsorted and list(through_json(unsorted).spaces) == ["b", "a"]
    assert through_json(type("Mine", (spaces.Box,), {})(0, 1, (2,))) == spaces.Box(0, 1, (2,))


def test_a_described_image_is_short() -> None:
    assert len(json.dumps(to_plain(spaces.Box(0, 255, (3, 64, 64), np.uint8)))) < 100


@pytest.mark.parametrize(
    "schedule", [HoldThenFall(0.006, 0.5), LinearSchedule(0.1, 0.01, 0.5), ConstantSchedule(0.2), HoldThenFall(1, 0)]
)
def test_schedules(schedule: Callable[[float], float]) -> None:
    again = through_json(schedule)
    assert type(again) is type(schedule) and vars(again) == vars(schedule)


def test_falling_rate_of_rl_zoo() -> None:
    class SimpleLinearSchedule:
        initial_value = 0.006

    again = through_json(SimpleLinearSchedule())
    assert [again(remaining) for remaining in (1.0, 0.5, 0.0)] == pytest.approx([0.006, 0.003, 0.0])


def test_numbers_and_frequencies() -> None:
    assert through_json(TrainFreq(3, TrainFrequencyUnit.EPISODE)) == (3, "episode")
    assert (through_json(np.float64(0.1)), through_json(np.int32(7))) == (0.1, 7)


@pytest.mark.parametrize("value", [object(), lambda x: x, {1, 2}, type("Mine", (HoldThenFall,), {})(0.1, 0.5), spaces.Text(5)])
def test_what_has_no_plain_form(value: Any) -> None:
    with pytest.raises(TypeError, match="has no plain form"):
        to_plain(value)


BOX = {"low": 0, "high": 1, "shape": [2], "dtype": "float32"}


@pytest.mark.parametrize(
    "plain",
    [
        {},
        {"exec": {"source": "print()"}},
        {"builtins.exec": ["print()"]},
        {"Box": {**BOX, "shape": [10**6, 10**6]}},
        {"Box": {**BOX, "shape": [LARGEST_SPACE + 1]}},
        {"Box": {**BOX, "shape": [-5]}},
        {"Box": {**BOX, "dtype": "O"}},
        {"Box": {**BOX, "dtype": "<U100000000"}},
        {"Box": {**BOX, "dtype": "f4,f4"}},
        {"Box": {**BOX, "low": [0, 0, 0]}},
        {"Box": {**BOX, "low": "nan"}},
        {"Box": {**BOX, "low": 2}},
        {"Dict": {"a": {"Text": {}}}},
        {"Dict": {"a": {"Dict": {}}}},
        {"Dict": {str(i): {"Box": {**BOX, "shape": [LARGEST_SPACE // 2]}} for i in range(1000)}},
        {"Discrete": {"n": -1, "start": 0, "dtype": "int64"}},
        {"HoldThenFall": {"start": 1, "hold": 2}},
        {"HoldThenFall": {"start": 1, "hold": 0.5, "extra": 1}},
    ],
    ids=str,
)
def test_descriptions_that_are_none(plain: Any) -> None:
    with pytest.raises((ValueError, TypeError, AssertionError)):
        from_plain(plain)
