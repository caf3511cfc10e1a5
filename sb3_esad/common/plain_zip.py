"""Zips of unknown origin: members that are no larger than they look, and tensors with nothing else beside them."""

import io
import json
import pickletools
import reprlib
import zipfile
from collections import OrderedDict
from typing import Any

import torch as th

STORAGES = ("BFloat16", "Bool", "Byte", "Char", "Double", "Float", "Half", "Int", "Long", "Short")
PARTS_OF_TENSORS = {
    "collections OrderedDict",
    "torch._utils _rebuild_tensor_v2",
    *(f"torch {kind}Storage" for kind in STORAGES),
}
"""What a file of tensors may ask for. What torch itself allows includes functions that allocate whatever they are told to."""
PICKLE = "archive/data.pkl"
"""The part of a file of tensors that says what they are called and where their numbers are."""
SHARED = 4
"""How often a file may use the same numbers, as networks with a common features extractor do."""

shown = reprlib.Repr()
"""Shows in a few words on one line what a stranger has written."""
shown.maxstring = shown.maxother = 80


def refusal(reason: str, remedy: str = "pass trusted=True only if you trust whoever made it") -> ValueError:
    """
    Say why a zip is not loaded.

    :param reason: what is wrong about it
    :param remedy: what to do
    :return: the error to raise
    """
    return ValueError(f"{reason}; {remedy}.")


def read_members(content: bytes) -> dict[str, bytes]:
    """
    Read a zip that was written without compression, as SB3 and torch do.

    :param content: the zip
    :return: its members by name
    :raises ValueError: if it is damaged, if a member is compressed, too large or there twice
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            infos = archive.infolist()
            _check(infos, len(content))
            return {info.filename: archive.read(info) for info in infos}
    except (zipfile.BadZipFile, EOFError, OSError, RuntimeError) as error:
        raise refusal(f"it is cut off or damaged ({error})", "save or copy it again") from error


def _check(infos: list[zipfile.ZipInfo], size: int) -> None:
    names = set()
    for info in infos:
        if info.filename in names:
            raise refusal(f"it has two members {shown.repr(info.filename)}")
        if info.compress_type != zipfile.ZIP_STORED:
            raise refusal(f"its member {shown.repr(info.filename)} is compressed, which may hide how large it is")
        names.add(info.filename)
        size -= info.file_size
        if size < 0:  # members may also lie on top of each other
            raise refusal(f"its member {shown.repr(info.filename)} claims to be larger than the file")


def read_json(members: dict[str, bytes], name: str) -> dict[str, Any]:
    """
    Read a member of a zip as JSON.

    :param members: of the zip
    :param name: of the member
    :return: what it holds
    :raises ValueError: if it is missing or no JSON object
    """
    if name not in members:
        raise refusal(f"it has no member {name!r}, unlike what save() writes", "load it with the software that wrote it")
    try:
        content = json.loads(members[name])
    except (ValueError, RecursionError) as error:
        raise refusal(f"its member {name!r} is no JSON", "save or copy it again") from error
    if not isinstance(content, dict):
        raise refusal(f"its member {name!r} holds {shown.repr(content)} instead of a JSON object")
    return content


def read_tensors(content: bytes) -> Any:
    """
    Read what ``torch.save`` has written, if it is made of tensors, numbers, words, dictionaries and lists only.

    :param content: the file
    :return: the same, in new dictionaries and with tensors on the CPU that share nothing
    :raises ValueError: if it asks for anything else, or for more numbers than it holds
    """
    members = read_members(content)
    for opcode, argument, _ in pickletools.genops(members[PICKLE]):
        if opcode.name == "GLOBAL" and argument not in PARTS_OF_TENSORS:
            raise refusal(f"it asks for {shown.repr(argument)}, and nothing but tensors is read")
    # Written anew, for torch's reader might find other members in it than Python's
    checked = io.BytesIO()
    with zipfile.ZipFile(checked, "w") as archive:
        for name, member in members.items():
            if name in (PICKLE, "archive/version", "archive/byteorder") or name.startswith("archive/data/"):
                archive.writestr(name, member)
    checked.seek(0)
    return _Copier(SHARED * len(content))(th.load(checked, map_location="cpu", weights_only=True))


class _Copier:
    """
    Copies plain values and tensors, and refuses anything else.

    :param budget: bytes that the tensors may have together
    """

    def __init__(self, budget: int) -> None:
        self.left = budget

    def __call__(self, value: Any) -> Any:
        self._spend(1)
        if type(value) is th.Tensor:
            self._spend(value.numel() * value.element_size())
            # Whatever its strides were, the copy has a place of its own for each number, as torch's kernels rely on
            return value.detach().clone()
        if type(value) in (dict, OrderedDict):
            return {self(key): self(each) for key, each in value.items()}
        if type(value) in (list, tuple):
            return type(value)(self(each) for each in value)
        if value is None or type(value) in (bool, int, float, str):
            return value
        raise refusal(f"it holds a {type(value).__name__}, and nothing but tensors is read")

    def _spend(self, n: int) -> None:
        self.left -= n
        if self.left < 0:
            raise refusal("it makes more of its numbers than it holds")
