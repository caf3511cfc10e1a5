"""Bad arguments are refused with their value and a remedy."""

from typing import Any


def require(valid: bool, name: str, value: Any, remedy: str) -> None:
    """
    Refuse an argument that makes no sense.

    :param valid: whether it does
    :param name: of the argument
    :param value: as it was given
    :param remedy: what to choose instead, the rest of the sentence "choose ..."
    :raises ValueError: if it is not valid
    """
    if not valid:
        raise ValueError(f"{name} is {value!r}; choose {remedy}.")
