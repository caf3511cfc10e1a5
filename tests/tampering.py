"""Saved models, and what strangers may make of them."""

import base64
import io
import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cloudpickle
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from tests.conftest import TINY

Members = dict[str, bytes]
Tampering = Callable[[Members], Any]


def zipped(model: BaseAlgorithm, **kwargs: Any) -> bytes:
    file = io.BytesIO()
    model.save(file, **kwargs)
    return file.getvalue()


def unpack(content: bytes) -> Members:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def pack(members: Members, compression: int = zipfile.ZIP_STORED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    return file.getvalue()


class Bomb:
    """Leaves a trace when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> Any:
        return exec, (f"open({str(self.trace)!r}, 'w').close()",)


def data_with(**values: Any) -> Tampering:
    return lambda members: members.update(data=json.dumps({**json.loads(members["data"]), **values}).encode())


def pickled(value: Any) -> dict[str, str]:
    return {":type:": "harmless", ":serialized:": base64.b64encode(cloudpickle.dumps(value)).decode()}


def tamper(content: bytes, *tamperings: Tampering) -> bytes:
    members = unpack(content)
    for tampering in tamperings:
        tampering(members)
    return pack(members)


def torch_file(value: Any, **kwargs: Any) -> bytes:
    file = io.BytesIO()
    th.save(value, file, **kwargs)
    return file.getvalue()


def with_pickle(data: bytes, numbers: bytes = bytes(16)) -> bytes:
    """A file of tensors with a pickle of one's own."""
    return pack({**unpack(torch_file({"a": th.zeros(4)})), "archive/data.pkl": data, "archive/data/0": numbers})


def described(**values: Any) -> Tampering:
    def tampering(members: Members) -> None:
        members["sb3_esad.json"] = json.dumps({**json.loads(members["sb3_esad.json"]), **values}).encode()

    return tampering


def setting(name: str, plain: Any) -> Tampering:
    """A described setting that asks for something else."""

    def tampering(members: Members) -> None:
        others = json.loads(members["sb3_esad.json"])["settings"]
        described(settings={**others, name: plain})(members)

    return tampering


def policy_kwargs(**values: Any) -> Tampering:
    return data_with(policy_kwargs={**TINY["policy_kwargs"], **values})


def member(name: str, content: bytes) -> Tampering:
    return lambda members: members.update({name: content})


def without(name: str) -> Tampering:
    return lambda members: members.pop(name)


def calls(function: str, *arguments: Any) -> bytes:
    """A pickle that calls a function by its name."""
    module, name = function.rsplit(".", 1)
    given = b"".join(pickle.dumps(each, protocol=2)[2:-1] for each in arguments)
    return b"\x80\x02c" + f"{module}\n{name}\n".encode() + b"(" + given + b"tR."


def numbers_from(storage_size: int, offset: int, shape: tuple[int, ...], strides: tuple[int, ...]) -> bytes:
    """A pickle of a tensor as ``torch.save`` writes it, but of any size."""
    plain = [pickle.dumps(each, protocol=2)[2:-1] for each in (storage_size, offset, shape, strides)]
    size, place, height, step = (part.replace(b"q\x00", b"") for part in plain)
    tensor, storage = b"ctorch._utils\n_rebuild_tensor_v2\n((", b"X\x07\x00\x00\x00storagectorch\nFloatStorage\n"
    key, hooks = b"X\x01\x00\x00\x000X\x03\x00\x00\x00cpu", b"\x89ccollections\nOrderedDict\n)R"
    return b"\x80\x02" + tensor + storage + key + size + b"tQ" + place + height + step + hooks + b"tR."
