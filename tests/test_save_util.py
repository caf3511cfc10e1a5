"""Saved models: written as a whole or not at all, and refused with a reason."""

import base64
import io
import json
import zipfile
from pathlib import Path

import pytest
from conftest import CountingEnv
from stable_baselines3 import SAC

from sb3_esad import ESADLEND
from sb3_esad.common.save_util import whole_file, with_suffix


@pytest.fixture(scope="module")
def model() -> ESADLEND:
    return ESADLEND("MlpPolicy", CountingEnv(), policy_kwargs={"net_arch": [8], "memory_channels": 8}, buffer_size=100)


@pytest.fixture
def saved(model: ESADLEND, tmp_path: Path) -> Path:
    model.save(tmp_path / "model.zip")
    return tmp_path / "model.zip"


def test_whole_file_appears_when_it_is_complete(tmp_path: Path) -> None:
    with whole_file(tmp_path / "new" / "file", ".txt") as target:
        Path(target).write_text("all of it")
        assert Path(target).suffix == ".txt"
        assert not (tmp_path / "new" / "file.txt").exists()
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["file.txt"]


def test_whole_file_keeps_the_old_one_at_a_failure(tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), whole_file(path) as target:
        Path(target).write_text("half of the n")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_with_suffix() -> None:
    assert with_suffix("a/model", ".zip") == Path("a/model.zip")
    assert with_suffix("a/model.old", ".zip") == Path("a/model.old")


@pytest.mark.parametrize("name", ["model", "model.zip", "folder/model"])
@pytest.mark.parametrize("kind", [str, Path])
def test_save_and_load_paths(model: ESADLEND, tmp_path: Path, name: str, kind: type) -> None:
    model.save(kind(tmp_path / name))
    written = with_suffix(tmp_path / name, ".zip")
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [written]
    for path in (written, written.with_suffix("")):
        assert ESADLEND.load(kind(path)).cost_limit == model.cost_limit


@pytest.mark.filterwarnings(
    "ignore::pytest.PytestUnraisableExceptionWarning"
)  # SB3 does not close the file that it could not write
def test_save_keeps_the_old_model_at_a_failure(model: ESADLEND, saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = saved.read_bytes()
    monkeypatch.setattr(model, "get_parameters", lambda: {"policy": lambda: "cannot be pickled"})
    with pytest.raises(Exception, match="pickle"):
        model.save(saved)
    assert saved.read_bytes() == before
    assert list(saved.parent.iterdir()) == [saved]


def test_file_objects_are_left_alone(model: ESADLEND, saved: Path) -> None:
    buffer = io.BytesIO()
    model.save(buffer)
    buffer.seek(0)
    assert ESADLEND.load(buffer).cost_limit == model.cost_limit
    assert not buffer.closed
    with saved.open("rb") as file:
        assert ESADLEND.load(file).cost_limit == model.cost_limit


def test_load_refuses_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"There is no file .*nothing: give the zip that ESADLEND\.save"):
        ESADLEND.load(tmp_path / "nothing")


def test_load_refuses_a_folder(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="There is no file"):
        ESADLEND.load(tmp_path)


@pytest.mark.parametrize("content", [b"", b"P", b"not a model"])
def test_load_refuses_what_is_no_zip(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "model.zip"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.zip is no zip file"):
        ESADLEND.load(path)
    with pytest.raises(ValueError, match="given file object is no zip file"):
        ESADLEND.load(io.BytesIO(content))


@pytest.mark.parametrize("share", [0.001, 0.1, 0.5, 0.999])
def test_load_refuses_a_truncated_zip(saved: Path, share: float) -> None:
    content = saved.read_bytes()
    saved.write_bytes(content[: int(share * len(content))])
    # The members are zips themselves: where one of them ends, the file looks complete
    with pytest.raises(
        ValueError, match=r"model\.zip (is cut off or damaged .*: save or copy it again|.* only a part of one)"
    ):
        ESADLEND.load(saved)


def test_load_refuses_a_damaged_zip(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 8] = bytes(255 - byte for byte in content[middle : middle + 8])
    saved.write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.zip is damaged at its member 'policy.*\.pth'"):
        ESADLEND.load(saved)


@pytest.mark.parametrize("members", [{}, {"holiday.jpg": "x"}, {"data": "{}"}, {"policy.pth": "x"}])
def test_load_refuses_a_zip_without_a_model(tmp_path: Path, members: dict[str, str]) -> None:
    path = tmp_path / "photos.zip"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme.txt", "hello")
        for name, text in members.items():
            archive.writestr(name, text)
    with pytest.raises(ValueError, match=r"photos\.zip holds no model of Stable-Baselines3"):
        ESADLEND.load(path)


def test_load_refuses_members_that_hold_something_else(saved: Path, tmp_path: Path) -> None:
    """A zip that is whole but was written by something else, or by a version whose modules had other names."""
    forgeries = {"policy.pth": b"these are no tensors"}
    with zipfile.ZipFile(saved) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    data = json.loads(members["data"])
    data["policy_class"][":serialized:"] = base64.b64encode(b"csb3_esad.former_module\nLatentPolicy\n.").decode()
    forgeries["data"] = json.dumps(data).encode()
    for name, content in forgeries.items():
        with zipfile.ZipFile(tmp_path / "forged.zip", "w") as archive:
            for member, original in members.items():
                archive.writestr(member, content if member == name else original)
        with pytest.raises(ValueError, match="was saved by another version of sb3_esad"):
            ESADLEND.load(tmp_path / "forged.zip", device="cpu")


def test_load_refuses_another_algorithm(tmp_path: Path) -> None:
    SAC("MlpPolicy", CountingEnv(), policy_kwargs={"net_arch": [4]}, buffer_size=10).save(tmp_path / "sac.zip")
    with pytest.raises(ValueError, match=r"sac\.zip holds no ESADLEND but a model with a policy of stable_baselines3\.sac"):
        ESADLEND.load(tmp_path / "sac.zip")
