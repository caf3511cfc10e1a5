"""Boxes overlap or are apart, as a brute force over many of their points says."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sb3_esad.envs.geometry import box_corners, box_distances, boxes_overlap

boxes = st.tuples(st.floats(-6.0, 6.0), st.floats(-6.0, 6.0), st.floats(-4.0, 4.0), st.floats(0.5, 6.0), st.floats(0.5, 3.0))
GRID = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 21), np.linspace(-0.5, 0.5, 21)), -1).reshape(-1, 2)


def corners(box: tuple[float, ...]) -> np.ndarray:
    x, y, heading, length, width = box
    return box_corners(np.array([[x, y]]), np.array([heading]), np.array([[length, width]]))[0]


def points(box: tuple[float, ...]) -> np.ndarray:
    """Points all over a box, shape ``(n, 2)``."""
    x, y, heading, length, width = box
    local = GRID * [length, width]
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    return local @ turn + [x, y]


@given(boxes, boxes)
def test_distance_is_that_of_the_nearest_points(first: tuple[float, ...], second: tuple[float, ...]) -> None:
    offset = points(first)[:, None] - points(second)[None]
    nearest = np.sqrt((offset**2).sum(-1).min())
    found = box_distances(corners(first), corners(second)[None])[0]
    spacing = np.hypot(first[3], first[4]) / 40 + np.hypot(second[3], second[4]) / 40
    assert nearest - spacing - 1e-9 <= found <= nearest + 1e-9
    assert (found == 0.0) == bool(boxes_overlap(corners(first), corners(second)[None])[0])


@given(boxes, boxes)
def test_distance_goes_both_ways(first: tuple[float, ...], second: tuple[float, ...]) -> None:
    there = box_distances(corners(first), corners(second)[None])[0]
    back = box_distances(corners(second), corners(first)[None])[0]
    assert np.isclose(there, back)
