"""All road users as arrays: their bodies, how they move, and where they are on the lanes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_esad.envs.geometry import Floats, directions, outlines, placed
from sb3_esad.envs.lanes import CAR_LENGTH, LANE_WIDTH, NO_LANE
from sb3_esad.envs.roads import Bools, Ints, Road
from sb3_esad.envs.users import Kind, User

EGO = 0  # row of the ego vehicle in every array
TOP_SPEED = 40.0  # [m/s]
LANE_MARGIN = 1.0  # who moves and is this far past the line still counts as being in the lane [m]
INTENTION_HORIZON = 1.5  # others read where the ego vehicle is going from where it will be after this time [s]
OFF_PATH = 1.5  # where lanes overlap, one is on that of one's path even if another is as much nearer [m]
LOOKAHEAD = 3  # lanes that are looked into beyond the present one


class LanesAhead(NamedTuple):
    """
    Lanes that some users will take after given ones, those of each user in order, the furthest first.

    :param order: the place of the user among them, shape ``(n,)``
    :param lane: shape ``(n,)``
    :param start: how far it starts from the start of the lane from which the user comes, shape ``(n,)`` [m]
    """

    order: Ints
    lane: Ints
    start: Floats


NOTHING_AHEAD = LanesAhead(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0))


class RoadUsers:
    """
    Road users on a road, row ``EGO`` being the ego vehicle; positions are projected onto the lanes once per move.

    :param road: the lanes
    :param users: who is there at the start, the ego vehicle first
    """

    def __init__(self, road: Road, users: Sequence[User]) -> None:
        self.road = road
        self.position = np.array([user.position for user in users], dtype=np.float64)
        self.heading = np.array([user.heading for user in users], dtype=np.float64)
        self.speed = np.array([user.speed for user in users], dtype=np.float64)
        self.size = np.array([user.size for user in users], dtype=np.float64)
        self._outline = outlines(self.size)
        self.half_length = self.size[:, 0] / 2
        self.radius = np.hypot(self.size[:, 0], self.size[:, 1]) / 2
        self.kind = np.array([user.kind for user in users], dtype=np.int64)
        self.is_vehicle = self.kind == Kind.VEHICLE
        self.drives = np.array([user.drives for user in users])
        self.drivers, self.outsiders = np.flatnonzero(self.drives), np.flatnonzero(~self.drives)
        self.acceleration = np.zeros(len(users))
        self.wheel_angle = np.zeros(len(users))
        self._rows = np.arange(len(users))
        margin = np.where(self.kind == Kind.STATIC, self.size[:, 1] / 2, LANE_MARGIN)
        self._berth = road.width[:, None] / 2 + margin
        self._any_on_foot = bool((self.kind == Kind.PERSON).any())
        self.next_lane, self.towards_path, self.leads_astray, off_path = self._follow_paths(users)
        self._now_and_soon = np.concatenate([self._rows, self.outsiders])
        self._handicap = off_path[self._now_and_soon].T.copy()
        self._any_astray, self._goes_on = bool(self.leads_astray.any()), bool((self.next_lane != NO_LANE).any())
        self._following_lanes, self._starts = self._foresee_lanes()
        self.target_lane = np.zeros(len(users), dtype=np.int64)
        self._locate()
        self.target_lane[:] = self.lane

    def _follow_paths(self, users: Sequence[User]) -> tuple[Ints, Ints, Bools, Floats]:
        """
        Read the paths; each array of shape ``(users, lanes)``.

        :return: the lane that each user takes after each lane; the one to change to from there in order to be on its path;
            whether the lane is beside the path but does not lead on to where the path goes; and what keeps the user off lanes
            that it will not take [m]
        """
        road = self.road
        following, towards = (np.tile(each, (len(users), 1)) for each in (road.following, np.arange(len(road.length))))
        astray, off_path = np.zeros(following.shape, dtype=bool), np.zeros(following.shape)
        for row, user in enumerate(users):
            if user.path:
                path, wanted = np.array(user.path[:-1], dtype=np.int64), np.array(user.path[1:], dtype=np.int64)
                beside = road.row_of[road.following[path]] == road.row_of[wanted]  # there one changes lane instead
                turns = (road.following[path] == NO_LANE) | ~beside
                following[row, path[turns]] = wanted[turns]
                towards[row] = road.towards(user.path)
                astray[row] = road.leads_astray(user.path)
                off_path[row] = OFF_PATH
                off_path[row, list(road.with_lanes_beside(user.path))] = 0.0
        return following, towards, astray, off_path

    def _foresee_lanes(self) -> tuple[Ints, Floats]:
        """
        Go on from every lane, as each user would; the furthest comes first in each array.

        :return: the lanes, ``NO_LANE`` after the last one, and how far their starts are from the start of the first [m]; each
            of shape ``(users, lanes, LOOKAHEAD)``
        """
        lanes, passed = np.broadcast_to(np.arange(len(self.road.length)), self.next_lane.shape), np.zeros(self.next_lane.shape)
        ahead, starts = [], []
        for _ in range(LOOKAHEAD):
            passed = passed + self.road.length[lanes]
            lanes = np.where(lanes == NO_LANE, NO_LANE, self.next_lane[self._rows[:, None], lanes])
            ahead.append(lanes)
            starts.append(passed)
        return np.stack(ahead[::-1], axis=-1), np.stack(starts[::-1], axis=-1)

    def _locate(self) -> None:
        road, count = self.road, len(self.speed)
        self.direction = directions(self.heading)
        self.velocity = self.speed[:, None] * self.direction
        self.corners = placed(self._outline, self.position, self.direction)
        soon = (self.position + INTENTION_HORIZON * self.velocity)[self.outsiders]
        along, across = road.project(np.concatenate([self.position, soon, self.corners[EGO]]))
        aside, overshoot = np.abs(across), road.overshoot(along)
        self.along, self.across = along[:, :count], across[:, :count]
        self.present = (aside[:, :count] <= self._berth) & (overshoot[:, :count] <= CAR_LENGTH)
        self.off_road = not all(road.covers(aside[:, -4:], overshoot[:, -4:]))
        lane = road.closest_lane(
            along[:, :-4], (aside + overshoot)[:, :-4], self.heading[self._now_and_soon], self._handicap
        )
        self.lane, self.target_lane[self.outsiders] = lane[:count], lane[count:]
        self._note_intentions(aside[:, count:])
        self.ahead = self.lanes_ahead(self._rows, self.lane)
        self.gap, there = self._look(self._rows, self.lane, self.ahead)
        self.front = nearest_ahead(self.gap, there)

    def _note_intentions(self, soon_aside: Floats) -> None:
        """Others make room for a user that they do not steer in the lane where it will soon be, too."""
        rows = self.outsiders
        if self._any_on_foot:  # people beside the road are in nobody's way
            soon_off = soon_aside[self.target_lane[rows], np.arange(len(rows))]
            rows = rows[(self.kind[rows] != Kind.PERSON) | (soon_off <= LANE_WIDTH / 2)]
        self.present[self.target_lane[rows], rows] = True

    def gaps(self, rows: Ints, lanes: Ints) -> tuple[Floats, Bools]:
        """
        Place everybody along given lanes and those that some users take after them.

        :param rows: users, shape ``(n,)``
        :param lanes: the lane to look at for each of them, shape ``(n,)``
        :return: how far everybody is ahead of each of them, by the projection onto the lane of who is on none of these [m]; and
            whether it is somebody else who is on one of them; each ``(n, users)``
        """
        return self._look(rows, lanes, self.lanes_ahead(rows, lanes))

    def _look(self, rows: Ints, lanes: Ints, ahead: LanesAhead) -> tuple[Floats, Bools]:
        place, there = self.along[lanes], self.present[lanes]
        if ahead.order.size:
            seen, others = self.present[ahead.lane].nonzero()
            beyond = ~there[ahead.order[seen], others]
            seen, others = seen[beyond], others[beyond]
            order, distance = ahead.order[seen], ahead.start[seen] + self.along[ahead.lane[seen], others]
            place[order, others], there[order, others] = distance, True  # the nearest lane comes last and wins
        order = np.arange(len(rows))
        there[order, rows] = False
        return place - place[order, rows][:, None], there

    def lanes_ahead(self, rows: Ints, lanes: Ints) -> LanesAhead:
        """
        Go on from lane to lane, as users take them.

        :param rows: users, shape ``(n,)``
        :param lanes: the lane from which each goes on, shape ``(n,)``
        :return: the lanes ahead of all of them
        """
        if not self._goes_on:
            return NOTHING_AHEAD
        following = self._following_lanes[rows, lanes]
        order, step = (following != NO_LANE).nonzero()
        return LanesAhead(order, following[order, step], self._starts[rows[order], lanes[order], step])

    def neighbours(self, rows: Ints, lanes: Ints) -> tuple[Ints, Ints]:
        """
        Nearest user ahead of and behind each of some users, on given lanes.

        :param rows: users, shape ``(n,)``
        :param lanes: the lane to look at for each of them, shape ``(n,)``
        :return: rows of those ahead and of those behind, each ``(n,)``, -1 where there is nobody
        """
        gap, there = self.gaps(rows, lanes)
        return nearest_ahead(gap, there), nearest_behind(gap, there)

    def distance(self, rows: Ints, others: Ints) -> Floats:
        """
        How far others are ahead, along the lanes that users take.

        :param rows: users, shape ``(n,)``
        :param others: shape ``(n,)``
        :return: negative behind, shape ``(n,)`` [m]
        """
        return self.gap[rows, others]

    def move(self, dt: float) -> None:
        """
        Move every user by its acceleration and wheel angle: a kinematic bicycle with its axles at the ends.

        :param dt: time step [s]
        """
        slip = np.arctan(0.5 * np.tan(self.wheel_angle))
        course = self.heading + slip
        self.position += self.speed[:, None] * directions(course) * dt
        self.heading += self.speed * np.sin(slip) / self.half_length * dt
        slowing = np.minimum(self.acceleration, TOP_SPEED - self.speed)
        acceleration = np.where(self.speed > TOP_SPEED, slowing, self.acceleration)
        self.speed = np.maximum(self.speed + acceleration * dt, 0.0)
        self._locate()


def nearest_ahead(gap: Floats, there: Bools) -> Ints:
    """
    Find who is next.

    :param gap: how far each user is ahead of each of n others, shape ``(n, users)`` [m]
    :param there: whether it counts, shape ``(n, users)``
    :return: its row, -1 where there is nobody, shape ``(n,)``
    """
    ahead = there & (gap >= 0)
    nearest = np.where(ahead, gap, np.inf).argmin(1)
    nearest[~ahead[np.arange(len(gap)), nearest]] = -1
    return nearest


def nearest_behind(gap: Floats, there: Bools) -> Ints:
    """
    Find who follows.

    :param gap: how far each user is ahead of each of n others, shape ``(n, users)`` [m]
    :param there: whether it counts, shape ``(n, users)``
    :return: its row, -1 where there is nobody, shape ``(n,)``
    """
    behind = there & (gap < 0)
    nearest = np.where(behind, gap, -np.inf).argmax(1)
    nearest[~behind[np.arange(len(gap)), nearest]] = -1
    return nearest
