"""A straight road with some lanes, full of traffic, on which several scenarios take place."""

from typing import Any

import numpy as np

from sb3_esad.envs.lanes import LANE_WIDTH, NO_LANE, Lane
from sb3_esad.envs.population import Mix, Population, Stretch
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Markings, Road, dashes
from sb3_esad.envs.routes import Route
from sb3_esad.envs.scenario import Scenario
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Temper, User

ROAD_START, ROAD_RUNOUT = -300.0, 1000.0  # the lanes go on before the start and past the end of the route [m]


def parallel_lanes(count: int, route_length: float) -> list[Lane]:
    """
    Straight lanes along the x axis, the leftmost at y = 0.

    :param count: how many
    :param route_length: of the part that is driven, from x = 0 on [m]
    :return: lanes from left to right
    """
    length = route_length + ROAD_RUNOUT - ROAD_START
    beside = [(index - 1 if index > 0 else NO_LANE, index + 1 if index < count - 1 else NO_LANE) for index in range(count)]
    return [
        Lane((ROAD_START, index * LANE_WIDTH), 0.0, length, left=left, right=right)
        for index, (left, right) in enumerate(beside)
    ]


def straight_road(lanes: int, route_length: float) -> Road:
    """
    Lanes along the x axis and nothing else.

    :param lanes: how many
    :param route_length: the asphalt is drawn up to here [m]
    :return: the road
    """
    left, right = -LANE_WIDTH / 2, (lanes - 0.5) * LANE_WIDTH
    asphalt = [[[ROAD_START, left], [route_length, left], [route_length, right], [ROAD_START, right]]]
    solid = np.array([[[ROAD_START, y], [route_length, y]] for y in (left, right)])
    dashed = np.concatenate([dashes(ROAD_START, route_length, left + LANE_WIDTH * index) for index in range(1, lanes)])
    is_dash = np.arange(len(dashed) + len(solid)) < len(dashed)
    markings = Markings(np.array(asphalt), np.array([0]), np.concatenate([dashed, solid]), is_dash)
    return Road(parallel_lanes(lanes, route_length), markings)


class StraightDrive(Scenario):
    """
    Drive along a straight road through traffic; subclasses add what happens there. See :class:`Scenario`.

    ``ego_temper`` is how scripted drivers drive the ego vehicle.
    """

    ego_temper = Temper(headway=0.9, gap=8.0, imposed_braking=3.0, gain=0.1)

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
        }

    def _make_road(self) -> Road:
        self.lanes = int(self.np_random.choice(self.config["lane_counts"]))
        return straight_road(self.lanes, self.config["route_length"])

    def _make_route(self) -> Route:
        return Route(self.road, [0], -ROAD_START, self.config["route_length"] - ROAD_START)

    def _make_traffic(self) -> Traffic:
        self.population = Population(self.np_random, self.road)
        own_lane = int(self.np_random.integers(self.lanes))
        speed = float(self.np_random.uniform(*self.config["start_speed"]))
        place, target = (0.0, own_lane * LANE_WIDTH), self.config["target_speed"]
        size, temper = self.config["vehicle_size"], self.ego_temper
        ego = User(place, speed=speed, target_speed=target, drives=False, size=size, temper=temper)
        cars = [car for lane in range(self.lanes) for car in self._lane_traffic(lane, lane == own_lane)]
        return Traffic(self.road, [ego, *cars, *self._others()])

    def _lane_traffic(self, lane: int, own: bool) -> list[User]:
        """Cars of one lane, the right lanes being slower; a gap is kept free around the ego vehicle in its own lane."""
        config, start = self.config, -ROAD_START
        slow, fast = config["desired_speed"]
        mean = fast - (fast - slow) * lane / max(self.lanes - 1, 1)
        clear = (start - 40.0, start + 45.0) if own else (0.0, 0.0)
        stretch = Stretch(lane, start - config["traffic_behind"], start + config["traffic_ahead"], clear)
        names = ("slow_share", "slow_speed", "fast_share", "fast_speed", "headway")
        mix = Mix(mean, config["desired_speed_spread"], *(config[name] for name in names))
        return self.population.fill(stretch, mix, config["max_speed"])

    def _others(self) -> list[User]:
        """Further road users of this scenario."""
        return []

    def _progress(self) -> float:
        return float(self.traffic.position[EGO, 0])
