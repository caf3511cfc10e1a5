"""
The tests of Stable-Baselines3 or sb3-contrib with our algorithms in the place of SAC or TQC: ``upstream_tests.py CLONE``.

The tests of the clone run on the installed packages, unchanged: what they import as SAC (TQC) is an algorithm of ours, with
small networks. Those that have no use for it are left out. Warnings are errors, but for the one about environments without
costs. A test that does not apply has its reason below, is run as it stands, and must fail; docs/sb3_contract.md lists them.
"""

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
from fnmatch import fnmatch
from importlib import import_module
from pathlib import Path
from types import CodeType
from typing import Any

import pytest
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_esad import ESADLEND
from sb3_esad.algorithms import ALGORITHMS

TAKEN = {"stable_baselines3": "SAC", "sb3_contrib": "TQC"}
"""Packages, and the algorithm of each whose place is taken."""

SMALL: dict[str, Any] = {
    "learning_starts": 100,  # as SAC has it: most of these tests are shorter than what ours wait for
    "batch_size": 4,
    "sequence_length": 8,
    "pretrain_steps": 1,
    "imagination_starts": 16,
    "imagination_horizon": 3,
}
SMALL_POLICY: dict[str, Any] = {"net_arch": [16], "memory_channels": 8, "latent_channels": 4}
"""What makes those that imagine quick."""

OF_OTHER_NETWORKS = ("n_quantiles", "n_critics", "share_features_extractor", "features_extractor_kwargs")
"""Sizes of networks that SAC and TQC have: dropped, but for the tests that are about them."""

DOES_NOT_APPLY: dict[str, str] = {}
"""Tests by what their names begin with, and why no algorithm of ours can pass them."""

DOES_NOT_APPLY_TO_LATENTS: dict[str, str] = {}
"""The same for those that imagine."""


def reason_of(name: str, algorithm: type[BaseAlgorithm]) -> str | None:
    """
    Tell why a test does not apply.

    :param name: of the test, with its parameters
    :param algorithm: that is tested
    :return: None if it does
    """
    reasons = {**DOES_NOT_APPLY, **(DOES_NOT_APPLY_TO_LATENTS if issubclass(algorithm, ESADLEND) else {})}
    return next((reason for pattern, reason in reasons.items() if fnmatch(name, pattern)), None)


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
        self.taken = TAKEN[package]
        self.as_it_stands = False
        plugin, is_latent = self, issubclass(algorithm, ESADLEND)

        class Small(algorithm):
            """The algorithm with small networks, whatever sizes a test knows of."""

            def __init__(self, *args: Any, policy_kwargs: dict[str, Any] | None = None, **kwargs: Any) -> None:
                given = policy_kwargs or {}
                if is_latent and not plugin.as_it_stands:
                    own = {name: value for name, value in given.items() if name not in OF_OTHER_NETWORKS}
                    kwargs, given = {**SMALL, **kwargs}, {**SMALL_POLICY, **own}
                super().__init__(*args, policy_kwargs=given, **kwargs)

        Small.__name__ = algorithm.__name__
        self.algorithm = Small
        setattr(import_module(package), self.taken, Small)

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
            if reason := reason_of(item.name, self.algorithm):
                item.add_marker(pytest.mark.xfail(reason=reason, strict=True))

    def pytest_runtest_setup(self, item: pytest.Function) -> None:
        """
        Make networks small, but for the tests that do not apply.

        :param item: test that is about to run
        """
        self.as_it_stands = reason_of(item.name, self.algorithm) is not None

    def _is_meant(self, item: pytest.Function) -> bool:
        values = item.callspec.params.values() if hasattr(item, "callspec") else []
        algorithms = [value for value in values if isinstance(value, type) and issubclass(value, BaseAlgorithm)]
        by_name = self.taken.lower() in values or self.taken in names_in(item.function.__code__)
        return self.algorithm in algorithms if algorithms else by_name


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
        warnings = ["error", "ignore:No cost:UserWarning", "ignore:rich is experimental", "ignore:Unknown pytest.mark"]
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
    args, further = parser.parse_known_args()
    if args.algo:
        sys.exit(run(args.clone, ALGORITHMS[args.algo], further))
    codes = []
    for algo in ALGORITHMS:
        print(f"\n{algo}", flush=True)
        command = [sys.executable, __file__, str(args.clone), "--algo", algo, *further]
        codes.append(subprocess.run(command, check=False).returncode)
    sys.exit(max(codes))


if __name__ == "__main__":
    main()
