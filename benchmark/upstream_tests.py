"""
The tests of Stable-Baselines3 or sb3-contrib with our algorithms in the place of SAC or TQC: ``upstream_tests.py CLONE``.

The tests of the clone run on the installed packages, unchanged: what they import as SAC (TQC) is an algorithm of ours, with
small networks. Those that have no use for it are left out. Warnings are errors; the one about environments without costs is
silent. A test that does not apply has its reason below, and must fail; docs/sb3_contract.md lists them.
"""

import argparse
import math
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from types import CodeType
from typing import Any

import pytest
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_esad import ADEND, ESADLEND
from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.common.costs import CostReader

TAKEN = {"stable_baselines3": "SAC", "sb3_contrib": "TQC"}
"""Packages, and the algorithm of each whose place is taken."""

SMALL: dict[str, Any] = {
    "learning_starts": 100,  # as SAC has it: most of these tests are shorter than what ours wait for
    "train_freq": 16,
    "batch_size": 4,
    "sequence_length": 8,
    "pretrain_steps": 1,
    "imagination_starts": 16,
    "imagination_horizon": 3,
}
SMALL_POLICY: dict[str, Any] = {"net_arch": [16], "memory_channels": 8, "latent_channels": 4}
"""What makes those that imagine quick."""

OF_TQC = ("n_quantiles",)
OF_SAC = ("share_features_extractor", "features_extractor_kwargs")
"""What describes networks that ours are not: dropped."""

DOES_NOT_APPLY: dict[str, str] = {
    r"test_her\.py|test_vec_normalize\.py::test_her": "HerReplayBuffer keeps no costs, and is refused",
    r"test_n_step_replay\.py": "n_steps is refused: cost critics learn from single steps, imagined returns mix all of them",
    r"test_save_load\.py::test_warn_buffer\[True": "optimize_memory_usage is refused: it loses the last frames of episodes",
    r"test_custom_policy\.py::test_custom_offpolicy\[.*net_arch0": "net_arch=[] is refused: critics have a hidden layer",
    r"test_train_eval_mode\.py::test_(sac|tqc)_train": "tau=0 is refused: targets would not follow",
    r"test_cnn\.py::test_features?_extractor_target": "train() called by hand waits for learning_starts stored steps",
    r"test_tensorboard\.py": "looks for a run that is named SAC; ours are named after their class",
}
"""Tests by a pattern of their names, and why no algorithm of ours passes them."""

DOES_NOT_APPLY_TO_LATENTS: dict[str, str] = {
    r"test_sde\.py.*(True-True|True-False)|test_run\.py::test_sde|test_spaces\.py::test_sde": "gSDE is refused",
    r"stable_baselines3/.*::test_offpolicy_multi_env": "asks for gSDE; that of sb3-contrib does not, and passes",
    r"test_save_load\.py::test_save_load_policy": "calls actor.predict: an actor of ours sees latent states, not observations",
    r"test_save_load\.py::test_save_load_pytorch_var": "reads log_ent_coef; ours is a module named entropy",
    r"test_gae\.py": "calls the critic with observations; ours sees latent states",
    r"test_train_eval_mode\.py::.*(Pendulum|collect)": "looks for an extractor in the actor; ours is the world model's",
    r"test_dict_env\.py::test_consistency": "the encoders of vectors and of dictionaries differ in size",
    r"test_cnn\.py::test_image_like_input\[True": "expects an AssertionError; ours is a ValueError with a remedy",
    r"test_spaces\.py::test_action_spaces\[CartPole": "expects an AssertionError; ours is a ValueError with a remedy",
    r"test_identity\.py": "400 steps are too few for small networks to learn a world model and to act by it",
}
"""The same for those that imagine."""

DOES_NOT_APPLY_TO_AD_END: dict[str, str] = {
    r"test_save_load\.py::test_save_load\[": "takes the last parameter of each saved object; its absent penalty has none",
}
"""The same for AD-END."""


def reason_of(name: str, algorithm: type[BaseAlgorithm]) -> str | None:
    """
    Tell why a test does not apply.

    :param name: of the test, with its package, its file and its parameters
    :param algorithm: that is tested
    :return: None if it does
    """
    reasons = dict(DOES_NOT_APPLY)
    for concerned, further in ((ESADLEND, DOES_NOT_APPLY_TO_LATENTS), (ADEND, DOES_NOT_APPLY_TO_AD_END)):
        if issubclass(algorithm, concerned):
            reasons |= further
    return next((reason for pattern, reason in reasons.items() if re.search(pattern, name)), None)


