"""A drive through a town, from anywhere to anywhere."""

from typing import Any, ClassVar

import numpy as np

from sb3_esad.envs.geometry import Floats
from sb3_esad.envs.lanes import LANE_WIDTH
from sb3_esad.envs.lights import PERIOD, SETBACK, StopLines, TrafficLights
from sb3_esad.envs.network_drive import NetworkDrive
from sb3_esad.envs.population import Population
from sb3_esad.envs.right_of_way import RightOfWay
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Road
from sb3_esad.envs.town_plan import Town
from sb3_esad.envs.towns import town
from sb3_esad.envs.users import Temper, User
from sb3_esad.envs.walkers import Walkers

LIGHTS_SEEN = 40.0  # from as far before a junction [m]
CROSSING, KERB = 4.0, 2.0  # people cross this far before the line, from this far beside the road [m]
ATTEMPTS = 100
APART = 14.0  # nobody is placed nearer to someone else of the same lane than this [m]


class TownDrive(NetworkDrive):
    """
    Drive along a route of some hundred metres, with turns as drawn at the start. See :class:`Scenario`.

    ``town_name`` tells the map.
    """

    town_name: ClassVar[str]

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "duration": 90.0,
            "route_length": 300.0,
            "cars": 30,
            "spawn": "random",
        }

    def _make_road(self) -> Road:
        self.town: Town = town(self.town_name)
        self.right_of_way = RightOfWay(self.town.crossings)
        return self.town.road

    def _plan(self) -> tuple[list[int], float, float]:
        lanes, start = self._draw_route()
        before = sum(float(self.road.length[lane]) for lane in lanes[:-1])
        return lanes, start, min(self.config["route_length"] + start - before, float(self.road.length[lanes[-1]]))

    def _draw_route(self) -> tuple[list[int], float]:
        """Lanes of a route that passes no street twice, for its progress must be known, and where it starts on the first."""
        for _ in range(ATTEMPTS):
            first, start = self._draw_place(1 if self.config["spawn"] == "fixed" else len(self.town.streets))
            lanes = self._walk(first, self.config["route_length"] + start)
            if len(set(self.road.row_of[lanes].tolist())) == len(lanes):
                return lanes, start
        remedy = "choose a shorter one"
        raise ValueError(f"route_length {self.config['route_length']} leads through {self.town_name} in circles; {remedy}")

    def _draw_place(self, streets: int) -> tuple[int, float]:
        """A place on one of the first streets: a lane, and the distance from its start [m]."""
        random = self.np_random
        street = self.town.streets[int(random.integers(streets))]
        lane = street[int(random.integers(len(street)))].lanes
        pieces = lane[int(random.integers(len(lane)))]
        piece = pieces[int(random.integers(len(pieces)))]
        return piece, float(random.uniform(0.1, 0.7) * self.road.length[piece])

    def _walk(self, lane: int, metres: float) -> list[int]:
        """Lanes one after the other, with ways through junctions as they come, until they are long enough."""
        lanes, length = [lane], float(self.road.length[lane])
        while length < metres:
            ways = [way for way in self.town.ways if way.source == lanes[-1]]
            if ways:
                way = ways[int(self.np_random.integers(len(ways)))]
                following = [*way.lanes, way.target]
            else:
                following = [int(self.road.following[lanes[-1]])]
            lanes += following
            length += sum(float(self.road.length[each]) for each in following)
        return lanes

    def _place_others(self, population: Population) -> list[User]:
        config, cars = self.config, []
        taken: dict[int, list[float]] = {}
        for _ in range(config["cars"]):
            lane, along = self._draw_place(len(self.town.streets))
            near = any(abs(along - other) < APART for other in taken.get(lane, []))
            if near or not self._is_clear(lane, along):
                continue
            taken.setdefault(lane, []).append(along)
            path = tuple(self._walk(lane, 600.0))
            desired = float(self.np_random.uniform(*config["desired_speed"]))
            cars.append(population.car(lane, along, 0.6 * desired, desired, population.temper(), path))
        return cars


