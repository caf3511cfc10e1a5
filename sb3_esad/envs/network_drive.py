"""A drive through a network of streets, whose junctions everybody enters in turn."""

from abc import abstractmethod
from typing import Any

from sb3_esad.envs.population import Population
from sb3_esad.envs.right_of_way import RightOfWay
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.routes import Route
from sb3_esad.envs.scenario import Scenario
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Temper, User

CLEAR = 18.0  # nobody is placed nearer to the ego vehicle than this [m]


class NetworkDrive(Scenario):
    """
    Follow a route through junctions; subclasses choose it and place the others. See :class:`Scenario`.

    ``ego_temper`` is how scripted drivers drive the ego vehicle.
    """

    ego_temper = Temper(headway=0.9, gap=7.5)
    right_of_way: RightOfWay

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "target_speed": 11.0,
            "max_speed": 15.0,
            "start_speed": (8.0, 11.0),
            "desired_speed": (8.0, 11.5),
        }

    @abstractmethod
    def _place_others(self, population: Population) -> list[User]:
        """Place everybody but the ego vehicle."""

    @abstractmethod
    def _plan(self) -> tuple[list[int], float, float]:
        """Choose lanes one after the other, and where the route starts on the first and ends on the last of them [m]."""

    def _make_route(self) -> Route:
        lanes, self._start, end = self._plan()
        self._reached = 0.0
        return Route(self.road, lanes, self._start, end)

    def _make_traffic(self) -> Traffic:
        config, lane = self.config, self.route.lanes[0]
        speed = min(float(self.np_random.uniform(*config["start_speed"])), float(self.road.speed_limit[lane]))
        population = Population(self.np_random, self.road)
        x, y = self.road.position(lane, self._start).tolist()
        heading = self.road.lanes[lane].heading_at(self._start)
        ego = User(
            position=(x, y),
            heading=heading,
            speed=speed,
            target_speed=config["target_speed"],
            drives=False,
            size=config["vehicle_size"],
            temper=self.ego_temper,
            path=self.route.lanes,
        )
        return Traffic(self.road, [ego, *self._place_others(population)])

    def _is_clear(self, lane: int, along: float) -> bool:
        """Whether a place is far enough from that of the ego vehicle."""
        offset = self.road.position(lane, along) - self.road.position(self.route.lanes[0], self._start)
        return bool((offset**2).sum() > CLEAR**2)

    def _before_physics(self) -> None:
        self.right_of_way.regulate(self.traffic)

    def _progress(self) -> float:
        lane = int(self.traffic.lane[EGO])
        if self.route.contains[lane]:
            self._reached = self.route.progress(lane, float(self.traffic.along[lane, EGO]))
        return self._reached
