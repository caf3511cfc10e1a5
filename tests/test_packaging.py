"""What is installed is complete: wheel and source distribution hold all that their users need, and nothing else."""

import subprocess
import sys
import tarfile
import zipfile
from configparser import ConfigParser
from pathlib import Path
from shutil import copytree, ignore_patterns

import pytest

ROOT = Path(__file__).parents[1]
BUILD = """
from setuptools import build_meta
print(build_meta.build_sdist("dist"), build_meta.build_wheel("dist"))
"""
FAR_FROM_THE_CLONE = """
import sb3_esad, sb3_esad.__main__, sb3_esad.hyperparams
print(sb3_esad.__file__)
print(sb3_esad.hyperparams.load_hyperparams(sb3_esad.WCSAC, "wcsac", "default"))
sb3_esad.__main__.main(["--version"])
"""
LEFT_BY_TOOLS = ignore_patterns(".*", "__pycache__", "build", "dist", "*.egg-info", "runs", "logs", "demo")


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both of them, built from a copy, by the setuptools that are installed."""
    copy = tmp_path_factory.mktemp("build") / "source"
    copytree(ROOT, copy, ignore=LEFT_BY_TOOLS)
    subprocess.run([sys.executable, "-c", BUILD], cwd=copy, check=True, capture_output=True)
    return copy / "dist"


@pytest.fixture(scope="module")
def site(dist: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, unpacked as pip would."""
    site = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(next(dist.glob("*.whl"))) as wheel:
        wheel.extractall(site)
    return site


def files(folder: Path, *patterns: str) -> set[str]:
    return {path.relative_to(folder).as_posix() for pattern in patterns for path in folder.rglob(pattern)}


def test_the_wheel_has_every_module_and_its_data(site: Path) -> None:
    modules = {f"sb3_esad/{name}" for name in files(ROOT / "sb3_esad", "*.py", "py.typed", "version.txt")}
    settings = {f"sb3_esad/hyperparams/{name}" for name in files(ROOT / "hyperparams", "*.yml")}
    installed = {name for name in files(site, "*.*") if (site / name).is_file() and ".dist-info" not in name}
    assert len(settings) >= 5 and installed == modules | settings
    (licence,) = site.glob("*.dist-info/licenses/LICENSE")
    assert licence.read_text() == (ROOT / "LICENSE").read_text()


def test_the_source_has_what_its_tests_need(dist: Path) -> None:
    with tarfile.open(next(dist.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    wanted = {"setup.cfg", "pyproject.toml", "Makefile", "LICENSE", "README.md", "constraints.txt", "docs/watching.md"}
    folders = ("sb3_esad", "hyperparams", "tests", "benchmark")
    wanted |= {f"{folder}/{name}" for folder in folders for name in files(ROOT / folder, "*.py", "*.yml", "py.typed")}
    assert wanted <= names
    assert not {name for name in names if "__pycache__" in name or name.endswith(".pyc")}


def test_an_installed_package_needs_no_clone(site: Path, tmp_path: Path) -> None:
    run = [sys.executable, "-c", FAR_FROM_THE_CLONE]
    told = subprocess.run(run, cwd=tmp_path, env={"PYTHONPATH": str(site)}, capture_output=True, text=True, check=True).stdout
    place, settings, version = told.splitlines()
    assert place.startswith(str(site)) and settings.startswith("Hyperparams(n_timesteps=")
    assert version == f"sb3_esad {(ROOT / 'sb3_esad' / 'version.txt').read_text().strip()}"


def test_the_lowest_versions_are_those_that_are_admitted() -> None:
    config = ConfigParser()
    config.read(ROOT / "setup.cfg")
    required = config["options"]["install_requires"].split() + config["options.extras_require"]["watch"].split()
    floors = dict(line.split(",")[0].split(">=") for line in required if ">=" in line)
    lines = (ROOT / "constraints-lowest.txt").read_text().splitlines()
    pinned = dict(line.split("==") for line in lines if not line.startswith("#"))
    versions = {name.lower(): version for name, version in pinned.items()}
    for name, floor in floors.items():
        version = versions[name.lower()]
        assert f"{version}.".startswith(f"{floor}."), f"{name} {version} is not the lowest that {floor} admits"
