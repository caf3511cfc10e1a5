"""Traffic negotiation: a junction of four streets without lights, and cars from everywhere."""

from functools import cache
from typing import Any

import numpy as np

from sb3_esad.envs.network_drive import NetworkDrive
from sb3_esad.envs.networks import Network, Way
from sb3_esad.envs.pieces import Piece
from sb3_esad.envs.population import Population
from sb3_esad.envs.right_of_way import Crossings, RightOfWay
from sb3_esad.envs.roads import Road
from sb3_esad.envs.town_plan import Town
from sb3_esad.envs.users import User

ARM_LENGTH, HALF_SIZE = 250.0, 14.0  # of the streets, and of the junction [m]
SPEED_LIMIT = 12.0  # [m/s]


@cache
def crossroads() -> Town:
    """
    Build the junction, once per process.

    :return: street k, lanes away from the junction first, leads to the east, south, west, north for k = 0 to 3; nobody must
        change it
    """
    network, streets = Network(), []
    for street in range(4):
        direction = street * np.pi / 2
        start = (HALF_SIZE * float(np.cos(direction)), HALF_SIZE * float(np.sin(direction)))
        streets.append(network.street([Piece(start, direction, ARM_LENGTH)], 1, SPEED_LIMIT))
    network.junction([towards for _, towards in streets], [away for away, _ in streets], SPEED_LIMIT)
    road, ways = network.road(), tuple(network.ways)
    return Town(road, tuple(streets), ways, Crossings(road, ways))


class TrafficNegotiation(NetworkDrive):
    """Cross a junction, straight on or to either side, as drawn at the start. See :class:`Scenario`."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        cars = {"cars_per_street": 4, "headway": (1.5, 4.5)}
        return {**super().default_config(), "approach": (50.0, 70.0), "departure": 50.0, **cars}

    def _make_road(self) -> Road:
        self.crossroads = crossroads()
        self.right_of_way = RightOfWay(self.crossroads.crossings)
        return self.crossroads.road

    def _plan(self) -> tuple[list[int], float, float]:
        random, source = self.np_random, self._arriving()[int(self.np_random.integers(4))]
        way = self._draw_way(source)
        start = float(self.road.length[source] - random.uniform(*self.config["approach"]))
        return [source, *way.lanes, way.target], start, self.config["departure"]

    def _arriving(self) -> list[int]:
        """The lane to the junction of each street."""
        return [towards.exits[0] for _, towards in self.crossroads.streets]

    def _draw_way(self, source: int) -> Way:
        ways = [way for way in self.crossroads.ways if way.source == source]
        return ways[self.np_random.integers(len(ways))]

    def _place_others(self, population: Population) -> list[User]:
        return [car for lane in self._arriving() for car in self._street_traffic(population, lane)]

    def _street_traffic(self, population: Population, lane: int) -> list[User]:
        """Cars that come to the junction one after the other, each with a way to take."""
        config, random, cars = self.config, self.np_random, []
        along = float(self.road.length[lane] - random.uniform(5.0, 45.0))
        for _ in range(config["cars_per_street"]):
            way, desired = self._draw_way(lane), float(random.uniform(*config["desired_speed"]))
            if self._is_clear(lane, along):
                path = (lane, *way.lanes, way.target)
                cars.append(population.car(lane, along, 0.8 * desired, desired, population.temper(), path))
            along -= 7.0 + desired * float(random.uniform(*config["headway"]))
        return cars
