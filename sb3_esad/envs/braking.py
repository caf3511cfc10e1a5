"""Braking and lane changing: the car ahead brakes hard at any moment, and others cut in."""

from typing import Any

import numpy as np

from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.straight import StraightDrive
from sb3_esad.envs.traffic import Traffic

NEAR = 60.0  # who is further ahead than this does not matter to the ego vehicle [m]
CUT_IN_FROM = (9.0, 20.0)  # how far ahead a car is that cuts in, centre to centre [m]
CUT_IN_TIME = 1.5  # it is in the lane after this, and may brake [s]


class Braking(StraightDrive):
    """
    Drive 500 m at 22 m/s on two or three lanes while cars ahead brake to a halt and cars beside cut in.

    See :class:`Scenario`.
    """

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "duration": 60.0,
            "route_length": 500.0,
            "target_speed": 22.0,
            "max_speed": 26.0,
            "lane_counts": (2, 3),
            "start_speed": (18.0, 21.0),
            "traffic_behind": 80.0,
            "traffic_ahead": 160.0,
            "headway": (1.6, 3.6),
            "desired_speed": (19.0, 21.0),
            "desired_speed_spread": 1.0,
            "slow_share": 0.0,
            "fast_share": 0.0,
            "event_pause": (1.5, 5.0),
            "event_braking": (6.0, 8.0),
            "halt_duration": (0.5, 2.5),
            "cut_in_share": 0.4,
            "cut_in_braking_share": 0.6,
        }

    def _make_traffic(self) -> Traffic:
        self._braking_car, self._release_time = -1, np.inf
        self._braking_start, self._next_event = np.inf, self._draw("event_pause")
        return super()._make_traffic()

    def _draw(self, name: str) -> float:
        return float(self.np_random.uniform(*self.config[name]))

    def _before_physics(self) -> None:
        now = self.episode.time
        if self._braking_car < 0 and now >= self._next_event:
            self._start_event()
        if now >= self._braking_start:
            self.traffic.forced_braking[self._braking_car] = self._draw("event_braking")
            self._braking_start = np.inf
        self._end_event()

    def _start_event(self) -> None:
        """Someone cuts in, if anyone is in the right place; otherwise the car ahead brakes."""
        now, cutting = self.episode.time, self._car_beside() if self.np_random.random() < self.config["cut_in_share"] else -1
        if cutting >= 0:
            self.traffic.target_lane[cutting] = self.traffic.lane[EGO]
            self.traffic.timer[cutting] = -CUT_IN_TIME
            brakes = self.np_random.random() < self.config["cut_in_braking_share"]
            self._braking_car, self._braking_start = cutting, now + CUT_IN_TIME
            if not brakes:
                self._forget_event()
            return
        front = self._car_ahead()
        if front >= 0:
            self._braking_car, self._braking_start = front, now

    def _car_ahead(self) -> int:
        front = int(self.traffic.front[EGO])
        near = front >= 0 and self.traffic.drives[front] and self._distance(front) < NEAR
        return front if near else -1

    def _car_beside(self) -> int:
        """A car in a lane beside the ego vehicle's, a little ahead, with nobody between them; -1 if there is none."""
        traffic, lane = self.traffic, self.traffic.lane[EGO]
        beside = (traffic.lane == self.road.left[lane]) | (traffic.lane == self.road.right[lane])
        distance = traffic.position[:, 0] - traffic.position[EGO, 0]
        front = self._car_ahead()
        limit = min(CUT_IN_FROM[1], self._distance(front) - CUT_IN_FROM[0] if front >= 0 else np.inf)
        rows = np.flatnonzero(beside & traffic.drives & (distance > CUT_IN_FROM[0]) & (distance < limit))
        return int(self.np_random.choice(rows)) if rows.size else -1

    def _distance(self, row: int) -> float:
        return float(self.traffic.position[row, 0] - self.traffic.position[EGO, 0])

    def _end_event(self) -> None:
        car, now = self._braking_car, self.episode.time
        if car < 0 or self._braking_start < np.inf:
            return
        if self.traffic.speed[car] < 0.1 and self._release_time == np.inf:
            self._release_time = now + self._draw("halt_duration")
        if now >= self._release_time:
            self.traffic.forced_braking[car] = 0.0
            self._forget_event()

    def _forget_event(self) -> None:
        self._braking_car, self._release_time, self._braking_start = -1, np.inf, np.inf
        self._next_event = self.episode.time + self._draw("event_pause")
