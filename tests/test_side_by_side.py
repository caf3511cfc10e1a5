"""Two jobs at the same time, and the same results as one after the other."""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch as th

from sb3_esad import ESADLEND
from sb3_esad.common import latent_algorithm
from sb3_esad.common.diffusion import DiffusionHead
from sb3_esad.common.side_by_side import side_by_side
from sb3_esad.esad_lend import esad_lend
from tests.conftest import TINY, CountingEnv

CPU = th.device("cpu")


@pytest.fixture
def two_threads() -> Iterator[None]:
    th.set_num_threads(2)
    yield


def fail() -> None:
    raise ArithmeticError


def test_both_run_at_the_same_time_on_half_of_the_threads(two_threads: None) -> None:
    meeting = threading.Barrier(2, timeout=10)

    def meet(name: str) -> tuple[str, int]:
        meeting.wait()
        return name, th.get_num_threads()

    outcomes = side_by_side(lambda: meet("first"), lambda: meet("second"), CPU)
    assert outcomes == (("first", 1), ("second", 1))
    assert th.get_num_threads() == 2


@pytest.mark.parametrize("jobs", [(fail, int), (int, fail)])
def test_a_failure_is_not_lost(two_threads: None, jobs: tuple[Callable[[], Any], Callable[[], Any]]) -> None:
    with pytest.raises(ArithmeticError):
        side_by_side(*jobs, CPU)
    assert th.get_num_threads() == 2


def test_one_thread_does_one_after_the_other() -> None:
    assert th.get_num_threads() == 1
    doers = side_by_side(threading.get_ident, threading.get_ident, CPU)
    assert doers == (threading.get_ident(), threading.get_ident())


def one_after_the_other(first: Callable[[], Any], second: Callable[[], Any], device: th.device) -> tuple[Any, Any]:
    """On as many threads as each job would have, for the order of a sum is seen in its last digit."""
    th.set_num_threads(1)
    outcomes = side_by_side(first, second, device)
    th.set_num_threads(2)
    return outcomes


@pytest.mark.parametrize("diffusion_steps", [0, 2])
def test_the_model_is_fitted_while_the_behaviour_learns_as_if_it_came_after(
    diffusion_steps: int, two_threads: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Dreams refined by diffusion, too: what is found about residuals must wait until they have been drawn."""
    monkeypatch.setattr(DiffusionHead, "refines", True)
    policy_kwargs = {**TINY["policy_kwargs"], "head_kwargs": {"diffusion_steps": diffusion_steps}}
    settings = {**TINY, "policy_kwargs": policy_kwargs, "train_freq": 8, "gradient_steps": 3, "seed": 1}
    weights = []
    for jobs in (side_by_side, one_after_the_other):
        monkeypatch.setattr(latent_algorithm, "side_by_side", jobs)
        model = ESADLEND("MlpPolicy", CountingEnv(), **settings).learn(48)
        weights.append(th.nn.utils.parameters_to_vector(model.policy.parameters()))
    assert th.equal(*weights)


@pytest.mark.parametrize("imagined_coef", [0.0, 1.0])
def test_windows_are_looked_through_while_critics_are_fitted_as_if_it_came_after(
    imagined_coef: float, two_threads: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights = []
    for jobs in (side_by_side, one_after_the_other):
        model = ESADLEND("MlpPolicy", CountingEnv(), **TINY).learn(24)
        monkeypatch.setattr(esad_lend, "side_by_side", jobs)
        model.fit_cost_critic(5, imagined_coef=imagined_coef)
        weights.append(th.nn.utils.parameters_to_vector(model.policy.cost_critic.parameters()))
    assert th.equal(*weights)


def test_each_update_imagines_with_the_model_that_was_fitted_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """As when every update is a call of its own."""
    model = ESADLEND("MlpPolicy", CountingEnv(), **TINY).learn(24)
    order: list[str] = []
    move, imagine = model._move, model._imagine
    monkeypatch.setattr(model, "_move", lambda name: order.append(name) or move(name))
    monkeypatch.setattr(model, "_imagine", lambda *args: order.append("imagine") or imagine(*args))
    model.train(2)
    turn = ["world_model", "imagine", "critic", "cost_critic", "actor"]
    assert order == 2 * turn
