"""Sums over the latest steps only: they equal those of a plain list."""

import numpy as np
import pytest

from sb3_esad.common.recent_sums import RecentSums


@pytest.mark.parametrize("at_once", [1, 4])
def test_equals_the_sum_over_a_list_of_the_latest_steps(at_once: int) -> None:
    sums, random, history = RecentSums(("costs",), steps=200, blocks=10), np.random.default_rng(0), []
    for _ in range(500):
        history.append(float(random.random()))
        sums.add(at_once, costs=history[-1])
        n = round(sums["steps"]) // at_once
        assert sums["costs"] == pytest.approx(sum(history[-n:]), rel=1e-4)
    assert 180 <= sums["steps"] <= 200


def test_what_is_not_named_stays() -> None:
    sums = RecentSums(("costs", "predicted"), steps=100, blocks=2)
    sums.add(20, costs=1.0)
    sums.add(0, predicted=3.0)
    assert (sums["steps"], sums["costs"], sums["predicted"]) == (20.0, 1.0, 3.0)
