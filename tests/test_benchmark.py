"""Every script of benchmark/ starts, and says what it does."""

import json
import re
import runpy
import sys
from functools import partial
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import diffusion
import dreams
import driving
import experiments
import filtered_driving
import numpy as np
import pytest
import torch as th
from arms import Arm
from stable_baselines3 import SAC
from stable_baselines3.common.logger import configure
from update_speed import esad_lend
from upstream_tests import DOES_NOT_APPLY, DOES_NOT_APPLY_TO_AD_END, DOES_NOT_APPLY_TO_LATENTS
from world_model import Step

from sb3_esad.common.diffusion import DiffusionHead
from sb3_esad.common.type_aliases import LatentState, Predictions, SequenceSamples
from sb3_esad.common.world_model import WorldModel
from tests.conftest import CountingEnv

SCRIPTS = sorted(
    path
    for path in (Path(__file__).parents[1] / "benchmark").glob("*.py")
    if "__main__" in path.read_text()  # others are modules of scripts
)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_help(script: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.syspath_prepend(script.parent)
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(script), run_name="__main__")
    assert end.value.code == 0
    assert f"usage: {script.name}" in capsys.readouterr().out


def test_what_does_not_apply_is_told() -> None:
    """In the words of the script, with the file of the test."""
    rows = (Path(__file__).parents[1] / "docs" / "sb3_contract.md").read_text().splitlines()
    tables = {"all": DOES_NOT_APPLY, "those that imagine": DOES_NOT_APPLY_TO_LATENTS, "`ADEND`": DOES_NOT_APPLY_TO_AD_END}
    for concerned, reasons in tables.items():
        for pattern, reason in reasons.items():
            (row,) = (row for row in rows if f"| {concerned} | {reason} |" in row and names_one_of(row, pattern))
            assert row.startswith("| `test_")


@pytest.mark.parametrize("diffusion_steps", [0, 2])
def test_updates_are_timed_with_refined_latents_if_there_are_any(diffusion_steps: int) -> None:
    head = esad_lend("esad-highway-v0", 10, diffusion_steps).policy.world_model.rssm.head
    assert head.refines if isinstance(head, DiffusionHead) else diffusion_steps == 0


def test_no_step_is_foreseen_twice() -> None:
    counted = (Step(np.array([i]), np.array([i + 1]), np.zeros(1), 0.0, False, {"cost": 0.0}) for i in count())
    (batch,) = diffusion.stretches(CountingEnv(), counted, diffusion.BATCH * diffusion.LENGTH)
    assert isinstance(batch.observations, th.Tensor)
    assert batch.observations.flatten().tolist() == list(range(diffusion.BATCH * diffusion.LENGTH))
    foreseen = [start + ahead for start in diffusion.STARTS for ahead in range(1, diffusion.AHEAD[-1] + 1)]
    assert len(foreseen) == len(set(foreseen)) and max(foreseen) < diffusion.LENGTH


@pytest.mark.parametrize(("continues", "expected"), [(1.0, 1 - 0.9**5), (0.0, 0.1)])
def test_costs_within_five_steps_are_judged_where_it_is_known_whether_they_came(continues: float, expected: float) -> None:
    """Windows that go on, that a cost ends after two steps, that end there without one, and of which time is up there."""
    start, end = diffusion.STARTS[0], diffusion.STARTS[0] + 2
    samples = SimpleNamespace(
        actions=th.zeros(4, diffusion.LENGTH, 1),
        is_first=th.zeros(4, diffusion.LENGTH, dtype=th.bool),
        costs=th.zeros(4, diffusion.LENGTH),
        continues=th.ones(4, diffusion.LENGTH),
    )
    samples.is_first[1:, end + 1] = True
    samples.costs[1, end], samples.continues[1:3, end] = 1.0, 0.0
    state = LatentState(*(th.zeros(diffusion.LENGTH, 4, *shape) for shape in [(2, 1, 1), (2, 1, 1), (1,)]))
    prediction = Predictions(*(th.full((4 * diffusion.N_SAMPLES,), value) for value in (0.0, 0.1, continues)))
    rssm = SimpleNamespace(imagine=lambda state: state)
    model: Any = SimpleNamespace(rssm=rssm, features=lambda state: state, predictions=lambda features: prediction)
    filtered: Any = SimpleNamespace(states=state)
    found = diffusion.scores(model, cast(SequenceSamples, samples), filtered, start)
    assert found[0, :3].tolist() == [0, 0, 0] and found[1:, 0].tolist() == [0, 0, 0] and found[1:, 1:3].isnan().all()
    assert found[:, 3].tolist() == pytest.approx(
        [expected**2, (1 - expected) ** 2, expected**2, np.nan], rel=1e-5, nan_ok=True
    )


