"""Files of tensors: they come back as they were, and nothing else comes with them."""

import pickle
import pickletools
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_esad.common.plain_zip import SHARED, read_tensors
from tests.conftest import assert_same
from tests.tampering import Bomb, calls, numbers_from, pack, torch_file, unpack, with_pickle

pytestmark = pytest.mark.usefixtures("nothing_else_happens")


def own_storages(value: Any) -> int:
    """Bytes of all tensors, each of which must have a storage of its own without gaps; nothing else may be there."""
    if isinstance(value, th.Tensor):
        assert type(value) is th.Tensor and value.layout is th.strided and value.grad_fn is None and not value._backward_hooks
        assert value.untyped_storage().nbytes() == value.numel() * value.element_size()
        return value.untyped_storage().nbytes()
    if isinstance(value, dict):
        assert type(value) is dict
        return sum(own_storages(each) for pair in value.items() for each in pair)
    if isinstance(value, list | tuple):
        return sum(map(own_storages, value))
    assert value is None or type(value) in (bool, int, float, str)
    return 0


def test_tensors_come_back_as_they_were() -> None:
    image = th.rand(2, 3, 4, 5).to(memory_format=th.channels_last)
    state = OrderedDict(
        a=th.rand(3, dtype=th.float64),
        b=[image, th.tensor(5), 1.5],
        c=(None, True, "x"),
        d=th.rand(4, 4)[1:, ::2],
        e={0: th.ones(())},
    )
    read = read_tensors(torch_file(state))
    assert_same(read, dict(state))
    own_storages(read)
    assert read["b"][0].is_contiguous(memory_format=th.channels_last)


def test_strides_are_not_trusted() -> None:
    """Kernels that write as many numbers as the shape has must find as many places."""
    once = th.zeros(10)[9:].expand(3)
    read = read_tensors(torch_file({"a": once}))
    assert read["a"].stride() == (1,) and own_storages(read) == 12


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def doubled(depth: int) -> list[Any]:
    value: list[Any] = [1]
    for _ in range(depth):
        value = [value, value]
    return value


FILES: dict[str, Callable[[], bytes]] = {
    "a view of one number": lambda: torch_file({"a": th.zeros(1).expand(10**6, 10**6)}),
    "views of many numbers": lambda: torch_file([th.zeros(10**4)] * 10**4),
    "a storage larger than its record": lambda: with_pickle(numbers_from(10**6, 0, (4,), (1,))),
    "a tensor larger than its storage": lambda: with_pickle(numbers_from(4, 0, (10**6,), (1,))),
    "a tensor beyond its storage": lambda: with_pickle(numbers_from(4, 3, (4,), (1,))),
    "a tensor before its storage": lambda: with_pickle(numbers_from(4, -3, (4,), (1,))),
    "strides backwards": lambda: with_pickle(numbers_from(4, 3, (4,), (-1,))),
    "a negative shape": lambda: with_pickle(numbers_from(4, 0, (-4,), (1,))),
    "a shape beyond any number": lambda: with_pickle(numbers_from(4, 0, (2**62, 2**62), (0, 0))),
    "a sparse tensor": lambda: torch_file(th.zeros(3).to_sparse()),
    "a meta tensor": lambda: torch_file(th.zeros(10**9, device="meta")),
    "a parameter": lambda: torch_file(th.nn.Parameter(th.zeros(2))),
    "a complex tensor": lambda: torch_file(th.zeros(2, dtype=th.complex64)),
    "an array": lambda: torch_file({"a": np.zeros(3)}),
    "a module": lambda: torch_file(th.nn.Linear(1, 1)),
    "bytes": lambda: torch_file({"a": b"abc"}),
    "a set": lambda: torch_file({1, 2}),
    "many bytes": lambda: with_pickle(calls("builtins.bytearray", 10**12)),
    "many numbers": lambda: with_pickle(calls("torch.FloatTensor", 10**11)),
    "a codec": lambda: with_pickle(calls("_codecs.encode", "x", "rot13")),
    "an import": lambda: with_pickle(calls("importlib.import_module", "this")),
    "an attribute": lambda: with_pickle(calls("torch._tensor._rebuild_from_type_v2", 1, 2, 3, 4)),
    "a shell": lambda: with_pickle(calls("os.system", "true")),
    "the same under its former name": lambda: with_pickle(calls("__builtin__.eval", "1")),
    "deep lists": lambda: torch_file(nested(400)),
    "lists that double": lambda: torch_file(doubled(60)),
    "a list in itself": lambda: with_pickle(b"\x80\x02]q\x00h\x00a."),
    "no pickle": lambda: pack({"archive/version": b"3"}),
    "a pickle in capital letters": lambda: pack({"archive/version": b"3", "archive/DATA.PKL": pickle.dumps(1, protocol=2)}),
}


@pytest.mark.parametrize("name", FILES)
def test_files_of_anything_but_tensors(name: str) -> None:
    content = FILES[name]()
    with pytest.raises(Exception):  # noqa: B017  # which becomes a sentence where the model is loaded
        read_tensors(content)


def test_a_pickle_as_it_should_be() -> None:
    """Otherwise those above might be refused for another reason."""
    assert own_storages(read_tensors(with_pickle(numbers_from(4, 0, (2, 2), (2, 1))))) == 16


def test_torch_sees_no_more_than_was_checked() -> None:
    """A script would be run by another reader; case does not matter to torch's."""
    surplus = {"archive/constants.pkl": b".", "archive/DATA.PKL": pickle.dumps(1, protocol=2), "archive/code/a.py": b"1/0"}
    assert read_tensors(pack({**surplus, **unpack(torch_file({"a": 1})), **surplus})) == {"a": 1}


def operations(pickle_: bytes) -> list[bytes]:
    """The operations that a pickle consists of."""
    starts = [start for _, _, start in pickletools.genops(pickle_) if start is not None]
    return [pickle_[start:end] for start, end in zip(starts, [*starts[1:], len(pickle_)], strict=True)]


@given(st.data())
@settings(max_examples=250, deadline=None)
def test_any_pickle(trace: Path, data: st.DataObject) -> None:
    """Of operations of a real one, of one with a bomb, and of any others."""
    real = operations(unpack(torch_file(OrderedDict(a=th.zeros(4), b=[1, (2.5, "x")])))["archive/data.pkl"])
    others = [*operations(pickle.dumps(Bomb(trace), protocol=2)), *operations(numbers_from(10**6, 0, (10**6,), (0,)))]
    others += [opcode.code.encode("latin-1") for opcode in pickletools.opcodes]
    for edit, place, operation in data.draw(
        st.lists(st.tuples(st.integers(0, 2), st.floats(0, 1), st.sampled_from([*real, *others])), min_size=1, max_size=5)
    ):
        position = int(place * len(real))
        real[position : position + edit % 2] = [] if edit == 1 else [operation]
    content = with_pickle(b"".join(real))
    try:
        read = read_tensors(content)
    except Exception:  # which becomes a sentence where the model is loaded
        return
    assert own_storages(read) <= SHARED * len(content)
