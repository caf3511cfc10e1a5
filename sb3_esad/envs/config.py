"""Configurations are plain dictionaries whose keys are all known."""

import difflib
import math
from collections.abc import Callable, Sequence
from numbers import Integral, Real
from typing import Any, NamedTuple

import numpy as np

from sb3_esad.envs.lanes import CAR_LENGTH
from sb3_esad.envs.users import CAR_WIDTH

FRAMES = ("lane", "ego")
COMMON: dict[str, Any] = {
    "duration": 40.0,
    "policy_frequency": 5,
    "physics_frequency": 10,
    "target_speed": 25.0,
    "max_speed": 30.0,
    "max_acceleration": 3.0,
    "max_braking": 6.0,
    "max_wheel_angle": 0.5,
    "max_lateral_acceleration": 4.0,
    "vehicle_size": (CAR_LENGTH, CAR_WIDTH),
    "reward_weights": {"velocity": 0.7, "lane": 0.2, "orientation": 0.1, "exploration": 0.0},
    "velocity_sharpness": 0.2,
    "orientation_sharpness": 5.0,
    "lane_tolerance": 2.0,
    "exploration_decay": 0.1,
    "graded_cost": False,
    "graded_cost_ttc": 1.5,
    "image_shape": (64, 64),
    "metres_per_pixel": (1.25, 0.4),
    "ahead": 0.775,
    "frame": "lane",
    "neighbours": 8,
}
"""What all scenarios have in common, with units in SI."""


class Rule(NamedTuple):
    """
    What the values of some keys must be like.

    :param names: the keys, where a scenario has them
    :param holds: tells whether a value is
    :param remedy: the rest of a sentence that begins with "choose"
    """

    names: Sequence[str]
    holds: Callable[[Any], bool]
    remedy: str


def _is_finite(value: Any) -> bool:
    return isinstance(value, Real) and math.isfinite(value)


def _is_positive(value: Any) -> bool:
    return _is_finite(value) and value > 0


def _is_whole(value: Any, least: int) -> bool:
    return isinstance(value, Integral) and int(value) >= least


def _is_range(value: Any) -> bool:
    return np.shape(value) == (2,) and all(map(_is_finite, value)) and 0 <= value[0] <= value[1]


RULES = (
    Rule(
        """
            duration route_length target_speed max_speed max_acceleration max_braking max_wheel_angle
            max_lateral_acceleration lane_tolerance graded_cost_ttc merge_length departure walking_speed
        """.split(),
        _is_positive,
        "a number above 0",
    ),
    Rule(
        """
            velocity_sharpness orientation_sharpness exploration_decay traffic_behind traffic_ahead
            desired_speed_spread slowdown_speed slowdown_duration walking_caution
        """.split(),
        lambda value: _is_finite(value) and value >= 0,
        "a number from 0 on",
    ),
    Rule(
        "ahead slow_share fast_share slowdown_share cut_in_share cut_in_braking_share second_block_share".split(),
        lambda value: _is_finite(value) and 0 <= value <= 1,
        "a share from 0 to 1",
    ),
    Rule(
        """
            start_speed headway desired_speed slow_speed fast_speed merge_start slowdown_start event_pause
            event_braking halt_duration block_pause block_appears walking_pause
        """.split(),
        _is_range,
        "two numbers from 0 on, the smaller one first",
    ),
    Rule(
        "image_shape metres_per_pixel vehicle_size".split(),
        lambda value: np.shape(value) == (2,) and all(map(_is_positive, value)),
        "two numbers above 0, along the road and across it",
    ),
    Rule("physics_frequency policy_frequency".split(), lambda value: _is_whole(value, 1), "a whole number from 1 on"),
    Rule(
        "neighbours merging_cars cars_per_street cars people".split(),
        lambda value: _is_whole(value, 0),
        "a whole number from 0 on",
    ),
    Rule(
        ("lane_counts",),
        lambda value: np.ndim(value) == 1 and len(value) > 0 and all(_is_whole(lanes, 2) for lanes in value),
        "a sequence of whole numbers from 2 on",
    ),
    Rule(
        ("obstacles",),
        lambda value: _is_range(value) and all(_is_whole(number, 0) for number in value),
        "two whole numbers from 0 on, the smaller one first",
    ),
    Rule(("box_side",), lambda value: _is_range(value) and value[0] > 0, "two numbers above 0, the smaller one first"),
    Rule(("approach",), lambda value: _is_range(value) and value[1] <= 240, "two numbers from 0 to 240, ordered"),
    Rule(("course_length",), lambda value: _is_range(value) and value[0] >= 15, "two numbers from 15 on, ordered"),
    Rule(("hall_width",), lambda value: _is_finite(value) and value >= 4, "a number from 4 on"),
    Rule(("graded_cost",), lambda value: isinstance(value, bool | np.bool_), "True or False"),
    Rule(("reward_weights",), lambda value: all(map(_is_finite, value.values())), "finite weights"),
    Rule(("frame",), lambda value: value in FRAMES, f"one of {', '.join(FRAMES)}"),
    Rule(("spawn",), lambda value: value in ("random", "fixed"), "random or fixed"),
)


def merge_config(defaults: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """
    Override some keys of a configuration, also of the dictionaries in it.

    :param defaults: all known keys
    :param given: what to change
    :return: a new configuration
    :raises ValueError: at an unknown key, the message names the nearest known one; at a value in place of a dictionary
    """
    merged = dict(defaults)
    for key, value in given.items():
        if key not in defaults:
            near = difflib.get_close_matches(key, defaults, n=1, cutoff=0.0)[0]
            raise ValueError(f"unknown configuration key {key!r}; did you mean {near!r}?")
        if isinstance(defaults[key], dict):
            if not isinstance(value, dict):
                raise ValueError(f"{key} is {value!r}; give a dictionary with some of the keys {', '.join(defaults[key])}")
            value = merge_config(defaults[key], value)
        merged[key] = value
    return merged


def check_config(config: dict[str, Any]) -> None:
    """
    Refuse values with which no scenario can be driven.

    :param config: complete configuration
    :raises ValueError: at the first such value
    """
    for rule in RULES:
        for name in rule.names:
            if name in config and not rule.holds(config[name]):
                raise ValueError(f"{name} is {config[name]!r}; choose {rule.remedy}")
    start, fastest = config["start_speed"], config["max_speed"]
    if start[1] > fastest:
        raise ValueError(f"start_speed {start!r} goes beyond max_speed {fastest!r}; lower the one or raise the other")
    physics, policy = config["physics_frequency"], config["policy_frequency"]
    if physics % policy:
        raise ValueError(f"physics_frequency {physics} is no multiple of policy_frequency {policy}; choose one that is")
