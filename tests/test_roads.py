"""Lanes measure what lies on them: along, across and towards where."""

import math

import numpy as np
import pytest
from highway_env.road.lane import CircularLane, LineType
from hypothesis import given
from hypothesis import strategies as st

from sb3_esad.envs.geometry import wrap_angle
from sb3_esad.envs.lanes import Lane
from sb3_esad.envs.roads import Markings, Road, dashes

NOTHING = Markings(np.zeros((0, 4, 2)), np.zeros(0, bool), dashes(0, 0, 0), np.zeros(0, bool))

coordinates = st.floats(-300.0, 300.0)
arcs = st.builds(
    Lane,
    start=st.tuples(coordinates, coordinates),
    heading=st.floats(-math.pi, math.pi),
    length=st.floats(5.0, 60.0),
    curvature=st.sampled_from([0.0, 1 / 20, -1 / 20, 1 / 80, -1 / 80, 1 / 300]),
)


@given(arcs, st.floats(0.0, 1.0), st.floats(-10.0, 10.0))
def test_projection_inverts_position(lane: Lane, share: float, across: float) -> None:
    road = Road([lane], NOTHING)
    along = share * lane.length
    seen_along, seen_across = road.project(road.position(0, along, across)[None])
    assert seen_along[0, 0] == pytest.approx(along, abs=1e-8)
    assert seen_across[0, 0] == pytest.approx(across, abs=1e-8)


@given(arcs, st.floats(0.0, 1.0))
def test_heading_is_the_direction_in_which_the_position_moves(lane: Lane, share: float) -> None:
    road, step = Road([lane], NOTHING), 1e-4
    along = share * lane.length
    moved = road.position(0, along + step) - road.position(0, along - step)
    heading = road.heading_at(np.array([0]), np.array([along]))[0]
    assert wrap_angle(np.arctan2(moved[1], moved[0]) - heading) == pytest.approx(0.0, abs=1e-6)
    assert np.hypot(*moved) == pytest.approx(2 * step, rel=1e-6)


@given(arcs, coordinates, coordinates)
def test_the_mirrored_lane_sees_the_mirrored_point(lane: Lane, x: float, y: float) -> None:
    mirrored = Lane((lane.start[0], -lane.start[1]), -lane.heading, lane.length, -lane.curvature)
    along, across = Road([lane], NOTHING).project(np.array([[x, y]]))
    other_along, other_across = Road([mirrored], NOTHING).project(np.array([[x, -y]]))
    # Half a circle from the middle of an arc both directions round it are as long
    turn = 2 * math.pi / abs(lane.curvature) if lane.curvature else math.inf
    assert min(abs(other_along - along)[0, 0], abs(abs(other_along - along)[0, 0] - turn)) < 1e-6
    assert other_across[0, 0] == pytest.approx(-across[0, 0], abs=1e-8)


@pytest.mark.parametrize("clockwise", [True, False])
def test_arcs_are_those_of_highway_env(clockwise: bool) -> None:
    stock = CircularLane([0.0, 0.0], 30.0, 0.0, 1.5 if clockwise else -1.5, clockwise, line_types=[LineType.NONE] * 2)
    sense = 1.0 if clockwise else -1.0
    ours = Road([Lane((30.0, 0.0), sense * math.pi / 2, 45.0, sense / 30.0)], NOTHING)
    for x, y in ((28.0, 5.0 * sense), (20.0, 22.0 * sense), (33.0, 1.0 * sense), (10.0, 31.0 * sense)):
        along, across = ours.project(np.array([[x, y]]))
        assert (along[0, 0], across[0, 0]) == pytest.approx(stock.local_coordinates(np.array([x, y])))
        heading = ours.heading_at(np.array([0]), along[0])[0]
        assert wrap_angle(heading - stock.heading_at(along[0, 0])) == pytest.approx(0.0, abs=1e-9)
