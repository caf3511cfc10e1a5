"""Files that are there as a whole or not at all, and saved models that are refused with a reason."""

import io
import json
import os
import pathlib
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

Target = str | pathlib.Path | io.BufferedIOBase


@contextmanager
def whole_file(path: Target, suffix: str = "") -> Iterator[Any]:
    """
    Write to a temporary file beside the wanted one, which it replaces once it is complete.

    :param path: where the file shall be, its folder is made; a file-like object is handed on as it is
    :param suffix: added to a path that has none, as SB3 does, with its dot
    :return: the ``Path`` to write to, whose suffix is that of the wanted file, or the file-like object
    """
    if not isinstance(path, str | pathlib.Path):
        yield path
        return
    wanted = with_suffix(path, suffix)
    wanted.parent.mkdir(parents=True, exist_ok=True)
    unfinished = wanted.with_name(f".{os.getpid()}.{wanted.name}")
    try:
        yield unfinished
        os.replace(unfinished, wanted)
    finally:
        unfinished.unlink(missing_ok=True)


def with_suffix(path: str | pathlib.Path, suffix: str) -> pathlib.Path:
    """
    Add a suffix to a path that has none.

    :param path: any path
    :param suffix: with its dot, or empty
    :return: the path as SB3 would write it
    """
    path = pathlib.Path(path)
    return path if path.suffix else pathlib.Path(f"{path}{suffix}")


@contextmanager
def saved_file(path: Target, algorithm: str) -> Iterator[tuple[Any, str]]:
    """
    Open a saved model.

    :param path: file or file-like object, at whose start it is left; SB3's ``.zip`` may be missing
    :param algorithm: name of the class that shall load it
    :return: the file at its start, and its name
    :raises ValueError: if it is missing
    """
    if not isinstance(path, str | pathlib.Path):
        path.seek(0)
        yield path, str(getattr(path, "name", "the given file object"))
        path.seek(0)
        return
    found = next((each for each in (pathlib.Path(path), pathlib.Path(f"{path}.zip")) if each.is_file()), None)
    if found is None:
        raise ValueError(f"There is no file {path}: give the zip that {algorithm}.save() has written.")
    with found.open("rb") as file:
        yield file, str(found)


def check_saved_model(path: Target, algorithm: str, marks: tuple[str, ...]) -> None:
    """
    Refuse a file that holds no model of an algorithm.

    :param path: file or file-like object, at whose start it is left; SB3's ``.zip`` may be missing
    :param algorithm: name of the class that shall load it
    :param marks: attributes that only models of this kind have all of
    :raises ValueError: if it is missing, no zip, damaged, no model of SB3, or one of another algorithm
    """
    with saved_file(path, algorithm) as (file, name):
        _check_archive(file, name, algorithm, marks)


def _check_archive(file: Any, name: str, algorithm: str, marks: tuple[str, ...]) -> None:
    remedy = f"give the zip that {algorithm}.save() has written."
    if file.read(2) != b"PK":
        raise ValueError(f"{name} is no zip file: {remedy}")
    file.seek(0)
    try:
        with zipfile.ZipFile(file) as archive:
            damaged = archive.testzip()
            complete = {"data", "policy.pth"} <= set(archive.namelist())
            data = json.loads(archive.read("data")) if damaged is None and complete else {}
    except (zipfile.BadZipFile, zlib.error, EOFError, OSError, RuntimeError, ValueError) as error:
        raise ValueError(f"{name} is cut off or damaged ({error}): save or copy it again.") from error
    if damaged is not None:
        raise ValueError(f"{name} is damaged at its member '{damaged}': save or copy it again.")
    if not complete:
        raise ValueError(f"{name} holds no model of Stable-Baselines3, or only a part of one: {remedy}")
    if any(mark not in data for mark in marks):
        raise ValueError(f"{name} holds no {algorithm} but {_describe(data)}: load it with the class that saved it.")


def _describe(data: Any) -> str:
    """Name the model by the module of its policy, which SB3 notes in plain text."""
    policy = data.get("policy_class") if isinstance(data, dict) else None
    return f"a model with a policy of {policy.get('__module__')}" if isinstance(policy, dict) else "another model"
