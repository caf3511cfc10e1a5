"""The layers of the package: imports only point down."""

import ast
from configparser import ConfigParser
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "sb3_esad"
MODULES = sorted(PACKAGE.rglob("*.py"))

# From the lowest to the highest; a module may import those of its own and of lower layers.
LAYERS = [
    "common.type_aliases common.functional common.transforms common.torch_layers common.target_networks common.optimizers",
    "common.returns common.precision common.checks common.memory common.schedules common.side_by_side common.noise",
    "common.log_keys common.warn_once common.image_watch",
    "common.plain_values common.plain_zip common.numpy_state",
    "common.costs common.six_values common.frames common.windows common.cost_buffers common.buffers",
    "common.recent_sums",
    "common.episode_record common.penalties common.multipliers common.entropy",
    "common.running_scale common.preprocessing",
    "common.latents common.denoiser common.extractors common.decoders common.heads common.actor",
    "common.rssm common.diffusion",
    "common.world_model common.critics common.starts",
    "common.imagined_returns common.agent",
    "common.foresight",
    "common.selection",
    "common.policies common.callbacks common.evaluation common.save_util",
    "common.description common.untrusted common.whole_files common.checkpoints",
    "common.cost_aware_algorithm common.cost_limited_algorithm",
    "common.recurrent_algorithm common.latent_algorithm common.constrained_algorithm",
    "esad_lend dreamer latent_sw_ppo wcsac envs",
    "",  # the package itself, which re-exports
    "driving_evaluation report dream explanation panels progress hyperparams algorithms film",
    "watching",
    "moments plots",
    "video",
    "demo zoo benchmark",
    "__main__",
]
RANKS = {name: rank for rank, layer in enumerate(LAYERS) for name in layer.split() or [""]}
ISOLATED = {"esad_lend", "dreamer", "latent_sw_ppo", "wcsac", "envs"}


def unit(module: str) -> str:
    """Part of the package that has a rank: a module of ``common``, another folder or a top-level module."""
    parts = module.split(".")[1:]
    return ".".join(parts[: 2 if parts[:1] == ["common"] else 1])


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def imported(path: Path) -> set[str]:
    """Names of the modules that a file imports, at its top or inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} has a relative import; write it in full."
            submodules = {f"{node.module}.{alias.name}" for alias in node.names}
            names |= {name for name in submodules if is_module(name)} or {str(node.module)}
    return names


def is_module(name: str) -> bool:
    path = ROOT.joinpath(*name.split("."))
    return path.is_dir() or path.with_suffix(".py").exists()


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_imports_point_down(path: Path) -> None:
    mine = unit(module_name(path))
    if mine == "common":
        assert not imported(path), "sb3_esad.common is a folder, not a module to import from."
        return
    assert mine in RANKS, f"{path} has no layer; give it one in LAYERS."
    for name in imported(path):
        if name.split(".")[0] == "sb3_esad":
            other = unit(name)
            assert RANKS[other] <= RANKS[mine], f"{path} imports {name}, which lies above it."
            assert other == mine or mine not in ISOLATED or other not in ISOLATED, f"{path} imports {name}, its sibling."
            assert mine != "envs" or other == "envs", f"{path} imports {name}; a scenario stands alone."
        assert name.split(".")[0] != "rl_zoo3" or mine == "zoo", f"{path} imports rl_zoo3; leave that to zoo.py."


def test_no_modules_import_each_other() -> None:
    TopologicalSorter({module_name(path): imported(path) for path in MODULES}).prepare()


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_public_names_are_documented(path: Path) -> None:
    tree = ast.parse(path.read_text())
    if tree.body:
        assert ast.get_docstring(tree), f"{path} does not say what it is for."
    for node in tree.body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), f"{node.name} in {path} has no docstring."


@pytest.mark.parametrize("path", MODULES, ids=module_name)
def test_no_imports_for_type_checking_only(path: Path) -> None:
    assert "TYPE_CHECKING" not in path.read_text(), f"{path}: a hint that needs this import is in the wrong layer."


def test_every_package_is_listed() -> None:
    config = ConfigParser()
    config.read(ROOT / "setup.cfg")
    listed = set(config["options"]["packages"].split())
    folders = {module_name(path.parent / "__init__.py") for path in MODULES}
    assert listed == folders | {"sb3_esad.hyperparams"}