class LitTown(TownDrive):
    """A town with traffic lights, and people who cross its streets. See :class:`TownDrive`."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "duration": 150.0,
            "people": 16,
            "walking_speed": 1.2,
            "walking_pause": (2.0, 12.0),
            "walking_caution": 0.6,
        }

    def _make_road(self) -> Road:
        road = super()._make_road()
        self.right_of_way = RightOfWay(self.town.crossings, LIGHTS_SEEN)
        junctions = max(way.junction for way in self.town.ways)
        self.lights = TrafficLights(road, self.town.ways, self.np_random.uniform(0.0, PERIOD, junctions))
        return road

    def _place_others(self, population: Population) -> list[User]:
        cars, config = super()._place_others(population), self.config
        ends = np.array([self._draw_crossing() for _ in range(config["people"])]).reshape(-1, 2, 2)
        self.walkers = Walkers(
            self.np_random, ends, config["walking_speed"], config["walking_pause"], config["walking_caution"]
        )
        return [*cars, *self.walkers.people()]

    def _draw_crossing(self) -> list[Floats]:
        """Two places on either side of a street, just before a junction, in any order."""
        street = self.town.streets[int(self.np_random.integers(len(self.town.streets)))]
        there = street[int(self.np_random.integers(2))].exits[-1]
        along, lanes = float(self.road.length[there]) - CROSSING, len(street[0].lanes)
        far = (2 * lanes - 0.5) * LANE_WIDTH + KERB
        sides = [self.road.position(there, along, LANE_WIDTH / 2 + KERB), self.road.position(there, along, -far)]
        return sides[:: int(self.np_random.choice([-1, 1]))]

    def _before_physics(self) -> None:
        self._way = self.right_of_way.way_ahead(self.traffic, EGO)
        self.right_of_way.regulate(self.traffic, self.lights.closed(self.episode.time), SETBACK)
        self.walkers.walk(self.traffic, self.episode.time)

    def _ran_red_light(self) -> bool:
        ahead, now = self._way, self.right_of_way.way_ahead(self.traffic, EGO)
        if ahead is None or now is None or ahead[0] != now[0]:
            return False
        return ahead[1] > SETBACK >= now[1] and bool(self.lights.red(self.episode.time)[now[0]])

    @property
    def stop_lines(self) -> StopLines:
        """See :attr:`Scenario.stop_lines`."""
        return self.lights.lines(self.episode.time)


class Town03(TownDrive):
    """A wide junction, a roundabout, winding streets and a narrow stretch. See :class:`TownDrive`."""

    town_name = "town03"


class Town04(TownDrive):
    """A ring of motorway with ramps and curves. See :class:`TownDrive`."""

    town_name = "town04"
    ego_temper = Temper(headway=0.9, gap=8.0, imposed_braking=3.0)

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "route_length": 600.0,
            "target_speed": 20.0,
            "max_speed": 25.0,
            "start_speed": (15.0, 19.0),
            "cars": 70,
            "desired_speed": (10.0, 21.0),
        }


class Town06(TownDrive):
    """Long streets of two lanes in either direction, in a grid. See :class:`TownDrive`."""

    town_name = "town06"

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        speeds = {"target_speed": 14.0, "max_speed": 18.0, "start_speed": (11.0, 14.0), "desired_speed": (7.0, 14.0)}
        return {**super().default_config(), **speeds, "cars": 90}


class Town07(TownDrive):
    """Winding two-way roads around a lake. See :class:`TownDrive`."""

    town_name = "town07"

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {**super().default_config(), "cars": 60, "desired_speed": (4.0, 10.0)}


class Town10(LitTown):
    """The dense centre of a town: many junctions with lights, people on crossings. See :class:`LitTown`."""

    town_name = "town10"
