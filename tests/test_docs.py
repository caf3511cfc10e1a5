"""What the README and the pages of docs/ say is true: Python runs, commands are understood, links lead somewhere."""

import argparse
import re
import runpy
import shlex
import sys
from collections.abc import Callable, Iterator
from configparser import ConfigParser
from functools import partial
from importlib.util import find_spec
from itertools import product
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from conftest import TINY, CountingEnv
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from test_architecture import RANKS

from sb3_esad import ESADLEND, __main__, driving_evaluation
from sb3_esad.__main__ import main, make_parser
from sb3_esad.common.checkpoints import RunCheckpointCallback
from sb3_esad.envs.drivers import DRIVERS
from sb3_esad.hyperparams import constructor_arguments

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
TEXTS = {str(page.relative_to(ROOT)): page.read_text() for page in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]}

EXAMPLE = re.compile(r"```python\n(?P<code>.*?)```(?:\n\n```text\n(?P<output>.*?)```)?", re.DOTALL)
WITH_EXAMPLES = [page for page, text in TEXTS.items() if "```python" in text]
BASH = re.compile(r"```bash\n(.*?)```", re.DOTALL)
WITH_COMMANDS = [page for page, text in TEXTS.items() if "/python -m" in "".join(BASH.findall(text))]
SPANS = r"`((?:\.venv/bin/python|make|pip install) [^`]*)`"
COMMANDS = sorted(
    {line for text in TEXTS.values() for line in [*re.findall(SPANS, text), *"".join(BASH.findall(text)).splitlines()]}
)
LINKS = [(page, link) for page, text in TEXTS.items() for link in re.findall(r"\]\((?!https?:)(.*?)\)", text)]

BRIEF = {"learning_starts": 20, "train_freq": 5, "gradient_steps": 1, "pretrain_steps": 1, "pretrain_gradient_steps": 0}


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Trainings have 25 steps, a checkpoint and an update at their end; models and drivers are judged by two episodes."""
    learn = OffPolicyAlgorithm.learn

    def learn_briefly(self: OffPolicyAlgorithm, total_timesteps: int, *args: Any, **kwargs: Any) -> OffPolicyAlgorithm:
        vars(self).update(BRIEF)
        self._convert_train_freq()
        return learn(self, 25 * self.n_envs, *args, **kwargs)

    def briefly(evaluate: Callable[..., Any], who: Any, env_id: str, seeds: range, *how: Any) -> Any:
        return evaluate(who, env_id, seeds[:2], *how)

    monkeypatch.setattr(OffPolicyAlgorithm, "learn", learn_briefly)
    monkeypatch.setattr(RunCheckpointCallback, "save_freq", property(lambda _: 10, lambda *_: None), raising=False)
    for name, module in product(("evaluate_model", "evaluate_driver"), (driving_evaluation, __main__)):
        monkeypatch.setattr(module, name, partial(briefly, getattr(module, name)))


@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.filterwarnings("ignore:Within save_freq")  # in 25 steps hardly an episode ends
@pytest.mark.filterwarnings("ignore::UserWarning:stable_baselines3")  # it finds our few steps a space without bounds
@pytest.mark.parametrize("page", WITH_EXAMPLES)
def test_examples_run(
    page: str, brief: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for example in EXAMPLE.finditer(TEXTS[page]):
        capsys.readouterr()
        exec(compile(example["code"], f"example of {page}", "exec"), {"__name__": "__main__"})
        assert example["output"] in (None, capsys.readouterr().out)


@pytest.mark.filterwarnings("ignore:Within save_freq")
@pytest.mark.parametrize("page", WITH_COMMANDS)
def test_commands_run(page: str, brief: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order in which the page has them, after `make demo`; what installs, or needs clones of others, is left out."""
    monkeypatch.chdir(tmp_path)
    ESADLEND("CnnPolicy", "esad-highway-v0", **TINY).save("demo/esad_lend.zip")
    for line in "".join(BASH.findall(TEXTS[page])).splitlines():
        program, *words = shlex.split(line)
        if words[:2] == ["-m", "sb3_esad"]:
            assert main(words[2:]) == 0
        elif program.endswith("python") and words[0] == "-m":
            run_python(words)


