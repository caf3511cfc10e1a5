"""Lanes measure what lies on them: along, across and towards where."""

import itertools
import math

import numpy as np
import pytest
from highway_env.road.lane import CircularLane, LineType
from hypothesis import given
from hypothesis import strategies as st

from sb3_esad.envs.geometry import wrap_angle
from sb3_esad.envs.lanes import Lane
from sb3_esad.envs.pieces import Piece, rounded, turning
from sb3_esad.envs.roads import Markings, Road, dashes
from sb3_esad.envs.routes import Route

NOTHING = Markings(np.zeros((0, 4, 2)), np.zeros(0, int), dashes(0, 0, 0), np.zeros(0, bool))

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


def ends_meet(pieces: list[Piece]) -> None:
    """Each piece starts where the one before it ends, and in its direction."""
    for piece, following in itertools.pairwise(pieces):
        np.testing.assert_allclose(piece.end, following.start, atol=1e-6)
        assert wrap_angle(piece.heading_at(piece.length) - following.heading) == pytest.approx(0.0, abs=1e-9)


pieces_ = st.builds(
    Piece,
    start=st.tuples(coordinates, coordinates),
    heading=st.floats(-math.pi, math.pi),
    length=st.floats(5.0, 60.0),
    curvature=st.sampled_from([0.0, 1 / 20, -1 / 20, 1 / 300]),
)


@given(pieces_, st.floats(-8.0, 8.0), st.floats(0.0, 1.0))
def test_pieces_beside_reversed_and_cut(piece: Piece, across: float, share: float) -> None:
    along = share * piece.length
    beside, back, rest = piece.beside(across), piece.reversed(), piece.cut(along, piece.length)
    np.testing.assert_allclose(beside.position(share * beside.length), piece.position(along, across), atol=1e-8)
    np.testing.assert_allclose(back.position(piece.length - along, -across), piece.position(along, across), atol=1e-8)
    np.testing.assert_allclose(rest.start, piece.position(along), atol=1e-8)
    np.testing.assert_allclose(rest.end, piece.end, atol=1e-8)
    assert wrap_angle(beside.heading_at(beside.length) - piece.heading_at(piece.length)) == pytest.approx(0.0, abs=1e-9)


def test_rounded_corners() -> None:
    pieces = rounded([(0.0, 0.0), (100.0, 0.0), (100.0, 80.0), (180.0, 80.0)], 20.0)
    assert [piece.curvature for piece in pieces] == pytest.approx([0.0, 1 / 20, 0.0, -1 / 20, 0.0])
    assert sum(piece.length for piece in pieces) == pytest.approx(80 + 10 * math.pi + 40 + 10 * math.pi + 60)
    np.testing.assert_allclose(pieces[-1].end, (180.0, 80.0), atol=1e-9)
    ends_meet(pieces)
    with pytest.raises(ValueError, match="too close for a radius of 50"):
        rounded([(0.0, 0.0), (100.0, 0.0), (100.0, 80.0), (180.0, 80.0)], 50.0)


@given(st.floats(-2.6, 2.6).filter(lambda turn: abs(turn) > 0.05), st.floats(3.0, 40.0), st.floats(3.0, 40.0))
def test_turning_leads_from_line_to_line(turn: float, before: float, after: float) -> None:
    corner = np.array([before, 0.0])
    end = corner + after * np.array([math.cos(turn), math.sin(turn)])
    pieces = turning((0.0, 0.0), 0.0, (float(end[0]), float(end[1])), turn)
    np.testing.assert_allclose(pieces[0].start, (0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(pieces[-1].end, end, atol=1e-2)
    assert wrap_angle(pieces[-1].heading_at(pieces[-1].length) - turn) == pytest.approx(0.0, abs=1e-9)
    ends_meet(pieces)


def test_no_way_to_turn() -> None:
    with pytest.raises(ValueError, match="their lines do not meet"):
        turning((0.0, 0.0), 0.0, (20.0, 4.0), 0.0)
    with pytest.raises(ValueError, match="their lines do not meet"):
        turning((0.0, 0.0), 0.0, (20.0, 10.0), -math.pi / 2)


def test_progress_counts_from_lane_to_lane_and_beside_them() -> None:
    bend = Piece((100.0, 0.0), 0.0, 50.0, 1 / 50)
    lanes = [
        Lane((0.0, 0.0), 0.0, 100.0, right=2),
        Lane(bend.start, bend.heading, bend.length, bend.curvature, right=3),
        Lane((0.0, 4.0), 0.0, 100.0, left=0),
        Lane(bend.beside(4.0).start, 0.0, bend.beside(4.0).length, bend.beside(4.0).curvature, left=1),
        Lane((0.0, -4.0), 0.0, 100.0),
    ]
    route = Route(Road(lanes, NOTHING), [0, 1], start=20.0, end=40.0)
    assert route.length == pytest.approx(120.0)
    assert route.contains.tolist() == [True, True, True, True, False]
    assert [route.progress(0, 20.0), route.progress(0, 100.0), route.progress(1, 40.0)] == pytest.approx([0.0, 80.0, 120.0])
    assert route.progress(3, lanes[3].length) == pytest.approx(130.0)
