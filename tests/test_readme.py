"""The Python of README and docs/watching.md runs, in a few steps; commands are understood, links lead somewhere."""

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_esad import ESADLEND
from sb3_esad.__main__ import make_parser
from sb3_esad.envs.drivers import DRIVERS
from sb3_esad.hyperparams import constructor_arguments

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
WATCHING = (ROOT / "docs" / "watching.md").read_text()
EXAMPLES = re.findall(r"```python\n(.*?)```", README + WATCHING, re.DOTALL)
COMMANDS = re.findall(r"`\.venv/bin/python -m sb3_esad (.*?)`", README)
TRAINING_STEPS = 30


@pytest.fixture
def brief_learning(monkeypatch: pytest.MonkeyPatch) -> None:
    learn = OffPolicyAlgorithm.learn

    def learn_briefly(self: OffPolicyAlgorithm, total_timesteps: int, *args: Any, **kwargs: Any) -> OffPolicyAlgorithm:
        return learn(self, TRAINING_STEPS, *args, **kwargs)

    monkeypatch.setattr(OffPolicyAlgorithm, "learn", learn_briefly)


@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.filterwarnings("ignore::UserWarning:stable_baselines3")  # it finds our 20 steps a space without bounds
@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_examples_run(number: int, brief_learning: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    exec(compile(EXAMPLES[number], f"README example {number}", "exec"), {"__name__": "__main__"})


def test_there_are_examples_and_commands() -> None:
    assert len(EXAMPLES) >= 3 and len(COMMANDS) >= 3


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command: str) -> None:
    assert callable(make_parser().parse_args(shlex.split(command)).run)


def test_drivers_are_listed() -> None:
    assert set(re.findall(r"^\| `([a-z]+)`", README, re.MULTILINE)) == set(DRIVERS)


def test_symbols_have_arguments() -> None:
    table = README[README.index("| paper | meaning | here |") : README.index("## Differences")]
    names = set(re.findall(r"`([a-z_]+)`", table))
    assert len(names) > 10 and names <= constructor_arguments(ESADLEND)


@pytest.mark.parametrize("link", re.findall(r"\]\((?!https?:)(.*?)\)", README))
def test_links_lead_somewhere(link: str) -> None:
    headings = {
        re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in re.findall(r"^#+ (.*)", README, re.MULTILINE)
    }
    assert link.removeprefix("#") in headings if link.startswith("#") else (ROOT / link).exists()
