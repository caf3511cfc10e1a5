"""All road users as arrays: their bodies, how they move, and where they are on the lanes."""

from collections.abc import Sequence

import numpy as np

from sb3_esad.envs.geometry import Floats, directions, outlines, placed, wrap_angle
from sb3_esad.envs.lanes import CAR_LENGTH, LANE_WIDTH
from sb3_esad.envs.paths import Outlook, Paths
from sb3_esad.envs.roads import Bools, Ints, Road
from sb3_esad.envs.users import Kind, User

EGO = 0  # row of the ego vehicle in every array
TOP_SPEED = 40.0  # [m/s]
LANE_MARGIN = 1.0  # who moves and is this far past the line still counts as being in the lane [m]
INTENTION_HORIZON = 1.5  # others read where the ego vehicle is going from where it will be after this time [s]


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
        self.is_vehicle, self.is_person = self.kind == Kind.VEHICLE, self.kind == Kind.PERSON
        self._any_person = bool(self.is_person.any())
        self.drives = np.array([user.drives for user in users])
        self.drivers, self.outsiders = np.flatnonzero(self.drives), np.flatnonzero(~self.drives)
        self.acceleration = np.zeros(len(users))
        self.wheel_angle = np.zeros(len(users))
        self._rows = np.arange(len(users))
        margin = np.where(self.kind == Kind.STATIC, self.size[:, 1] / 2, LANE_MARGIN)
        self._berth = road.width[:, None] / 2 + margin
        self.paths = Paths(road, users)
        self._now_and_soon = np.concatenate([self._rows, self.outsiders])
        self._handicap = self.paths.handicap[self._now_and_soon].T.copy()
        self.target_lane = np.zeros(len(users), dtype=np.int64)
        self._locate()
        self.target_lane[:] = self.lane

    def _locate(self) -> None:
        """Find out, from positions, headings and speeds, where everybody is, and who is how far ahead of whom (``gap``)."""
        road, count = self.road, len(self.speed)
        self.direction = directions(self.heading)
        self.velocity = self.speed[:, None] * self.direction
        self.corners = placed(self._outline, self.position, self.direction)
        soon = (self.position + INTENTION_HORIZON * self.velocity).take(self.outsiders, axis=0)
        along, across = road.project(np.concatenate([self.position, soon, self.corners[EGO]]))  # the last four are corners
        aside, overshoot = np.abs(across), road.overshoot(along)
        self.along, self.across = along[:, :count], across[:, :count]
        self.present = (aside[:, :count] <= self._berth) & (overshoot[:, :count] <= CAR_LENGTH)
        self.off_road = not road.covers(aside[:, -4:], overshoot[:, -4:]).any(0).all()
        heading, distance = self.heading[self._now_and_soon], aside + overshoot
        lane = road.closest_lane(along[:, :-4], distance[:, :-4], heading, self._handicap)
        self.lane, self.target_lane[self.outsiders] = lane[:count], lane[count:]
        self._note_intentions(aside[:, count:])
        self.outlook = self.paths.outlook(self._rows, self.lane)
        self.gap, there = self.gaps(self.outlook)
        self.front = nearest_ahead(self.gap, there)

    def _note_intentions(self, soon_aside: Floats) -> None:
        """Others make room for a user that they do not steer in the lane where it will soon be, too."""
        rows = self.outsiders
        if self._any_person:  # people beside the road are in nobody's way
            soon_off = soon_aside[self.target_lane[rows], np.arange(len(rows))]
            rows = rows[~self.is_person[rows] | (soon_off <= LANE_WIDTH / 2)]
        self.present[self.target_lane[rows], rows] = True

    def gaps(self, outlook: Outlook) -> tuple[Floats, Bools]:
        """
        Place everybody along the lanes that some users look along.

        :param outlook: of n users
        :return: how far everybody is ahead of each of them, by the projection onto its first lane of who is on none of these
            [m]; and whether it is somebody else who is on one of them; both ``(n, users)``
        """
        place = self.along.take(outlook.lanes, axis=0)  # twice as fast as an index
        there = self.present.take(outlook.lanes, axis=0)
        if outlook.order.size:
            seen, others = self.present.take(outlook.further, axis=0).nonzero()
            beyond = ~there[outlook.order[seen], others]
            seen, others = seen[beyond], others[beyond]
            where = outlook.order[seen], others
            place[where] = outlook.starts[seen] + self.along[outlook.further[seen], others]  # the nearest comes last and wins
            there[where] = True
        themselves = np.arange(len(place)), outlook.rows
        there[themselves] = False
        return place - place[themselves][:, None], there

    def ego_on_lanes(self) -> tuple[Floats, Bools]:
        """
        Compare the ego vehicle with every lane.

        :return: the angle from the lane to it, within [-pi, pi) [rad], and whether its centre lies on the lane, each
            ``(lanes,)``
        """
        along, across = self.along[:, [EGO]], self.across[:, [EGO]]
        turns = wrap_angle(self.heading[EGO] - (self.road.heading + self.road.curvature * along[:, 0]))
        return turns, self.road.covers(np.abs(across), self.road.overshoot(along))[:, 0]

    def neighbours(self, rows: Ints, lanes: Ints) -> tuple[Ints, Ints]:
        """
        Nearest user ahead of and behind each of some users, on given lanes.

        :param rows: users, shape ``(n,)``
        :param lanes: the lane to look at for each of them, shape ``(n,)``
        :return: rows of those ahead and of those behind, each ``(n,)``, -1 where there is nobody
        """
        gap, there = self.gaps(self.paths.outlook(rows, lanes))
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
