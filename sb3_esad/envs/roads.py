"""Roads as arrays of straight lanes, onto which all road users are projected at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_esad.envs.geometry import Floats, wrap_angle

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

CAR_LENGTH = 5.0
NO_LANE = -1
LANE_WIDTH = 4.0
DASH_LENGTH, DASH_PERIOD = 8.0, 20.0  # [m]


@dataclass(frozen=True)
class Lane:
    """
    One straight lane and its place among the others.

    :param start: first point of the centre line [m]
    :param end: last point of the centre line [m]
    :param left: index of the lane one may change to on the left, ``NO_LANE`` if there is none
    :param right: the same on the right
    :param following: index of the lane that continues this one, ``NO_LANE`` if it just ends
    :param on_route: whether the ego vehicle's route leads along this lane
    :param speed_limit: [m/s]
    :param width: [m]
    """

    start: tuple[float, float]
    end: tuple[float, float]
    left: int = NO_LANE
    right: int = NO_LANE
    following: int = NO_LANE
    on_route: bool = True
    speed_limit: float = 30.0
    width: float = LANE_WIDTH


@dataclass(frozen=True)
class Markings:
    """
    What a drawing shows of a road, in metres.

    :param surfaces: convex pieces of asphalt with four corners each, drawn in this order, shape ``(p, 4, 2)``
    :param on_route: whether each piece belongs to the ego vehicle's route, shape ``(p,)``
    :param lines: painted lines and single dashes from point to point, fixed to the ground, shape ``(n, 2, 2)``
    :param dashed: whether each is a dash, shape ``(n,)``
    """

    surfaces: Floats
    on_route: Bools
    lines: Floats
    dashed: Bools


class Road:
    """
    Lanes as arrays, projected onto in one call.

    :param lanes: the lanes, referred to by their index
    :param markings: what the drawings show of them
    """

    def __init__(self, lanes: Sequence[Lane], markings: Markings) -> None:
        self.markings = markings
        self.start = np.array([lane.start for lane in lanes], dtype=np.float64)
        span = np.array([lane.end for lane in lanes], dtype=np.float64) - self.start
        self.length = np.hypot(span[:, 0], span[:, 1])
        self.direction = span / self.length[:, None]
        self.heading = np.arctan2(span[:, 1], span[:, 0])
        self.width = np.array([lane.width for lane in lanes])
        self.speed_limit = np.array([lane.speed_limit for lane in lanes])
        self.left = np.array([lane.left for lane in lanes])
        self.right = np.array([lane.right for lane in lanes])
        self.following = np.array([lane.following for lane in lanes])
        self.continued = np.flatnonzero(self.following != NO_LANE)
        self.on_route = np.array([lane.on_route for lane in lanes])

    def project(self, position: Floats) -> tuple[Floats, Floats]:
        """
        Coordinates of points along and across every lane.

        :param position: points, shape ``(n, 2)`` [m]
        :return: distance along the lane from its start, and to the right of its centre, each ``(lanes, n)`` [m]
        """
        x = position[:, 0] - self.start[:, :1]
        y = position[:, 1] - self.start[:, 1:]
        cos, sin = self.direction[:, :1], self.direction[:, 1:]
        return x * cos + y * sin, y * cos - x * sin

    def position(self, lane: int, along: float, across: float = 0.0) -> Floats:
        """
        Point at given coordinates of a lane.

        :param lane: index of the lane
        :param along: distance from its start [m]
        :param across: distance to the right of its centre [m]
        :return: the point, shape ``(2,)`` [m]
        """
        cos, sin = self.direction[lane]
        return np.asarray(self.start[lane] + along * self.direction[lane] + across * np.array([-sin, cos]))

    def overshoot(self, along: Floats) -> Floats:
        """
        How far points lie before the start or past the end of each lane.

        :param along: distance along each lane, shape ``(lanes, n)`` [m]
        :return: 0 within the lane, shape ``(lanes, n)`` [m]
        """
        return np.maximum(along - self.length[:, None], 0.0) + np.maximum(-along, 0.0)

    def closest_lane(self, along: Floats, across: Floats, heading: Floats) -> Ints:
        """
        Lane each point is on, by distance plus difference in heading (as highway-env does).

        :param along: from :meth:`project`, shape ``(lanes, n)`` [m]
        :param across: from :meth:`project`, shape ``(lanes, n)`` [m]
        :param heading: of the users, shape ``(n,)`` [rad]
        :return: lane indices, shape ``(n,)``
        """
        turn = np.abs(wrap_angle(heading - self.heading[:, None]))
        return np.asarray(np.argmin(np.abs(across) + self.overshoot(along) + turn, axis=0))

    def contains(self, position: Floats) -> Bools:
        """
        Whether points lie on any lane's surface.

        :param position: points, shape ``(n, 2)`` [m]
        :return: truth values, shape ``(n,)``
        """
        along, across = self.project(position)
        inside = (np.abs(across) <= self.width[:, None] / 2) & (along >= 0) & (along <= self.length[:, None])
        return np.asarray(inside.any(0))

    def room(self, lane: int, across: Floats) -> tuple[float, float]:
        """
        Space from a point to the edges of the lanes one may change to, one after the other.

        :param lane: the lane on which the point is
        :param across: of the point on every lane, shape ``(lanes,)`` [m]
        :return: to the left and to the right, negative past the edge [m]
        """
        leftmost, rightmost = self._outermost(lane, self.left), self._outermost(lane, self.right)
        return (
            float(self.width[leftmost] / 2 + across[leftmost]),
            float(self.width[rightmost] / 2 - across[rightmost]),
        )

    @staticmethod
    def _outermost(lane: int, beside: Ints) -> int:
        while beside[lane] != NO_LANE:
            lane = int(beside[lane])
        return lane

    def end(self, lane: int) -> Floats:
        """
        Last point of a lane's centre line.

        :param lane: index of the lane
        :return: shape ``(2,)`` [m]
        """
        return self.position(lane, float(self.length[lane]))


def dashes(start: float, end: float, y: float) -> Floats:
    """
    Dashed line parallel to the x axis. Its period of 20 m makes motion visible at 5 Hz and 30 m/s, 6 m a frame.

    :param start: x of the first dash [m]
    :param end: no dash starts past this x [m]
    :param y: [m]
    :return: dashes, shape ``(n, 2, 2)`` [m]
    """
    first = np.arange(start, end, DASH_PERIOD)
    last = np.minimum(first + DASH_LENGTH, end)
    return np.stack([np.stack([first, np.full_like(first, y)], -1), np.stack([last, np.full_like(first, y)], -1)], 1)
