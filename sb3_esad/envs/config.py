"""Configurations are plain dictionaries whose keys are all known."""

import difflib
from typing import Any


def merge_config(defaults: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """
    Override some keys of a configuration, also of the dictionaries in it.

    :param defaults: all known keys
    :param given: what to change
    :return: a new configuration
    :raises ValueError: at an unknown key; the message names the nearest known one
    """
    merged = dict(defaults)
    for key, value in given.items():
        if key not in defaults:
            near = difflib.get_close_matches(key, defaults, n=1, cutoff=0.0)[0]
            raise ValueError(f"unknown configuration key {key!r}; did you mean {near!r}?")
        merged[key] = merge_config(defaults[key], value) if isinstance(defaults[key], dict) else value
    return merged
