"""The towns: their plans, each built once per process."""

from functools import cache

from sb3_esad.envs.ring_plan import RingPlan
from sb3_esad.envs.town_plan import Street, Town, TownPlan


def grid(columns: int, rows: int, width: float, height: float, lanes: int, speed_limit: float, half_size: float) -> TownPlan:
    """
    Plan a town of straight streets.

    :param columns: number of streets from north to south
    :param rows: number of streets from west to east
    :param width: distance between columns [m]
    :param height: distance between rows [m]
    :param lanes: in either direction
    :param speed_limit: [m/s]
    :param half_size: of the junctions [m]
    :return: the plan; its places are named after column and row
    """
    places = {f"{column}{row}": (column * width, row * height) for column in range(columns) for row in range(rows)}
    across = [(f"{column}{row}", f"{column + 1}{row}") for column in range(columns - 1) for row in range(rows)]
    down = [(f"{column}{row}", f"{column}{row + 1}") for column in range(columns) for row in range(rows - 1)]
    streets = [Street(start, end, lanes=lanes, speed_limit=speed_limit) for start, end in (*across, *down)]
    return TownPlan(places, tuple(streets), half_size)


TOWN03 = TownPlan(
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
        Street("west", "south", ((-130.0, 60.0), (-70.0, 110.0), (-70.0, 170.0)), radius=24.0, narrowest=3.0),
        Street("ring", "quay", ((370.0, 0.0), (370.0, 170.0)), radius=50.0),
    ),
    half_size=20.0,
    roundabouts={"ring": 18.0},
)
"""A wide junction, a roundabout, winding streets, and a stretch as narrow as a tunnel."""

TOWN04 = RingPlan(
    width=620.0, height=480.0, radius=140.0, weaving=170.0, speed_limit=22.0, ramp_radius=70.0, ramp_speed_limit=15.0
)
"""A ring of motorway with ramps."""

TOWN06 = grid(3, 3, 260.0, 200.0, lanes=2, speed_limit=15.0, half_size=20.0)
"""Long streets of two lanes in either direction."""

TOWN07 = TownPlan(
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

PLANS: dict[str, TownPlan | RingPlan] = {
    "town03": TOWN03,
    "town04": TOWN04,
    "town06": TOWN06,
    "town07": TOWN07,
    "town10": TOWN10,
}


@cache
def town(name: str) -> Town:
    """
    Build a town, once per process.

    :param name: key of ``PLANS``
    :return: the town, which nobody must change
    :raises ValueError: if there is none of that name
    """
    if name not in PLANS:
        raise ValueError(f"there is no {name}; choose one of {', '.join(PLANS)}")
    return PLANS[name].build()
