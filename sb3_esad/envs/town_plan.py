"""The plan of a town of streets and junctions, and the network that is built from it."""

from typing import NamedTuple

from sb3_esad.envs.lanes import LANE_WIDTH
from sb3_esad.envs.networks import Carriageway, Network, Way
from sb3_esad.envs.pieces import Piece, Point, rounded
from sb3_esad.envs.right_of_way import Crossings
from sb3_esad.envs.roads import Road
from sb3_esad.envs.roundabouts import Roundabout

Streets = tuple[tuple[Carriageway, ...], ...]


class Town(NamedTuple):
    """
    Streets and junctions that can be driven in.

    :param road: its lanes
    :param streets: the carriageways of each street
    :param ways: on which one may go on where there is a choice: through junctions, or onto a lane beside
    :param crossings: of the ways through junctions
    """

    road: Road
    streets: Streets
    ways: tuple[Way, ...]
    crossings: Crossings


class Street(NamedTuple):
    """
    A street between two places.

    :param start: name of a place
    :param end: name of another one
    :param via: points that it passes in between; the corners there are rounded [m]
    :param lanes: number of lanes in either direction
    :param speed_limit: [m/s]
    :param radius: of the corners [m]
    :param narrowest: width of its lanes between the first and the last corner [m]
    """

    start: str
    end: str
    via: tuple[Point, ...] = ()
    lanes: int = 1
    speed_limit: float = 12.0
    radius: float = 40.0
    narrowest: float = LANE_WIDTH


class TownPlan(NamedTuple):
    """
    What there is in a town.

    :param places: where streets meet, by name [m]
    :param streets: all of them
    :param half_size: of each junction, from its centre to the lines before it [m]
    :param roundabouts: radius of the ring at some places [m]
    """

    places: dict[str, Point]
    streets: tuple[Street, ...]
    half_size: float
    roundabouts: dict[str, float] = {}  # noqa: RUF012 - nobody changes it

    def build(self) -> Town:
        """
        Build the town.

        :return: its lanes and all ways through its junctions
        """
        network = Network()
        streets = tuple(
            network.street(self._between_junctions(street), street.lanes, street.speed_limit, street.narrowest)
            for street in self.streets
        )
        for place in self.places:
            self._join(place, streets, network)
        road, ways = network.road(), tuple(network.ways)
        return Town(road, streets, ways, Crossings(road, ways))

    def _between_junctions(self, street: Street) -> list[Piece]:
        pieces = rounded([self.places[street.start], *street.via, self.places[street.end]], street.radius)
        last = pieces[-1]
        pieces[-1] = last.cut(0.0, last.length - self._size(street.end))
        pieces[0] = pieces[0].cut(self._size(street.start), pieces[0].length)
        return pieces

    def _size(self, place: str) -> float:
        """How far from a place its streets end [m]."""
        return self._roundabout(place).half_size if place in self.roundabouts else self.half_size

    def _roundabout(self, place: str) -> Roundabout:
        return Roundabout(self.places[place], self.roundabouts[place])

    def _join(self, place: str, streets: Streets, network: Network) -> None:
        """Lead from every street that ends at a place to every other one."""
        pairs = list(zip(self.streets, streets, strict=True))
        ending, starting = ([both for street, both in pairs if street[end] == place] for end in (1, 0))
        arriving = [there for there, _ in ending] + [back for _, back in starting]
        leaving = [back for _, back in ending] + [there for there, _ in starting]
        speed_limit = min(street.speed_limit for street in self.streets if place in street[:2])
        if place in self.roundabouts:
            network.roundabout(self._roundabout(place), arriving, leaving, speed_limit)
        else:
            network.junction(arriving, leaving, speed_limit)
