"""Faults of RL Zoo that something of ours stands in for: a test that fails here says what is no longer needed."""

from importlib.metadata import requires
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import optuna
import pytest
from huggingface_hub.errors import RemoteEntryNotFoundError
from huggingface_sb3 import EnvironmentName
from rl_zoo3.load_from_hub import download_from_hub
from rl_zoo3.utils import SimpleLinearSchedule
from test_hub import hub  # noqa: F401
from test_zoo import COUNTING, ENV, env_kwargs_of, make_manager

from sb3_esad.zoo.manager import CostAwareManager
from tests.local_hub import LocalHub

Plain: Any = CostAwareManager.__base__


def test_requests_is_not_declared() -> None:
    """Then ``requests`` may leave the extra ``zoo``."""
    assert find_spec("requests"), "which rl_zoo3.enjoy imports"
    assert not any(requirement.startswith("requests") for requirement in requires("rl_zoo3") or [])


def test_push_to_hub_cannot_be_imported() -> None:
    """Then RL Zoo's own command works, though its card knows no costs."""
    with pytest.raises(ImportError, match="generate_metadata"):
        import rl_zoo3.push_to_hub  # noqa: F401


def test_agents_without_normalization_cannot_be_fetched(
    hub: LocalHub,  # noqa: F811
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Then RL Zoo's own command works, though it trusts whatever it fetches."""
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    hub.files["me/sac-A-v0"] = {"sac-A-v0.zip": b"", "config.yml": b"", "args.yml": b"", "env_kwargs.yml": b""}
    with pytest.raises(RemoteEntryNotFoundError, match=r"vec_normalize\.pkl"):
        download_from_hub("sac", EnvironmentName("A-v0"), 0, str(tmp_path), "me")


def test_linear_schedules_fall_below_zero() -> None:
    """Then ``CostAwareManager._preprocess_schedules`` may go."""
    assert SimpleLinearSchedule(1.0)(-0.1) < 0
    assert CostAwareManager._preprocess_schedules({"learning_rate": "lin_1.0"})["learning_rate"](-0.1) == 0


def test_env_kwargs_of_a_file_reach_the_training_only(tmp_path: Path) -> None:
    """Then ``CostAwareManager._preprocess_hyperparams`` need only check the keys."""
    assert env_kwargs_of(Plain, tmp_path) == ({"time_limit": 3}, {}, None)


def test_a_search_without_winner_loses_its_trials(tmp_path: Path) -> None:
    """Then ``CostAwareManager.hyperparameters_optimization`` may go."""

    class Infeasible(Plain):
        def objective(self, trial: optuna.Trial) -> float:
            trial.set_constraint("cost", 1.0)
            return 0.0

    search = Infeasible(None, "esad_lend", COUNTING, str(tmp_path), verbose=0, n_evaluations=1, no_optim_plots=True)
    with pytest.raises(ValueError, match="No feasible trials"):
        search.hyperparameters_optimization()
    assert not list(tmp_path.rglob("*.csv"))


def test_record_training_calls_the_first_python_there_is() -> None:
    """Then ``commands._call_or_record`` may go, if that python knows our algorithms."""
    spec = find_spec("rl_zoo3.record_training")
    assert spec and spec.origin
    assert '["python", "-m", "rl_zoo3.record_video"' in Path(spec.origin).read_text()


def test_hyperparameters_are_looked_for_in_its_own_folder_only(tmp_path: Path) -> None:
    """Then ``CostAwareManager`` need not choose the file."""
    assert not Path(Plain(None, "esad_lend", ENV, str(tmp_path)).config).exists()
    assert Path(make_manager(tmp_path).config).exists()
