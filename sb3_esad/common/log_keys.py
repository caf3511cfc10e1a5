"""Groups of what is logged; docs/watching.md explains every key."""

from typing import TypeVar

Value = TypeVar("Value")


def grouped(group: str, logs: dict[str, Value]) -> dict[str, Value]:
    """
    Put values into a group.

    :param group: such as ``"world_model"``
    :param logs: values by their names
    :return: the same by keys such as ``"world_model/kl"``
    """
    return {f"{group}/{name}": value for name, value in logs.items()}


def key_of(name: str) -> str:
    """
    Complete a key: what names no group belongs to what SB3's users look for under ``train/``.

    :param name: with or without a group
    :return: the key for the logger
    """
    return name if "/" in name else f"train/{name}"
