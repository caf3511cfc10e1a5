"""Road users look along their own lane and the lanes that they will take after it."""

import numpy as np
import pytest

from sb3_esad.envs.lanes import NO_LANE, Lane
from sb3_esad.envs.paths import LOOKAHEAD, Paths
from sb3_esad.envs.road_users import nearest_ahead, nearest_behind
from sb3_esad.envs.roads import Markings, Road
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import User

NOTHING = Markings(np.zeros((0, 4, 2)), np.zeros(0, int), np.zeros((0, 2, 2)), np.zeros(0, bool))
LENGTHS = (30.0, 20.0, 40.0, 25.0, 50.0)


def chain() -> Road:
    """Lanes 0 to 4 one after the other along the x axis, and lane 5, to which one may turn off after lane 1."""
    starts = np.cumsum([0.0, *LENGTHS])
    lanes = [
        Lane((float(start), 0.0), 0.0, length, following=index + 1 if index < 4 else NO_LANE)
        for index, (start, length) in enumerate(zip(starts[:-1], LENGTHS, strict=True))
    ]
    return Road([*lanes, Lane((50.0, 0.0), 0.5, 60.0)], NOTHING)


def test_lanes_ahead_are_those_of_the_path_and_where_they_start() -> None:
    paths = Paths(chain(), [User((0.0, 0.0)), User((0.0, 0.0), path=(1, 5))])
    outlook = paths.outlook(np.array([0, 1, 0]), np.array([0, 0, 3]))
    found: list[list[tuple[int, float]]] = [[], [], []]
    for order, lane, start in zip(outlook.order, outlook.further, outlook.starts, strict=True):
        found[order].append((int(lane), float(start)))
    assert found == [[(3, 90.0), (2, 50.0), (1, 30.0)], [(5, 50.0), (1, 30.0)], [(4, 25.0)]]
    assert max(map(len, found)) == LOOKAHEAD


def test_nobody_looks_past_the_end_of_a_road() -> None:
    road = Road([Lane((0.0, 4.0 * lane), 0.0, 100.0) for lane in range(2)], NOTHING)
    outlook = Paths(road, [User((0.0, 0.0))] * 3).outlook(np.arange(3), np.array([0, 1, 1]))
    assert outlook.order.size == outlook.further.size == outlook.starts.size == 0


@pytest.mark.parametrize(("x", "ahead"), [(12.0, 2.0), (35.0, 25.0), (65.0, 55.0), (100.0, 90.0), (5.0, -5.0)])
def test_gaps_are_measured_along_the_lanes_ahead(x: float, ahead: float) -> None:
    traffic = Traffic(chain(), [User((10.0, 0.0), drives=False), User((x, 0.0)), User((110.0, 30.0))])
    gap, there = traffic.gaps(traffic.paths.outlook(np.array([0]), np.array([0])))
    assert gap[0, 1] == pytest.approx(ahead)
    assert there[0].tolist() == [False, True, False], "not oneself, and not who is on no lane"
    assert nearest_ahead(gap, there).tolist() == [1 if ahead > 0 else -1]
    assert nearest_behind(gap, there).tolist() == [-1 if ahead > 0 else 1]


def test_who_is_on_several_lanes_counts_on_the_nearest() -> None:
    """Lanes 1, 2 and 3 lead to and fro on the same ground, so that who is on one of them is on all."""
    approach, there, back = Lane((-40.0, 0.0), 0.0, 40.0, following=1), ((0.0, 0.0), 0.0), ((40.0, 0.0), np.pi)
    road = Road([approach, Lane(*there, 40.0, following=2), Lane(*back, 40.0, following=3), Lane(*there, 40.0)], NOTHING)
    traffic = Traffic(road, [User((-30.0, 0.0), drives=False), User((25.0, 0.0)), User((15.0, 0.0))])
    for lane, expected in ((0, [55.0, 45.0]), (1, [55.0, 45.0]), (2, [-55.0, -45.0])):
        gap, present = traffic.gaps(traffic.paths.outlook(np.array([0]), np.array([lane])))
        assert present[0].tolist() == [False, True, True]
        np.testing.assert_allclose(gap[0, 1:], expected, err_msg=f"from lane {lane}")
