"""Maps of towns as places and streets between them, and the networks built from them."""

from functools import cache
from typing import NamedTuple

from sb3_esad.envs.networks import Carriageway, Network, Way
from sb3_esad.envs.pieces import Piece, Point, rounded
from sb3_esad.envs.right_of_way import Crossings
from sb3_esad.envs.roads import Road
from sb3_esad.envs.roundabouts import Roundabout

Streets = tuple[tuple[Carriageway, Carriageway], ...]


class Street(NamedTuple):
    """
    A street between two places.

    :param start: name of a place
    :param end: name of another one
    :param via: points that it passes in between; the corners there are rounded [m]
    :param lanes: number of lanes in either direction
    :param speed_limit: [m/s]
    :param radius: of the corners [m]
    """

    start: str
    end: str
    via: tuple[Point, ...] = ()
    lanes: int = 1
    speed_limit: float = 12.0
    radius: float = 40.0


class TownMap(NamedTuple):
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

    def roundabout(self, place: str) -> Roundabout:
        """
        The ring at a place.

        :param place: a key of ``roundabouts``
        :return: its geometry
        """
        return Roundabout(self.places[place], self.roundabouts[place])

    def size(self, place: str) -> float:
        """
        How far from a place its streets end.

        :param place: name
        :return: [m]
        """
        return self.roundabout(place).half_size if place in self.roundabouts else self.half_size


class Town(NamedTuple):
    """
    A town that can be driven in.

    :param road: its lanes
    :param streets: lanes of either direction of each street of the map
    :param ways: through all junctions
    :param crossings: of these
    """

    road: Road
    streets: Streets
    ways: tuple[Way, ...]
    crossings: Crossings


def grid(columns: int, rows: int, width: float, height: float, lanes: int, speed_limit: float, half_size: float) -> TownMap:
    """
    Draw the map of a town of straight streets.

    :param columns: number of streets from north to south
    :param rows: number of streets from west to east
    :param width: distance between columns [m]
    :param height: distance between rows [m]
    :param lanes: in either direction
    :param speed_limit: [m/s]
    :param half_size: of the junctions [m]
    :return: the map; its places are named after column and row
    """
    places = {f"{column}{row}": (column * width, row * height) for column in range(columns) for row in range(rows)}
    across = [(f"{column}{row}", f"{column + 1}{row}") for column in range(columns - 1) for row in range(rows)]
    down = [(f"{column}{row}", f"{column}{row + 1}") for column in range(columns) for row in range(rows - 1)]
    streets = [Street(start, end, lanes=lanes, speed_limit=speed_limit) for start, end in (*across, *down)]
    return TownMap(places, tuple(streets), half_size)


TOWN03 = TownMap(
    places={
        "market": (0.0, 0.0),
        "ring": (240.0, 0.0),
        "north": (0.0, -170.0),
        "mill": (240.0, -170.0),
        "south": (0.0, 170.0),
        "quay": (240.0, 170.0),
        "west": (-130.0, 0.0),
    },
    streets=(
        Street("market", "ring", speed_limit=13.0),
        Street("north", "market", lanes=2, speed_limit=13.0),
        Street("market", "south", lanes=2, speed_limit=13.0),
        Street("mill", "ring"),
        Street("ring", "quay"),
        Street("north", "mill", ((60.0, -170.0), (110.0, -120.0), (160.0, -120.0), (200.0, -170.0)), radius=20.0),
        Street("south", "quay", ((50.0, 170.0), (120.0, 220.0), (190.0, 170.0)), radius=30.0),
        Street("market", "west", speed_limit=13.0),
        Street("west", "north", ((-130.0, -170.0),), radius=40.0),
        Street("west", "south", ((-130.0, 60.0), (-70.0, 110.0), (-70.0, 170.0)), radius=24.0),
        Street("ring", "quay", ((370.0, 0.0), (370.0, 170.0)), radius=50.0),
    ),
    half_size=20.0,
    roundabouts={"ring": 18.0},
)
"""A wide junction, a roundabout, and winding streets."""

TOWN06 = grid(3, 3, 260.0, 200.0, lanes=2, speed_limit=15.0, half_size=20.0)
"""Long streets of two lanes in either direction."""

TOWN07 = TownMap(
    places={"north": (0.0, -160.0), "south": (0.0, 160.0), "west": (-190.0, 0.0), "east": (190.0, 0.0)},
    streets=(
        Street("north", "east", ((90.0, -160.0), (130.0, -110.0), (190.0, -110.0)), radius=24.0),
        Street("east", "south", ((190.0, 90.0), (120.0, 90.0), (120.0, 160.0)), radius=30.0),
        Street("south", "west", ((-80.0, 160.0), (-130.0, 100.0), (-190.0, 100.0)), radius=24.0),
        Street("west", "north", ((-190.0, -80.0), (-110.0, -80.0), (-110.0, -160.0)), radius=30.0),
        Street("north", "south", ((0.0, -90.0), (60.0, -30.0), (60.0, 30.0), (0.0, 90.0)), radius=28.0),
    ),
    half_size=14.0,
)
"""Winding roads around a lake, and one over its dam."""

TOWN10 = grid(4, 4, 95.0, 85.0, lanes=1, speed_limit=11.0, half_size=14.0)
"""Many junctions close to each other."""

MAPS = {"town03": TOWN03, "town06": TOWN06, "town07": TOWN07, "town10": TOWN10}


@cache
def town(name: str) -> Town:
    """
    Build a town, once per process.

    :param name: key of ``MAPS``
    :return: the town, which nobody must change
    """
    plan, network = MAPS[name], Network()
    streets = tuple(
        network.street(_between_junctions(plan, street), street.lanes, street.lanes, street.speed_limit)
        for street in plan.streets
    )
    for place in plan.places:
        _join(plan, place, streets, network)
    road, ways = network.road(), tuple(network.ways)
    return Town(road, streets, ways, Crossings(road, ways))


def _join(plan: TownMap, place: str, streets: Streets, network: Network) -> None:
    """Lead from every street that ends at a place to every other one."""
    pairs = list(zip(plan.streets, streets, strict=True))
    ending, starting = ([both for street, both in pairs if street[end] == place] for end in (1, 0))
    arriving = [there for there, _ in ending] + [back for _, back in starting]
    leaving = [back for _, back in ending] + [there for there, _ in starting]
    speed_limit = min(street.speed_limit for street in plan.streets if place in street[:2])
    if place in plan.roundabouts:
        network.roundabout(plan.roundabout(place), arriving, leaving, speed_limit)
    else:
        network.junction(arriving, leaving, speed_limit)


def _between_junctions(plan: TownMap, street: Street) -> list[Piece]:
    pieces = rounded([plan.places[street.start], *street.via, plan.places[street.end]], street.radius)
    last = pieces[-1]
    pieces[-1] = last.cut(0.0, last.length - plan.size(street.end))
    pieces[0] = pieces[0].cut(plan.size(street.start), pieces[0].length)
    return pieces