def test_dreams_are_compared_with_what_is_known_of_their_steps() -> None:
    """
    Of five windows one goes on, one ends by a cost after two steps ahead, one there without a cost, one there by its time
    limit, and one has a new episode at the first step ahead, so that it is left out.
    """
    length, last = dreams.SEEN + dreams.AHEAD, dreams.SEEN + 1
    number = th.arange(length, dtype=th.float32)
    samples = SimpleNamespace(
        actions=number.expand(5, length)[..., None],
        is_first=th.zeros(5, length, dtype=th.bool),
        costs=th.zeros(5, length),
        continues=th.ones(5, length),
    )
    samples.is_first[0, 0] = samples.is_first[4, dreams.SEEN] = True
    samples.is_first[1:4, last + 1] = True
    samples.costs[1, last], samples.continues[1:3, last] = 1.0, 0.0
    samples.costs[:, last + 2] = 1.0  # of the next episode, but for the first window
    states = LatentState(*(number.view(-1, 1, 1, 1, 1).expand(-1, 5, 1, 1, 1) for _ in range(2)), th.zeros(length, 5, 1))

    def imagine(state: LatentState) -> LatentState:
        """The memory counts on from the last state that was seen, and the actions go with it."""
        assert th.equal(state.memory.flatten() + 1, state.action.flatten())
        return state._replace(memory=state.memory + 1)

    def predictions(numbers: th.Tensor) -> Predictions:
        return Predictions(numbers, numbers / 100, th.full_like(numbers, 0.8))

    model: Any = SimpleNamespace(
        rssm=SimpleNamespace(imagine=imagine),
        features=lambda state: state.memory,
        predict=lambda grids: predictions(grids[..., 0, 0, 0]),
        observe=lambda samples, hidden: SimpleNamespace(states=states),
    )
    model.imagine = partial(WorldModel.imagine, model)
    found = dreams.dream(model, cast(SequenceSamples, samples))
    expected = number[dreams.SEEN :].numpy() / 100 * 0.8 ** np.arange(dreams.AHEAD)
    np.testing.assert_allclose(found.imagined, np.tile(expected, (4, 1)), rtol=1e-5)
    came = np.zeros((4, dreams.AHEAD))
    came[0, 3] = came[1, 1] = 1.0
    assert (found.recorded == came).all()
    assert found.known[:3].all() and found.known[3].tolist() == [True] * 2 + [False] * (dreams.AHEAD - 2)


def test_dreams_are_scored_by_their_squared_error() -> None:
    """Of three windows one is not known at the second step: (.1 - 1)^2 and (.3 - 0)^2 there, a cost of two."""
    imagined, recorded = np.array([[0.5, 0.1], [0.0, 0.3], [0.0, 0.9]]), np.array([[0.0, 1.0], [0.0, 0.0], [1.0, 1.0]])
    found = dreams.Dreams(imagined, recorded, np.array([[True, True], [True, True], [True, False]]))
    name, foreseen, came, count, score = dreams.row("2", found, [1]).strip("| ").split(" | ")
    assert (name, foreseen, count, score) == ("2", "200.00", "1", "450.00")
    assert came.startswith("500.00 [")


