"""Traffic negotiation: a junction of four streets without lights, and cars from everywhere."""

from functools import cache
from typing import Any, NamedTuple

import numpy as np

from sb3_esad.envs.networks import Carriageway, Network, Way
from sb3_esad.envs.pieces import Piece
from sb3_esad.envs.population import Population
from sb3_esad.envs.right_of_way import RightOfWay
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Road
from sb3_esad.envs.routes import Route
from sb3_esad.envs.scenario import Scenario
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Temper, User

ARM_LENGTH, HALF_SIZE = 250.0, 14.0  # of the streets, and of the junction [m]
SPEED_LIMIT, TURNING_SPEED = 12.0, 6.5  # [m/s]


class Crossroads(NamedTuple):
    """
    The junction; street k leads to the east, south, west, north for k = 0 to 3.

    :param road: its lanes
    :param arriving: lanes to the junction, one carriageway for each street
    :param ways: through the junction
    """

    road: Road
    arriving: tuple[Carriageway, ...]
    ways: tuple[Way, ...]


@cache
def crossroads() -> Crossroads:
    """
    Build the junction, once per process.

    :return: the junction, which nobody must change
    """
    network, leaving, arriving = Network(), [], []
    for street in range(4):
        direction = street * np.pi / 2
        start = (HALF_SIZE * float(np.cos(direction)), HALF_SIZE * float(np.sin(direction)))
        away, towards = network.street([Piece(start, direction, ARM_LENGTH)], 1, 1, SPEED_LIMIT)
        leaving.append(away)
        arriving.append(towards)
    network.junction(arriving, leaving, SPEED_LIMIT, TURNING_SPEED)
    return Crossroads(network.road(), tuple(arriving), tuple(network.ways))


class TrafficNegotiation(Scenario):
    """Cross a junction, straight on or to either side, as drawn at the start. See :class:`Scenario`."""

    ego_temper = Temper(headway=0.9, gap=7.5, acceleration=3.0)

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "duration": 40.0,
            "target_speed": 11.0,
            "max_speed": 15.0,
            "approach": (50.0, 70.0),
            "departure": 50.0,
            "start_speed": (8.0, 11.0),
            "desired_speed": (8.0, 11.5),
            "cars_per_street": 4,
            "headway": (1.5, 4.5),
        }

    def _make_road(self) -> Road:
        self.crossroads = crossroads()
        return self.crossroads.road

    def _make_route(self) -> Route:
        random, source = self.np_random, self.crossroads.arriving[int(self.np_random.integers(4))].exits[0]
        ways = [way for way in self.crossroads.ways if way.source == source]
        way = ways[random.integers(len(ways))]
        self._start = float(self.road.length[source] - random.uniform(*self.config["approach"]))
        return Route(self.road, [source, *way.lanes, way.target], self._start, self.config["departure"])

    def _make_traffic(self) -> Traffic:
        config, random = self.config, self.np_random
        self.population = Population(random, self.road, 0.0, (0.0, 0.0), 0.0, (0.0, 0.0), 0.5, config["headway"])
        source = self.route.lanes[0]
        x, y = self.road.position(source, self._start).tolist()
        speed, heading = float(random.uniform(*config["start_speed"])), float(self.road.heading[source])
        path = self.route.lanes
        ego = User((x, y), heading, speed, config["target_speed"], drives=False, temper=self.ego_temper, path=path)
        cars = [car for street in self.crossroads.arriving for car in self._street_traffic(street.exits[0])]
        self.right_of_way = RightOfWay(self.road, self.crossroads.ways)
        return Traffic(self.road, [ego, *cars])

    def _street_traffic(self, lane: int) -> list[User]:
        """Cars that come to the junction one after the other, each with a way to take."""
        config, random, cars = self.config, self.np_random, []
        own = lane == self.route.lanes[0]
        along = float(self.road.length[lane] - random.uniform(5.0, 45.0))
        ways = [way for way in self.crossroads.ways if way.source == lane]
        for _ in range(config["cars_per_street"]):
            way, desired = ways[random.integers(len(ways))], float(random.uniform(*config["desired_speed"]))
            path = (lane, *way.lanes, way.target)
            clear = not own or abs(along - self._start) > 18.0
            if clear:
                cars.append(self.population.car(lane, along, 0.8 * desired, desired, self.population.temper(), path))
            along -= 7.0 + desired * float(random.uniform(*config["headway"]))
        return cars

    def _before_physics(self) -> None:
        self.right_of_way.regulate(self.traffic)

    def _progress(self) -> float:
        lane = int(self.traffic.lane[EGO])
        if self.route.contains[lane]:
            self._furthest = self.route.progress(lane, float(self.traffic.along[lane, EGO]))
        return self._furthest
