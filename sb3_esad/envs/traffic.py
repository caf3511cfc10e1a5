"""Cars follow (IDM) and change lane (MOBIL) as in highway-env, one NumPy call for all."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from sb3_esad.envs.geometry import Floats, bounded, wrap_angle
from sb3_esad.envs.lanes import CAR_LENGTH, NO_LANE
from sb3_esad.envs.road_users import RoadUsers, nearest_ahead
from sb3_esad.envs.roads import Bools, Ints, Road
from sb3_esad.envs.users import Temper, User

HEADING_GAIN, LATERAL_GAIN = 1 / 0.2, 1 / 0.6  # [1/s]
MAX_WHEEL_ANGLE, MAX_APPROACH_ANGLE = np.pi / 3, np.pi / 4  # [rad]
MAX_ACCELERATION = 6.0  # [m/s^2]
LEAST = 0.01  # nothing is divided by a smaller speed or distance [m/s], [m]
EASY_BRAKING = 2.0  # cars slow down like this for lanes with a lower limit [m/s^2]
STOP_GAP, STOP_HEADWAY = CAR_LENGTH / 2 + 1.0, 0.3  # centre to line [m], [s]
BLIND_BEHIND = 25.0  # nobody changes to a lane this near to its start, where who follows from the lane before is not seen [m]
GET_BACK = 100.0  # from here on to the end of a lane it is time to be on the lane of one's path [m]
PURSUIT = 0.1  # cars take the direction that their lane will have after this time [s]


class Traffic(RoadUsers):
    """
    Road users of whom some drive themselves.

    :meth:`act` lets every self-driving car choose, on the same snapshot, its acceleration and wheel angle; :meth:`move`
    carries all users forward. Sources: Treiber et al., 2000 (IDM); Kesting et al., 2007 (MOBIL); the behaviour is that of
    ``highway_env.vehicle.behavior.IDMVehicle``, save that cars never reverse and look into the lanes that continue theirs.

    :param road: the lanes
    :param users: who is there at the start, the ego vehicle first
    """

    def __init__(self, road: Road, users: Sequence[User]) -> None:
        self.target_speed = np.array([user.target_speed for user in users], dtype=np.float64)
        self.timer = np.array([user.timer for user in users], dtype=np.float64)
        self.temper = {f.name: np.array([getattr(user.temper, f.name) for user in users]) for f in fields(Temper)}
        own = self.temper
        braking = 2 * np.sqrt(own["acceleration"] * own["braking"])
        self._following = np.stack([own["acceleration"], own["exponent"], own["gap"], own["headway"], braking])
        self.forced_braking = np.zeros(len(users))  # a scenario makes a car brake this hard, whatever it would do [m/s^2]
        self.stop_distance = np.full(len(users), np.inf)  # to a line before which a car must wait, from its centre [m]
        self._first_change = np.where(road.continues, BLIND_BEHIND, 0.0)  # from here on one may change to each lane [m]
        super().__init__(road, users)

    def _locate(self) -> None:
        super()._locate()
        self.speed_limit = self._foresee_limits()

    def _foresee_limits(self) -> Floats:
        """The speed from which each user can still slow down in time for the lanes ahead, shape ``(n,)``."""
        limits = self.road.speed_limit
        limit = limits[self.lane]
        _, _, rows, further, starts = self.outlook
        if rows.size:
            distance = np.maximum(starts - self.along[self.lane[rows], rows], 0.0)
            np.minimum.at(limit, rows, np.sqrt(limits[further] ** 2 + 2 * EASY_BRAKING * distance))
        return limit

    def following_acceleration(self, rows: Ints, front: Ints, judges: Ints) -> Floats:
        """
        Acceleration by the Intelligent Driver Model.

        :param rows: the users who would accelerate, shape ``(n,)``; -1 gives 0
        :param front: whom each would follow, shape ``(n,)``; -1 is a free road
        :param judges: the users whose temper is applied, shape ``(n,)``
        :return: accelerations, shape ``(n,)`` [m/s^2]
        """
        acceleration, exponent, gap, headway, braking = self._following.take(judges, axis=1)
        speed = self.speed[rows]
        desired = np.maximum(np.minimum(self.target_speed[rows], self.speed_limit[rows]), LEAST)
        distance = np.maximum(np.abs(self.distance(rows, front)), LEAST)
        (east, south), (cos, sin) = self.velocity.T, self.direction.T
        closing = (east[rows] - east[front]) * cos[rows] + (south[rows] - south[front]) * sin[rows]
        wanted = gap + speed * headway + speed * closing / braking
        crowding = (front >= 0) * (wanted / distance) ** 2
        return (rows >= 0) * acceleration * (1.0 - (speed / desired) ** exponent - crowding)

    def stopping_acceleration(self, rows: Ints) -> Floats:
        """
        Acceleration by the Intelligent Driver Model towards a line before which one must wait.

        :param rows: the users, shape ``(n,)``
        :return: infinite for who need not wait, shape ``(n,)`` [m/s^2]
        """
        distance, speed = self.stop_distance[rows], self.speed[rows]
        acceleration, _, _, _, braking = self._following.take(rows, axis=1)
        wanted = STOP_GAP + STOP_HEADWAY * speed + speed**2 / braking
        free = acceleration * (1.0 - (speed / np.maximum(self.target_speed[rows], LEAST)) ** 4)
        stopping = free - acceleration * (wanted / np.maximum(distance, 0.1)) ** 2
        return np.where(distance < np.inf, stopping, np.inf)

    def change_is_safe(self, rows: Ints, lanes: Ints) -> Bools:
        """
        Whether the new follower could brake gently enough if users changed lane, and they themselves.

        :param rows: the users who must change, shape ``(n,)``
        :param lanes: the lane each changes to, shape ``(n,)``
        :return: one verdict per user, shape ``(n,)``
        """
        front, rear = self.neighbours(rows, lanes)
        limit = -self.temper["imposed_braking"][rows]
        behind, own = self.following_acceleration(rear, rows, rows), self.following_acceleration(rows, front, rows)
        return (behind >= limit) & (own >= limit)

    def change_is_worth_it(self, rows: Ints, lanes: Ints) -> Bools:
        """
        Whether MOBIL recommends a lane change: safe for the new follower, and of advantage to those concerned.

        :param rows: the users who consider a change, shape ``(n,)``
        :param lanes: the lane each considers, shape ``(n,)``
        :return: one verdict per user, shape ``(n,)``
        """
        front, rear = self.neighbours(np.concatenate([rows, rows]), np.concatenate([lanes, self.lane[rows]]))
        new_front, old_front, new_rear, old_rear = *front.reshape(2, -1), *rear.reshape(2, -1)
        who = np.concatenate([new_rear, new_rear, rows, rows, old_rear, old_rear])
        whom = np.concatenate([new_front, rows, new_front, old_front, rows, old_front])
        outcomes = self.following_acceleration(who, whom, np.concatenate([rows] * 6)).reshape(6, -1)
        rear_now, rear_then, own_then, own_now, left_now, left_then = outcomes
        others = rear_then - rear_now + left_then - left_now
        advantage = own_then - own_now + self.temper["politeness"][rows] * others
        return (rear_then >= -self.temper["imposed_braking"][rows]) & (advantage >= self.temper["gain"][rows])

    def steering(
        self, rows: Ints, lanes: Ints, heading_gain: float = HEADING_GAIN, lateral_gain: float = LATERAL_GAIN
    ) -> Floats:
        """
        Wheel angle that leads onto a lane's centre: lateral offset to heading, heading to yaw rate, yaw rate to wheel.

        :param rows: the users, shape ``(n,)``
        :param lanes: the lane each steers for, shape ``(n,)``
        :param heading_gain: how fast a heading error is corrected [1/s]
        :param lateral_gain: how fast a lateral offset is corrected [1/s]
        :return: wheel angles, shape ``(n,)`` [rad]
        """
        speed = np.maximum(self.speed[rows], LEAST)
        approach = np.arcsin(bounded(-lateral_gain * self.across[lanes, rows] / speed, 1.0))
        ahead = self.road.heading_at(lanes, self.along[lanes, rows] + PURSUIT * self.speed[rows])
        wanted = ahead + bounded(approach, MAX_APPROACH_ANGLE)
        yaw_rate = heading_gain * wrap_angle(wanted - self.heading[rows])
        slip = np.arcsin(bounded(self.half_length[rows] / speed * yaw_rate, 1.0))
        return bounded(np.arctan(2 * np.tan(slip)), MAX_WHEEL_ANGLE)

    def act(self) -> None:
        """Let every self-driving car choose its lane, acceleration and wheel angle."""
        rows = self.drivers
        self._continue_lanes(rows)
        self._choose_lanes(rows)
        target = self.target_lane[rows]
        self.wheel_angle[rows] = self.steering(rows, target)
        acceleration = self._follow(rows, target)
        waiting = (self.stop_distance[rows] < np.inf).nonzero()[0]
        if waiting.size:
            acceleration[waiting] = np.minimum(acceleration[waiting], self.stopping_acceleration(rows[waiting]))
        self.acceleration[rows] = bounded(acceleration, MAX_ACCELERATION)
        forced = self.forced_braking.nonzero()[0]
        self.acceleration[forced] = -self.forced_braking[forced]

    def _follow(self, rows: Ints, target: Ints) -> Floats:
        """Accelerations behind who is ahead in the own lane and, if that is another one, in the target lane, too."""
        changing = (target != self.lane[rows]).nonzero()[0]
        if not changing.size:
            return self.following_acceleration(rows, self.front[rows], rows)
        cars = rows[changing]
        front = nearest_ahead(*self.gaps(self.paths.outlook(cars, target[changing])))
        everyone = np.concatenate([rows, cars])
        acceleration = self.following_acceleration(everyone, np.concatenate([self.front[rows], front]), everyone)
        acceleration[changing] = np.minimum(acceleration[changing], acceleration[len(rows) :])
        return acceleration[: len(rows)]

    def _continue_lanes(self, rows: Ints) -> None:
        target = self.target_lane[rows]
        following = self.paths.next_lane[rows, target]
        done = (following != NO_LANE) & (self.along[target, rows] > self.road.length[target] - CAR_LENGTH / 2)
        self.target_lane[rows[done]] = following[done]

    def _choose_lanes(self, rows: Ints) -> None:
        before = self.target_lane.copy()
        changing = self.lane[rows] != before[rows]
        pondering = rows[~changing & (self.timer[rows] > self.temper["delay"][rows])]
        if pondering.size:
            self.timer[pondering] = 0.0
            due = self.must_get_back(pondering, self.lane[pondering])
            self._ponder(pondering[~due])
            self._get_back(pondering[due])
        for row in rows[changing].tolist():
            self._reconsider(row, before)

    def must_get_back(self, rows: Ints, lanes: Ints) -> Bools:
        """
        Whether lanes end soon that do not lead on to where the paths of users go.

        :param rows: the users, shape ``(n,)``
        :param lanes: the lane to judge for each of them, shape ``(n,)``
        :return: one verdict per user, shape ``(n,)``
        """
        if not self.paths.any_leads_astray:
            return np.zeros(len(rows), dtype=bool)
        left = self.road.length[lanes] - self.along[lanes, rows]
        return np.asarray(self.paths.leads_astray[rows, lanes] & (left < GET_BACK))

    def _ponder(self, rows: Ints) -> None:
        own, cars = self.lane[rows], np.concatenate([rows, rows])
        lanes = np.concatenate([self.road.left[own], self.road.right[own]])
        possible = (lanes != NO_LANE) & self._can_change(cars, lanes) & ~self.must_get_back(cars, lanes)
        cars, lanes = cars[possible], lanes[possible]
        if cars.size:
            worth = self.change_is_worth_it(cars, lanes)
            self.target_lane[cars[worth]] = lanes[worth]  # right comes last and wins, as in highway-env

    def _get_back(self, rows: Ints) -> None:
        if rows.size:
            lanes = self.paths.towards[rows, self.lane[rows]]
            possible = (lanes != self.lane[rows]) & self._can_change(rows, lanes)
            rows, lanes = rows[possible], lanes[possible]
            safe = self.change_is_safe(rows, lanes)
            self.target_lane[rows[safe]] = lanes[safe]

    def _can_change(self, rows: Ints, lanes: Ints) -> Bools:
        along = self.along[lanes, rows]
        reachable = (along >= self._first_change[lanes]) & (along < self.road.length[lanes] + CAR_LENGTH)
        reachable &= np.abs(self.across[lanes, rows]) <= 2 * self.road.width[lanes]
        return np.asarray(reachable & (self.speed[rows] >= 1.0))

    def _reconsider(self, row: int, before: Ints) -> None:
        """Give up a lane change if someone ahead is changing into the same lane; cars decide in the order of their rows."""
        aims = np.concatenate([self.target_lane[:row], before[row:]])
        if self.rival_ahead(row, int(before[row]), aims):
            self.target_lane[row] = self.lane[row]

    def rival_ahead(self, row: int, lane: int, aims: Ints) -> bool:
        """
        Whether someone ahead, nearer than the wanted gap, is changing into a lane too.

        :param row: the user who asks
        :param lane: that lane
        :param aims: the lane each user steers for, shape ``(n,)``
        :return: True if it had better stay behind
        """
        rivals = ((aims == lane) & (self.lane != lane)).nonzero()[0]
        rivals = rivals[rivals != row]
        if not rivals.size:
            return False
        distance = self.distance(np.full_like(rivals, row), rivals)
        closing = (self.velocity[row] - self.velocity[rivals]) @ self.direction[row]
        _, _, gap, headway, braking = self._following[:, row]
        wanted = gap + self.speed[row] * headway + self.speed[row] * closing / braking
        return bool(np.any((distance > 0) & (distance < wanted)))

    def move(self, dt: float) -> None:
        """See :meth:`RoadUsers.move`."""
        self.timer += dt
        super().move(dt)
