"""Configurations are plain dictionaries whose keys are all known."""

import difflib
from typing import Any


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
