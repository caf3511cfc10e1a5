"""Configurations are plain dictionaries whose keys are all known."""

import difflib
import math
from numbers import Integral, Real
from typing import Any

import numpy as np

POSITIVE = {
    *("duration", "route_length", "target_speed", "max_speed", "max_acceleration", "max_braking"),
    *("max_wheel_angle", "max_lateral_acceleration", "lane_tolerance", "graded_cost_ttc"),
}
POSITIVE_PAIRS = {"image_shape", "metres_per_pixel"}


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
    physics, policy = config["physics_frequency"], config["policy_frequency"]
    for name, frequency in (("physics_frequency", physics), ("policy_frequency", policy)):
        if not isinstance(frequency, Integral) or frequency < 1:
            raise ValueError(f"{name} is {frequency!r}; choose a whole number from 1 on")
    if physics % policy:
        raise ValueError(f"physics_frequency {physics} is no multiple of policy_frequency {policy}; choose one that is")
    for name in sorted(POSITIVE & config.keys()):
        if not _is_positive(config[name]):
            raise ValueError(f"{name} is {config[name]!r}; choose a number above 0")
    for name in sorted(POSITIVE_PAIRS & config.keys()):
        pair = config[name]
        if np.shape(pair) != (2,) or not all(map(_is_positive, pair)):
            raise ValueError(f"{name} is {pair!r}; choose two numbers above 0, along the road and across it")


def _is_positive(value: Any) -> bool:
    return isinstance(value, Real) and 0 < float(value) < math.inf