def test_there_are_no_other_blocks() -> None:
    assert len(WITH_EXAMPLES) >= 5 and len(COMMANDS) >= 20
    kinds = {kind for text in TEXTS.values() for kind in re.findall(r"^ *```(\S+)", text, re.MULTILINE)}
    assert kinds <= {"python", "bash", "text", "{toctree}", "{include}", "{eval-rst}"}


class Understood(Exception):
    """Raised in place of what a command would go on to do."""


@pytest.fixture
def only_parse(monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands do nothing after their words have been understood."""
    parse_args = argparse.ArgumentParser.parse_args

    def parse(*args: Any, **kwargs: Any) -> None:
        parse_args(*args, **kwargs)
        raise Understood

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse)
    monkeypatch.setattr("sb3_esad.zoo.plots._check_evaluations", lambda *_: None)
    monkeypatch.setattr("sb3_esad.zoo.resuming._read_run", lambda folder: {"command": [], "checkpoint_freq": 1})


@pytest.mark.parametrize("command", COMMANDS)
def test_commands_are_understood(command: str, only_parse: None) -> None:
    program, *words = shlex.split(command)
    if program == "make":
        assert re.search(rf"^{words[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
    elif program == "pip":
        config = ConfigParser()
        config.read(ROOT / "setup.cfg")
        assert words[-1].partition("[")[2].strip("]") in config["options.extras_require"]
    else:
        with pytest.raises(Understood):
            run_python(words)


def run_python(words: list[str]) -> None:
    """Run a module or a script as Python would."""
    if words[:2] == ["-m", "sb3_esad"]:
        run_ours(words[2:])
    elif words[0] == "-m":
        import sb3_esad.zoo  # noqa: F401  (as custom_envs.py does)

        with mock.patch("sys.argv", words[1:]):
            runpy.run_path(str(find_spec(words[1]).origin), run_name="__main__")
    else:
        folder = str((ROOT / words[0]).parent)
        with mock.patch("sys.argv", words), mock.patch("sys.path", [folder, *sys.path]):
            runpy.run_path(str(ROOT / words[0]), run_name="__main__")


def run_ours(words: list[str]) -> None:
    """Our own parser hands the words of RL Zoo's commands on to that of RL Zoo."""
    args, unknown = make_parser().parse_known_args(words)
    assert not unknown
    if "words" not in args:
        raise Understood
    args.run(args)


def headings(page: Path) -> set[str]:
    """Anchors of a page, as GitHub names them."""
    found = re.findall(r"^#+ (.*)", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading).lower().replace(" ", "-") for heading in found}


@pytest.mark.parametrize(("page", "link"), LINKS)
def test_links_lead_somewhere(page: str, link: str) -> None:
    path, _, anchor = link.partition("#")
    target = (ROOT / page).parent / path if path else ROOT / page
    assert target.exists() and (not anchor or anchor in headings(target))


def test_drivers_are_listed() -> None:
    assert set(re.findall(r"^\| `([a-z]+)`", TEXTS["README.md"], re.MULTILINE)) == set(DRIVERS)


def test_symbols_have_arguments() -> None:
    table = TEXTS["docs/symbols.md"].partition("| more |")[0]
    names = set(re.findall(r"`([a-z_]+)`", table))
    assert len(names) > 10 and names <= constructor_arguments(ESADLEND)


def test_keys_of_the_log_are_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    logged: set[str] = set()
    monkeypatch.setattr(Logger, "dump", lambda self, step=0: logged.update(self.name_to_value))
    model = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "filter_start": 0})
    # So that road and critics have their say within so few steps
    vars(model.penalty).update(min_episodes=1, calibration_band=(0.0, 1e9))
    model.penalty.episodes.road_steps = 30
    model.learn(80)
    table = TEXTS["docs/tuning.md"].partition("## It crashes")[0]
    keys = {key for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for key in re.findall(r"`(.*?)`", row)}
    assert len(keys) > 15 and keys <= {name.rpartition("/")[2] for name in logged}


def drawn_modules() -> Iterator[str]:
    """Modules in the picture of the layers, from top to bottom."""
    for line in re.findall(r'class="module"[^>]*>(.*?)<', (DOCS / "layers.svg").read_text()):
        for name in line.split(" · "):
            yield name if name in RANKS else f"common.{name}"


def test_layers_are_drawn_in_their_order() -> None:
    ranks = [RANKS[name] for name in drawn_modules()]
    assert len(ranks) > 30 and ranks == sorted(ranks, reverse=True)
