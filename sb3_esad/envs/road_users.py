"""All road users as arrays: their bodies, how they move, and where they are on the lanes."""

from collections.abc import Iterator, Sequence

import numpy as np

from sb3_esad.envs.geometry import Floats
from sb3_esad.envs.lanes import CAR_LENGTH, LANE_WIDTH, NO_LANE
from sb3_esad.envs.roads import Bools, Ints, Road
from sb3_esad.envs.users import Kind, User

EGO = 0  # row of the ego vehicle in every array
TOP_SPEED = 40.0  # [m/s]
LANE_MARGIN = 1.0  # who moves and is this far past the line still counts as being in the lane [m]
INTENTION_HORIZON = 1.5  # others read where the ego vehicle is going from where it will be after this time [s]
OFF_PATH = 1.5  # where lanes overlap, one is on that of one's path even if another is as much nearer [m]
LOOKAHEAD = 3  # lanes that are looked into beyond the present one


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
        self.radius = np.hypot(self.size[:, 0], self.size[:, 1]) / 2
        self.kind = np.array([user.kind for user in users], dtype=np.int64)
        self._margin = np.where(self.kind == Kind.STATIC, self.size[:, 1] / 2, LANE_MARGIN)
        self._any_on_foot = bool((self.kind == Kind.PERSON).any())
        self.drivers = np.flatnonzero([user.drives for user in users])
        self.outsiders = np.setdiff1d(np.arange(len(users)), self.drivers)
        self.acceleration = np.zeros(len(users))
        self.wheel_angle = np.zeros(len(users))
        self.next_lane, self.towards_path, self.leads_astray, off_path = self._follow_paths(users)
        self._handicap = np.concatenate([off_path, off_path[self.outsiders]]).T
        self._rows = np.arange(len(users))
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

    def _locate(self) -> None:
        road, count = self.road, len(self.speed)
        self.direction = np.stack([np.cos(self.heading), np.sin(self.heading)], -1)
        self.velocity = self.speed[:, None] * self.direction
        soon = self.position[self.outsiders] + INTENTION_HORIZON * self.velocity[self.outsiders]
        along, across = road.project(np.concatenate([self.position, soon]))
        heading = np.concatenate([self.heading, self.heading[self.outsiders]])
        lane = road.closest_lane(along, across, heading, self._handicap)
        self.along, self.across = along[:, :count], across[:, :count]
        self.lane, self.target_lane[self.outsiders] = lane[:count], lane[count:]
        within = np.abs(self.across) <= road.width[:, None] / 2 + self._margin
        self.present = within & (road.overshoot(self.along) <= CAR_LENGTH)
        # Others make room for a user that they do not steer in the lane where it will soon be, too.
        rows = self.outsiders
        if self._any_on_foot:  # people beside the road are in nobody's way
            soon_off = np.abs(across[lane[count:], np.arange(count, len(lane))])
            rows = rows[(self.kind[rows] != Kind.PERSON) | (soon_off <= LANE_WIDTH / 2)]
        self.present[self.target_lane[rows], rows] = True
        self.reach, there = self.look_ahead(self._rows, self.lane)
        self.front, self.rear = self._nearest(self._rows, self.reach, there)

    def look_ahead(self, rows: Ints, lanes: Ints) -> tuple[Floats, Bools]:
        """
        Place everybody along given lanes and those that some users take after them.

        :param rows: users, shape ``(n,)``
        :param lanes: the lane to look at for each of them, shape ``(n,)``
        :return: distance of every user from the start of the lane, by its projection onto it if it is on none of them [m]; and
            whether it is on one of them; each ``(n, users)``
        """
        place, there = self.along[lanes], self.present[lanes]
        for going, following, passed in self.lanes_ahead(rows, lanes):
            beyond = self.present[following] & ~there[going]
            place[going] = np.where(beyond, passed[:, None] + self.along[following], place[going])
            there[going] |= beyond
        return place, there

    def lanes_ahead(self, rows: Ints, lanes: Ints) -> Iterator[tuple[Ints, Ints, Floats]]:
        """
        Go on from lane to lane, as users take them.

        :param rows: users, shape ``(n,)``
        :param lanes: the lane from which each goes on, shape ``(n,)``
        :return: for the first lanes ahead, then for the second and so on: the places in ``rows`` of those who have one, that
            lane of each, and how far its start is from the start of the lane from which they came [m]
        """
        going, passed = np.arange(len(rows)), np.zeros(len(rows))
        for _ in range(LOOKAHEAD):
            passed, lanes = passed + self.road.length[lanes], self.next_lane[rows[going], lanes]
            on = lanes != NO_LANE
            if not on.any():
                return
            going, lanes, passed = going[on], lanes[on], passed[on]
            yield going, lanes, passed

    def neighbours(self, rows: Ints, lanes: Ints) -> tuple[Ints, Ints]:
        """
        Nearest user ahead of and behind each of some users, on given lanes.

        :param rows: users, shape ``(n,)``
        :param lanes: the lane to look at for each of them, shape ``(n,)``
        :return: rows of those ahead and of those behind, each ``(n,)``, -1 where there is nobody
        """
        return self._nearest(rows, *self.look_ahead(rows, lanes))

    @staticmethod
    def _nearest(rows: Ints, place: Floats, there: Bools) -> tuple[Ints, Ints]:
        order = np.arange(len(rows))
        gap = place - place[order, rows][:, None]
        gap[~there] = np.nan
        gap[order, rows] = np.nan
        ahead, behind = np.where(gap >= 0, gap, np.inf), np.where(gap < 0, gap, -np.inf)
        front, rear = ahead.argmin(1), behind.argmax(1)
        return np.where(ahead[order, front] < np.inf, front, -1), np.where(behind[order, rear] > -np.inf, rear, -1)

    def distance(self, rows: Ints, others: Ints) -> Floats:
        """
        How far others are ahead, along the lanes that users take.

        :param rows: users, shape ``(n,)``
        :param others: shape ``(n,)``
        :return: negative behind, shape ``(n,)`` [m]
        """
        return self.reach[rows, others] - self.reach[rows, rows]

    def move(self, dt: float) -> None:
        """
        Move every user by its acceleration and wheel angle: a kinematic bicycle with its axles at the ends.

        :param dt: time step [s]
        """
        slip = np.arctan(0.5 * np.tan(self.wheel_angle))
        course = self.heading + slip
        self.position[:, 0] += self.speed * np.cos(course) * dt
        self.position[:, 1] += self.speed * np.sin(course) * dt
        self.heading += self.speed * np.sin(slip) / (self.size[:, 0] / 2) * dt
        slowing = np.minimum(self.acceleration, TOP_SPEED - self.speed)
        acceleration = np.where(self.speed > TOP_SPEED, slowing, self.acceleration)
        self.speed = np.maximum(self.speed + acceleration * dt, 0.0)
        self._locate()