def names_in(code: CodeType) -> set[str]:
    """
    Find what a function mentions.

    :param code: of the function
    :return: global names and attributes, those of functions inside it included
    """
    inner = (names_in(each) for each in code.co_consts if isinstance(each, CodeType))
    return set(code.co_names).union(*inner)


class StandIn:
    """
    A plugin of pytest that puts an algorithm in the place of another, before any test is imported.

    :param algorithm: class that is tested
    :param package: whose tests are run
    """

    def __init__(self, algorithm: type[Any], package: str) -> None:
        self.package, self.taken = package, TAKEN[package]
        is_latent = issubclass(algorithm, ESADLEND)
        dropped = OF_TQC + OF_SAC if is_latent else OF_TQC

        class Small(algorithm):
            """The algorithm with small networks, whatever sizes a test knows of."""

            def __init__(self, *args: Any, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any) -> None:
                own = {name: value for name, value in (policy_kwargs or {}).items() if name not in dropped}
                if is_latent:
                    kwargs, own = {**SMALL, **kwargs}, {**SMALL_POLICY, **own}
                    kwargs["sequence_length"] = min(kwargs["sequence_length"], kwargs.get("buffer_size", math.inf))
                super().__init__(*args, policy_kwargs=own, **kwargs)

        Small.__name__ = algorithm.__name__
        self.algorithm = Small
        setattr(import_module(package), self.taken, Small)
        CostReader._warn_missing = lambda *args: None  # type: ignore[method-assign]

    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Function]) -> None:
        """
        Leave out the tests of other algorithms, and mark those that must fail.

        :param config: of the run
        :param items: all tests
        """
        ours = [item for item in items if self._is_meant(item)]
        config.hook.pytest_deselected(items=[item for item in items if item not in ours])
        items[:] = ours
        for item in items:
            if reason := reason_of(f"{self.package}/{item.nodeid}", self.algorithm):
                item.add_marker(pytest.mark.xfail(reason=reason, strict=True))

    def _is_meant(self, item: pytest.Function) -> bool:
        params = item.callspec.params if hasattr(item, "callspec") else {}
        given = params.get("model_class", params.get("algo"))
        by_name = self.taken.lower() in params.values() or self.taken in names_in(item.function.__code__)
        return by_name if given is None else given is self.algorithm


def run(clone: Path, algorithm: type[Any], further: list[str]) -> int:
    """
    Run the tests of a clone.

    :param clone: folder of the repository
    :param algorithm: class that is tested
    :param further: arguments for pytest
    :return: exit code of pytest
    """
    package = next(name for name in TAKEN if (clone / name).is_dir())
    stand_in = StandIn(algorithm, package)
    with tempfile.TemporaryDirectory() as folder:
        # A copy: in the clone, its package would come before the installed one
        shutil.copytree(clone / "tests", Path(folder) / "tests")
        files = [str(path) for path in sorted(Path(folder).glob("tests/test_*.py")) if mentions(path, stand_in.taken)]
        options = ["-c", "/dev/null", "--rootdir", folder, "-q", "--tb=short", "-p", "no:cacheprovider", "-p", "no:xdist"]
        warnings = ["error", "ignore:rich is experimental", "ignore:Unknown pytest.mark", "ignore:`torch.jit.script_method`"]
        filters = [word for each in warnings for word in ("-W", each)]
        return int(pytest.main([*options, *filters, *further, *files], plugins=[stand_in]))


def mentions(path: Path, name: str) -> bool:
    """
    Tell whether a file has a word.

    :param path: of the file
    :param name: the word
    :return: whether it has
    """
    return re.search(rf"\b{name}\b", path.read_text()) is not None


def main() -> None:
    """Run the tests for one algorithm, or for each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clone", type=Path, help="folder of a clone of Stable-Baselines3 or sb3-contrib")
    parser.add_argument("--algo", choices=ALGORITHMS, help="default: all in turn")
    parser.add_argument("--pytest", default="", help='words for pytest, as in --pytest="-k cnn"')
    args = parser.parse_args()
    if args.algo:
        sys.exit(run(args.clone, ALGORITHMS[args.algo], shlex.split(args.pytest)))
    codes = []
    for algo in ALGORITHMS:
        print(f"\n{algo}", flush=True)
        command = [sys.executable, __file__, str(args.clone), "--algo", algo, f"--pytest={args.pytest}"]
        codes.append(subprocess.run(command, check=False).returncode)
    sys.exit(max(codes))


if __name__ == "__main__":
    main()
