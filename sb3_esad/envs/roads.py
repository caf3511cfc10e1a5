"""Roads as arrays of lanes, onto which all road users are projected at once."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sb3_esad.envs.geometry import Floats, directions, wrap_angle
from sb3_esad.envs.lanes import NO_LANE, Lane

Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

DASH_LENGTH, DASH_PERIOD = 8.0, 20.0  # [m]


@dataclass(frozen=True)
class Markings:
    """
    What a drawing shows of a road, in metres.

    :param surfaces: convex pieces of asphalt with four corners each, shape ``(p, 4, 2)``
    :param lane: index of a lane that runs along each piece, shape ``(p,)``
    :param lines: painted lines and single dashes from point to point, fixed to the ground, shape ``(n, 2, 2)``
    :param dashed: whether each is a dash, shape ``(n,)``
    """

    surfaces: Floats
    lane: Ints
    lines: Floats
    dashed: Bools

    def with_route_on_top(self, route: Bools) -> tuple[Floats, Bools]:
        """
        Order the pieces of asphalt for drawing.

        :param route: whether each lane belongs to the ego vehicle's route, shape ``(lanes,)``
        :return: ``surfaces``, and whether each belongs to the route, these last
        """
        on_route = route[self.lane]
        order = np.argsort(on_route, kind="stable")
        return self.surfaces[order], on_route[order]


class Road:
    """
    Lanes as arrays, projected onto in one call.

    :param lanes: the lanes, referred to by their index
    :param markings: what the drawings show of them
    """

    def __init__(self, lanes: Sequence[Lane], markings: Markings) -> None:
        self.lanes = tuple(lanes)
        self.markings = markings
        self.start = np.array([lane.start for lane in lanes], dtype=np.float64)
        self.heading = np.array([lane.heading for lane in lanes], dtype=np.float64)
        self.length = np.array([lane.length for lane in lanes], dtype=np.float64)
        self.curvature = np.array([lane.curvature for lane in lanes], dtype=np.float64)
        self._origin, self._direction = self.start.T[:, :, None].copy(), directions(self.heading).T[:, :, None]
        self.width = np.array([lane.width for lane in lanes])
        self._half_width = self.width[:, None] / 2
        self.speed_limit = np.array([lane.speed_limit for lane in lanes])
        self.left = np.array([lane.left for lane in lanes])
        self.right = np.array([lane.right for lane in lanes])
        self.following = np.array([lane.following for lane in lanes])
        self.continues = np.isin(np.arange(len(lanes)), self.following)
        """Whether each lane continues another one."""
        self.row_of = np.array([self.row(lane, self.left)[-1] for lane in range(len(lanes))])
        """Lanes that one may change between have the same number here, that of the leftmost of them."""
        self._describe_arcs()

    def _describe_arcs(self) -> None:
        self.arcs = arcs = np.flatnonzero(self.curvature)
        curvature, heading = self.curvature[arcs], self.heading[arcs]
        self._sense, self._radius = np.sign(curvature)[:, None], 1 / np.abs(curvature)[:, None]
        self._centre = self.start[arcs] + np.stack([-np.sin(heading), np.cos(heading)], -1) / curvature[:, None]
        middle = heading + curvature * self.length[arcs] / 2
        self._middle = (middle - np.sign(curvature) * np.pi / 2)[:, None]  # direction from the centre to the arc's middle

    def project(self, position: Floats) -> tuple[Floats, Floats]:
        """
        Coordinates of points along and across every lane; straight lanes go on beyond their ends, arcs as circles.

        :param position: points, shape ``(n, 2)`` [m]
        :return: distance along the lane from its start, and to the right of its centre, each ``(lanes, n)`` [m]
        """
        offset = position.T[:, None] - self._origin
        (x_cos, y_sin), (y_cos, x_sin) = offset * self._direction, offset[::-1] * self._direction
        along, across = x_cos + y_sin, y_cos - x_sin
        if self.arcs.size:
            along[self.arcs], across[self.arcs] = self._project_onto_arcs(position)
        return along, across

    def _project_onto_arcs(self, position: Floats) -> tuple[Floats, Floats]:
        x, y = position[:, 0] - self._centre[:, :1], position[:, 1] - self._centre[:, 1:]
        turned = wrap_angle(np.arctan2(y, x) - self._middle) * self._sense
        along = self.length[self.arcs, None] / 2 + turned * self._radius
        return along, (self._radius - np.hypot(x, y)) * self._sense

    def heading_at(self, lanes: Ints, along: Floats) -> Floats:
        """
        Direction of lanes.

        :param lanes: indices, shape ``(n,)``
        :param along: distance from the start of each [m]
        :return: not wrapped, shape ``(n,)`` [rad]
        """
        return self.heading[lanes] + self.curvature[lanes] * along

    def position(self, lane: int, along: float, across: float = 0.0) -> Floats:
        """
        Point at given coordinates of a lane.

        :param lane: index of the lane
        :param along: distance from its start [m]
        :param across: distance to the right of its centre [m]
        :return: the point, shape ``(2,)`` [m]
        """
        return self.lanes[lane].position(along, across)

    def overshoot(self, along: Floats) -> Floats:
        """
        How far points lie before the start or past the end of each lane.

        :param along: distance along each lane, shape ``(lanes, n)`` [m]
        :return: 0 within the lane, shape ``(lanes, n)`` [m]
        """
        return np.maximum(np.maximum(along - self.length[:, None], -along), 0.0)

    def with_lanes_beside(self, lanes: Iterable[int]) -> set[int]:
        """
        Add the lanes that one may change to.

        :param lanes: indices of lanes
        :return: these and all lanes of the same direction beside them
        """
        return {each for lane in lanes for beside in (self.left, self.right) for each in self.row(lane, beside)}

    def towards(self, lanes: Iterable[int]) -> Ints:
        """
        Tell how to get onto given lanes from those beside them.

        :param lanes: indices of lanes
        :return: for every lane the one to change to next, itself if there is none, shape ``(lanes,)``
        """
        beside = np.arange(len(self.length))
        for lane in lanes:
            for row in (self.row(lane, self.left), self.row(lane, self.right)):
                beside[row[1:]] = row[:-1]
        return beside

    def leads_astray(self, path: Sequence[int]) -> Bools:
        """
        Find the lanes beside a path that one must get off in time.

        :param path: indices of lanes that are taken one after the other
        :return: for every lane whether it is beside one of the path but continued to elsewhere, shape ``(lanes,)``
        """
        astray = np.zeros(len(self.length), dtype=bool)
        for lane, following in itertools.pairwise(path):
            beside = list(self.with_lanes_beside([lane]) - {lane})
            leads_to = self.following[beside]
            astray[beside] = (leads_to == NO_LANE) | (self.row_of[leads_to] != self.row_of[following])
        return astray

    @staticmethod
    def row(lane: int, beside: Ints) -> list[int]:
        """
        Go from lane to lane to one side.

        :param lane: index of the first
        :param beside: ``left`` or ``right``
        :return: the first lane and all that follow, to the outermost
        """
        row = [lane]
        while beside[row[-1]] != NO_LANE:
            row.append(int(beside[row[-1]]))
        return row

    def closest_lane(self, along: Floats, distance: Floats, heading: Floats, handicap: Floats) -> Ints:
        """
        Lane each point is on, by distance plus difference in heading (as highway-env does).

        :param along: from :meth:`project`, shape ``(lanes, n)`` [m]
        :param distance: from each lane, shape ``(lanes, n)`` [m]
        :param heading: of the users, shape ``(n,)`` [rad]
        :param handicap: added to the distance, shape ``(lanes, n)`` [m]
        :return: lane indices, shape ``(n,)``
        """
        turn = heading - self.heading[:, None]
        if self.arcs.size:
            turn -= self.curvature[:, None] * along
        total = np.abs(wrap_angle(turn))
        total += distance
        total += handicap
        return np.asarray(total.argmin(0))

    def covers(self, aside: Floats, overshoot: Floats) -> Bools:
        """
        Whether points lie on the surfaces of lanes.

        :param aside: distance from the centre of each lane, shape ``(lanes, n)`` [m]
        :param overshoot: from :meth:`overshoot`, shape ``(lanes, n)`` [m]
        :return: truth values, shape ``(lanes, n)``
        """
        return np.asarray((aside <= self._half_width) & (overshoot == 0))

    def room(self, lane: int, across: Floats) -> tuple[float, float]:
        """
        Space from a point to the edges of the lanes one may change to, one after the other.

        :param lane: the lane on which the point is
        :param across: of the point on every lane, shape ``(lanes,)`` [m]
        :return: to the left and to the right, negative past the edge [m]
        """
        leftmost, rightmost = self.row(lane, self.left)[-1], self.row(lane, self.right)[-1]
        return (
            float(self.width[leftmost] / 2 + across[leftmost]),
            float(self.width[rightmost] / 2 - across[rightmost]),
        )

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
