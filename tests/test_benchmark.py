"""Every script of benchmark/ starts, and says what it does."""

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = sorted((Path(__file__).parents[1] / "benchmark").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_help(script: Path) -> None:
    run = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True, check=True)
    assert f"usage: {script.name}" in run.stdout