def test_curves_on_other_episodes_are_not_pooled(tmp_path: Path) -> None:
    run = experiments.Run("esad-braking-v0", "as it is", Arm("esad_lend", {}), 0, tmp_path)
    assert experiments.end_of(run, 500_000) is None
    run.curve.write_text(json.dumps({"steps": 100, "unseen": 9_000_000}) + "\n")
    experiments.train(run, 100, 1, 9_000_000)
    refused = r"esad_lend_0\.jsonl has episodes from 9000000: give --unseen 9000000"
    with pytest.raises(SystemExit, match=refused):
        experiments.train(run, 100, 1, 500_000)
    with pytest.raises(SystemExit, match=refused):
        experiments.print_table([run], 500_000)


def test_energy_score_of_two_samples() -> None:
    """By hand: at 0 and 2 they are 1 from the truth 1, 2 from the truth 3 in the mean, and 2 from each other."""
    samples = th.tensor([0.0, 2.0]).view(2, 1, 1).expand(2, 2, 1)
    assert diffusion.energy_score(samples, th.tensor([[1.0], [3.0]])).tolist() == [0.0, 1.0]


def test_what_a_filter_changes_is_paired_by_episode() -> None:
    crashes = {"without": [1, 1, 1, 0, 0], "filter": [0, 0, 1, 1, 0]}
    slower = np.array([0.0, -1.0, -2.0, -1.0, -1.0])
    records = {
        name: [dict.fromkeys(filtered_driving.COMPARED, 5.0) | {"collisions": float(n)} for n in counts]
        for name, counts in crashes.items()
    }
    for record, change in zip(records["filter"], slower, strict=True):
        record["mean_speed"] += change
    paired = filtered_driving.compare(records["without"], records["filter"])
    assert (paired.prevented, paired.caused) == (2, 1)
    mean, low, high = paired.changes["speed [m/s]"]
    assert mean == pytest.approx(-1.0)
    assert high - mean == pytest.approx(2.776 * slower.std(ddof=1) / 5**0.5, abs=1e-3)  # Student's t with 4 degrees
    assert low + high == pytest.approx(-2.0)
    assert paired.changes["return"] == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("total", "steps"), [(20, [8, 16, 20]), (16, [8, 16])])
def test_a_learning_curve_has_one_point_at_the_end_and_all_costs(
    total: int, steps: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driving, "evaluate_model", lambda *args: [])
    monkeypatch.setattr(driving, "summarise", lambda records: {})
    curve = driving.LearningCurve(tmp_path / "curve.jsonl", "CountingEnv", every=8, seeds=range(7, 9))
    model = SAC("MlpPolicy", CountingEnv(), learning_starts=100, buffer_size=100, train_freq=4)
    model.set_logger(configure(str(tmp_path / "curve"), ["csv"]))
    model.learn(total, callback=curve)
    model.logger.close()
    lines = [json.loads(line) for line in (tmp_path / "curve.jsonl").read_text().splitlines()]
    assert [line["steps"] for line in lines] == steps and {line["unseen"] for line in lines} == {7}
    assert lines[-1]["cost_steps"] == [step for step in (3, 6, 10, 13, 17, 20) if step <= total]


def test_beside_a_curve_stands_what_has_been_logged_since_its_last_point(tmp_path: Path) -> None:
    log = tmp_path / "progress.csv"
    log.write_text(
        "time/total_timesteps,rollout/filter_rate,train/lagrangian_multiplier,time/fps\n10,1.0,5.0,1\n20,0.5,7.0,1\n30,0.0,,1\n"
    )
    assert driving.usual(log, 10) == {"rollout/filter_rate": 0.25, "train/lagrangian_multiplier": 7.0}
    assert driving.usual(log, 30) == {}


def names_one_of(row: str, pattern: str) -> bool:
    """Whether a row is about a test that a pattern is about."""
    words = re.findall(r"test_[a-z_]+", pattern.replace("?", ""))
    return any(word in row for word in words)
