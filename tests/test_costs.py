"""Reading costs from info dicts and summing them over episodes."""

import warnings
from typing import Any

import numpy as np
import pytest

from sb3_esad.common.costs import CostReader, EpisodeCosts


def test_reads_numbers_and_bools() -> None:
    infos: list[dict[str, Any]] = [
        {"cost": 1},
        {"cost": True},
        {"cost": np.float64(0.5)},
        {"cost": np.array(0.25)},
        {"cost": np.False_},
    ]
    costs = CostReader()(infos)
    assert costs.dtype == np.float32
    assert costs.tolist() == [1.0, 1.0, 0.5, 0.25, 0.0]
    assert CostReader("crashed")([{"crashed": True, "cost": 0.0}]).tolist() == [1.0]


def test_missing_cost_is_zero_with_one_warning() -> None:
    reader = CostReader()
    with pytest.warns(UserWarning, match='no "cost"') as caught:
        assert reader([{}, {}]).tolist() == [0.0, 0.0]
    assert len(caught) == 1 and "crashed" not in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert reader([{}, {"cost": 1.0}]).tolist() == [0.0, 1.0]


def test_missing_cost_points_to_crashed() -> None:
    with pytest.warns(UserWarning, match='cost_key="crashed"'):
        CostReader()([{"crashed": True}])


@pytest.mark.parametrize(
    "cost", [float("nan"), float("inf"), -1.0, [1.0], [[1.0], [1.0, 0.0]], np.zeros(2), np.zeros(1), "high", None, {}]
)
def test_refuses_what_is_not_a_cost(cost: Any) -> None:
    with pytest.raises(ValueError, match=r'^info\["cost"\] is .*; a cost must be one number from 0 to 1, or a bool\.$'):
        CostReader()([{"cost": cost}])


@pytest.mark.parametrize("cost", [2, 1.001, np.float32(25.0)])
def test_costs_above_one_are_to_be_divided(cost: Any) -> None:
    with pytest.raises(ValueError, match="divide all costs and cost_limit by the largest possible cost"):
        CostReader()([{"cost": cost}])


def test_rounding_is_no_cost_above_one() -> None:
    assert CostReader()([{"cost": 1.0 + 1e-12}]).tolist() == [1.0]


def test_episode_costs() -> None:
    episodes = EpisodeCosts()
    assert episodes.add(np.array([1.0, 0.0]), np.array([False, False])) == []
    (first,) = episodes.add(np.array([1.0, 4.0]), np.array([True, False]))
    assert first == (0, 2.0, 2)
    both = episodes.add(np.array([0.0, 4.0]), np.array([True, True]))
    assert both == [(0, 0.0, 1), (1, 8.0, 3)]


def test_unfinished_episodes_can_be_forgotten() -> None:
    episodes = EpisodeCosts()
    episodes.add(np.ones(1), np.zeros(1, dtype=bool))
    episodes.clear()
    assert episodes.add(np.ones(1), np.ones(1, dtype=bool)) == [(0, 1.0, 1)]


def test_episode_costs_start_afresh_with_another_number_of_environments() -> None:
    episodes = EpisodeCosts()
    episodes.add(np.ones(2), np.zeros(2, dtype=bool))
    (only,) = episodes.add(np.ones(1), np.ones(1, dtype=bool))
    assert only == (0, 1.0, 1)
