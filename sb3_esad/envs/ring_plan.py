"""The plan of a ring of motorway, on which ramps lead from one side to the next."""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeVar

from sb3_esad.envs.lanes import LANE_WIDTH
from sb3_esad.envs.networks import Carriageway, Network
from sb3_esad.envs.pieces import Piece, rounded
from sb3_esad.envs.right_of_way import Crossings
from sb3_esad.envs.town_plan import Town

Item = TypeVar("Item")

SIDES = 4
BESIDE = 14.0  # ramps run this far beside the motorway [m]
LEAVING = (25.0, 75.0)  # a ramp leaves the motorway between these distances from where its lane ends [m]


class RingPlan(NamedTuple):
    """
    A one-way motorway round a rectangle, driven to the left, two lanes wide.

    In the middle of each side a third lane begins, at the end of an on-ramp, and ends as the off-ramp to the next side: who
    stays on it leaves, and who is to stay on the motorway must get off it.

    :param width: of the rectangle, along the x axis [m]
    :param height: [m]
    :param radius: of the bends, at their inner edge [m]
    :param weaving: length of the third lane [m]
    :param speed_limit: of the motorway [m/s]
    :param ramp_radius: of the bends of the ramps [m]
    :param ramp_speed_limit: [m/s]
    """

    width: float
    height: float
    radius: float
    weaving: float
    speed_limit: float
    ramp_radius: float
    ramp_speed_limit: float

    def build(self) -> Town:
        """
        Build the ring.

        :return: its lanes; the ways are the choices between motorway and ramps
        """
        network, sides = Network(), self._sides()
        weaving = [network.carriageway([self._weaving(side)], 3, self.speed_limit) for side in sides]
        bends, ramps = [], []
        for side, following in _round(sides):
            bends.append(network.carriageway(self._bend(side, following), 2, self.speed_limit))
            ramps.append(network.carriageway(self._ramp(side, following), 1, self.ramp_speed_limit))
        for (before, after), bend, ramp in zip(_round(weaving), bends, ramps, strict=True):
            network.follow(before.exits, [*bend.entries, *ramp.entries])
            network.follow([*bend.exits, *ramp.exits], after.entries)
            for source in (bend.exits[-1], ramp.exits[-1]):
                network.choose(source, after.entries[1:])
        road = network.road()
        carriageways: list[Carriageway] = [*weaving, *bends, *ramps]
        return Town(road, tuple((each,) for each in carriageways), tuple(network.ways), Crossings(road, ()))

    def _sides(self) -> list[Piece]:
        """The inner edges of the four sides, from corner to corner."""
        right, up = self.width / 2, self.height / 2
        corners = [(-right, up), (right, up), (right, -up), (-right, -up)]
        lengths = [self.width, self.height] * (SIDES // 2)
        return [
            Piece(corner, -index * math.pi / 2, length)
            for index, (corner, length) in enumerate(zip(corners, lengths, strict=True))
        ]

    def _weaving(self, side: Piece) -> Piece:
        return side.cut(*self._ends(side))

    def _ends(self, side: Piece) -> tuple[float, float]:
        """Where the third lane begins and ends [m]."""
        return (side.length - self.weaving) / 2, (side.length + self.weaving) / 2

    def _bend(self, side: Piece, following: Piece) -> list[Piece]:
        """The inner edge of the motorway from one third lane to the next."""
        start, end = side.position(self._ends(side)[1]), following.position(self._ends(following)[0])
        return rounded([tuple(start.tolist()), following.start, tuple(end.tolist())], self.radius)

    def _ramp(self, side: Piece, following: Piece) -> list[Piece]:
        """The inner edge of the ramp from one third lane to the next."""
        near = 2 * LANE_WIDTH
        far = near + BESIDE
        leaves, arrives = self._ends(side)[1], self._ends(following)[0]
        away = ((0.0, near), (LEAVING[0], near), (LEAVING[1], far))
        points = [side.position(leaves + past, across) for past, across in away]
        points.append(side.position(side.length + far, far))
        points += [following.position(arrives - left, across) for left, across in reversed(away)]
        return rounded([tuple(point.tolist()) for point in points], self.ramp_radius)


def _round(items: Sequence[Item]) -> Iterator[tuple[Item, Item]]:
    """Each item with the one after it; the last with the first."""
    return itertools.pairwise([*items, items[0]])
