"""The highway: slower and faster traffic of mixed temper, and an on-ramp whose cars merge into the ego vehicle's road."""

from dataclasses import replace
from typing import Any

import numpy as np

from sb3_esad.envs.lanes import LANE_WIDTH, NO_LANE, Lane
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Markings, Road, dashes
from sb3_esad.envs.scenario import Scenario
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, Temper, User

ROAD_START, ROAD_RUNOUT = -300.0, 1000.0  # the lanes go on before the start and past the end of the route [m]
EGO_TEMPER = Temper(headway=0.9, gap=8.0, imposed_braking=3.0, gain=0.1)  # how scripted drivers drive the ego vehicle
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
    centres = LANE_WIDTH * np.arange(lanes + 1)
    main = [
        Lane.between(
            (ROAD_START, y),
            (route_length + ROAD_RUNOUT, y),
            left=index - 1 if index > 0 else NO_LANE,
            right=index + 1 if index < lanes - 1 else NO_LANE,
        )
        for index, y in enumerate(centres[:-1].tolist())
    ]
    side = float(centres[-1])
    acceleration = Lane.between((merge, side), (merge + merge_length, side), left=lanes - 1, on_route=False)
    approach = Lane.between((merge - RAMP_LENGTH, side + RAMP_OFFSET), (merge, side), following=lanes, on_route=False)
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
    return Markings(np.array(asphalt), np.array([False, False, True]), np.concatenate([dashed, np.array(solid)]), is_dash)


class Highway(Scenario):
    """Drive 600 m at 25 m/s through slower traffic on three or four lanes, past an on-ramp. See :class:`Scenario`."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "route_length": 600.0,
            "lane_counts": (3, 4),
            "start_speed": (22.0, 25.0),
            "traffic_behind": 110.0,
            "traffic_ahead": 300.0,
            "headway": (1.1, 3.1),
            "desired_speed": (21.5, 25.0),
            "desired_speed_spread": 1.5,
            "slow_share": 0.12,
            "slow_speed": (15.0, 18.0),
            "fast_share": 0.1,
            "fast_speed": (26.0, 29.0),
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
        self.route_length = config["route_length"]
        self.lanes = int(self.np_random.choice(config["lane_counts"]))
        self.merge = float(self.np_random.uniform(*config["merge_start"]))
        return highway_road(self.lanes, self.route_length, self.merge, config["merge_length"])

    def _make_traffic(self) -> Traffic:
        own_lane = int(self.np_random.integers(self.lanes))
        speed = float(self.np_random.uniform(*self.config["start_speed"]))
        place, target = (0.0, own_lane * LANE_WIDTH), self.config["target_speed"]
        ego = User(place, speed=speed, target_speed=target, drives=False, temper=EGO_TEMPER)
        cars = [car for lane in range(self.lanes) for car in self._lane_traffic(lane, lane == own_lane)]
        barrier = User(tuple(self.road.end(self.lanes)), kind=Kind.STATIC, drives=False, size=(1.0, 3.0))
        self._draw_slowdown()
        return Traffic(self.road, [ego, *cars, *self._merging_cars(), barrier])

    def _lane_traffic(self, lane: int, own: bool) -> list[User]:
        """Cars of one lane, front to back; a gap is kept free around the ego vehicle in its own lane."""
        config, random = self.config, self.np_random
        cars: list[User] = []
        x, ahead = config["traffic_ahead"] - random.uniform(0.0, 40.0), config["max_speed"]
        clear = (-40.0, 45.0) if own else (0.0, 0.0)
        while x > -config["traffic_behind"]:
            desired = self._desired_speed(lane)
            if not clear[0] < x < clear[1]:
                speed = min(desired, ahead + 1.0)
                cars.append(self._car(lane, x - ROAD_START, speed, desired, self._temper()))
                ahead = speed
            x -= 5.0 + desired * random.uniform(*config["headway"])
        return cars

    def _desired_speed(self, lane: int) -> float:
        """Right lanes are slower; some cars, anywhere, are much slower or faster than the rest."""
        config, random = self.config, self.np_random
        draw = random.random()
        if draw < config["slow_share"]:
            return float(random.uniform(*config["slow_speed"]))
        if draw > 1.0 - config["fast_share"]:
            return float(random.uniform(*config["fast_speed"]))
        slow, fast = config["desired_speed"]
        mean = fast - (fast - slow) * lane / max(self.lanes - 1, 1)
        return float(mean + random.uniform(-1.0, 1.0) * config["desired_speed_spread"])

    def _temper(self) -> Temper:
        random = self.np_random
        return Temper(
            acceleration=float(random.uniform(2.0, 3.5)),
            gap=float(random.uniform(7.5, 9.5)),
            headway=float(random.uniform(0.7, 1.4)),
            exponent=float(random.uniform(3.5, 4.5)),
            politeness=float(random.uniform(0.0, 0.5)),
        )

    def _car(self, lane: int, along: float, speed: float, desired: float, temper: Temper) -> User:
        x, y = self.road.position(lane, along).tolist()
        timer = float(self.np_random.uniform(0.0, temper.delay))
        return User((x, y), float(self.road.heading[lane]), speed, desired, temper=temper, timer=timer)

    def _merging_cars(self) -> list[User]:
        """Cars on the ramp, timed to reach the acceleration lane about when the ego vehicle does."""
        random, lane = self.np_random, self.lanes + 1
        speed = float(random.uniform(19.0, 22.0))
        along = RAMP_LENGTH - self.merge * speed / self.config["target_speed"] + float(random.uniform(0.0, 80.0))
        cars = []
        for _ in range(self.config["merging_cars"]):
            desired = speed + float(random.uniform(0.0, 3.0))
            if 0.0 <= along <= RAMP_LENGTH:
                cars.append(self._car(lane, along, speed, desired, replace(self._temper(), **MERGING_TEMPER)))
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
        if self._slowed is None and waited >= 0 and front in traffic.drivers:
            self._slowed = (front, float(traffic.target_speed[front]))
            self._slowdown_start = self.episode.time
            traffic.target_speed[front] = self.config["slowdown_speed"]
        elif self._slowed is not None and waited >= self.config["slowdown_duration"]:
            row, speed = self._slowed
            traffic.target_speed[row] = speed
            self._slowed, self._slowdown_start = None, np.inf

    def _progress(self) -> float:
        return float(self.traffic.position[EGO, 0])
