"""The highway: slower and faster traffic of mixed temper, and an on-ramp whose cars merge into the ego vehicle's road."""

from dataclasses import replace
from typing import Any

import numpy as np

from sb3_esad.envs.lanes import LANE_WIDTH, Lane
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Markings, Road, dashes
from sb3_esad.envs.straight import ROAD_START, StraightDrive, parallel_lanes
from sb3_esad.envs.users import Kind, User

MERGING_TEMPER = {"politeness": 0.0, "gain": 0.0, "imposed_braking": 4.0, "delay": 0.4}  # their lane ends
RAMP_LENGTH, RAMP_OFFSET = 350.0, 20.0  # the approach starts this far before the merge, and this far to its right [m]


def highway_road(lanes: int, route_length: float, merge: float, merge_length: float) -> Road:
    """
    Straight lanes along the x axis, the leftmost at y = 0, with an on-ramp at the right.

    :param lanes: how many
    :param route_length: the asphalt is drawn up to here [m]
    :param merge: x at which the acceleration lane begins [m]
    :param merge_length: of the acceleration lane [m]
    :return: lanes from left to right, then the acceleration lane, then the ramp's approach
    """
    side = lanes * LANE_WIDTH
    acceleration = Lane.between((merge, side), (merge + merge_length, side), left=lanes - 1)
    approach = Lane.between((merge - RAMP_LENGTH, side + RAMP_OFFSET), (merge, side), following=lanes)
    main = parallel_lanes(lanes, route_length)
    return Road([*main, acceleration, approach], _markings(lanes, route_length, merge, merge_length))


def _markings(lanes: int, route_length: float, merge: float, merge_length: float) -> Markings:
    half, far = LANE_WIDTH / 2, merge + merge_length
    left, right = -half, lanes * LANE_WIDTH - half
    outer, start = right + LANE_WIDTH, merge - RAMP_LENGTH
    asphalt = [
        [[start, right + RAMP_OFFSET], [merge, right], [merge, outer], [start, outer + RAMP_OFFSET]],
        [[merge, right], [far, right], [far, outer], [merge, outer]],
        [[ROAD_START, left], [route_length, left], [route_length, right], [ROAD_START, right]],
    ]
    solid = [
        [[ROAD_START, left], [route_length, left]],
        [[ROAD_START, right], [merge, right]],
        [[far, right], [route_length, right]],
        [[start, right + RAMP_OFFSET], [merge, right]],
        [[start, outer + RAMP_OFFSET], [merge, outer]],
        [[merge, outer], [far, outer]],
        [[far, right], [far, outer]],
    ]
    between = [dashes(ROAD_START, route_length, y) for y in left + LANE_WIDTH * np.arange(1, lanes)]
    dashed = np.concatenate([*between, dashes(merge, far, right)])
    is_dash = np.arange(len(dashed) + len(solid)) < len(dashed)
    return Markings(np.array(asphalt), np.array([lanes + 1, lanes, 0]), np.concatenate([dashed, np.array(solid)]), is_dash)


class Highway(StraightDrive):
    """Drive 600 m at 25 m/s through slower traffic on three or four lanes, past an on-ramp. See :class:`Scenario`."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "merging_cars": 3,
            "merge_start": (150.0, 330.0),
            "merge_length": 180.0,
            "slowdown_share": 0.25,
            "slowdown_start": (2.0, 15.0),
            "slowdown_speed": 12.0,
            "slowdown_duration": 3.0,
        }

    def _make_road(self) -> Road:
        config = self.config
        self.lanes = int(self.np_random.choice(config["lane_counts"]))
        self.merge = float(self.np_random.uniform(*config["merge_start"]))
        return highway_road(self.lanes, config["route_length"], self.merge, config["merge_length"])

    def _others(self) -> list[User]:
        self._draw_slowdown()
        barrier = User(tuple(self.road.end(self.lanes)), kind=Kind.STATIC, drives=False, size=(1.0, 3.0))
        return [*self._merging_cars(), barrier]

    def _merging_cars(self) -> list[User]:
        """Cars on the ramp, timed to reach the acceleration lane about when the ego vehicle does."""
        random, population, lane = self.np_random, self.population, self.lanes + 1
        speed = float(random.uniform(19.0, 22.0))
        along = RAMP_LENGTH - self.merge * speed / self.config["target_speed"] + float(random.uniform(0.0, 80.0))
        cars = []
        for _ in range(self.config["merging_cars"]):
            desired = speed + float(random.uniform(0.0, 3.0))
            if 0.0 <= along <= RAMP_LENGTH:
                cars.append(population.car(lane, along, speed, desired, replace(population.temper(), **MERGING_TEMPER)))
            along -= speed * float(random.uniform(1.8, 3.0))
        return cars

    def _draw_slowdown(self) -> None:
        happens = self.np_random.random() < self.config["slowdown_share"]
        self._slowdown_start = float(self.np_random.uniform(*self.config["slowdown_start"])) if happens else np.inf
        self._slowed: tuple[int, float] | None = None

    def _before_physics(self) -> None:
        """Now and then the car ahead slows down sharply for some seconds, then drives on."""
        traffic, waited = self.traffic, self.episode.time - self._slowdown_start
        front = int(traffic.front[EGO])
        if self._slowed is None and waited >= 0 and front >= 0 and traffic.drives[front]:
            self._slowed = (front, float(traffic.target_speed[front]))
            self._slowdown_start = self.episode.time
            traffic.target_speed[front] = self.config["slowdown_speed"]
        elif self._slowed is not None and waited >= self.config["slowdown_duration"]:
            row, speed = self._slowed
            traffic.target_speed[row] = speed
            self._slowed, self._slowdown_start = None, np.inf
