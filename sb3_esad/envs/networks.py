"""Builds roads out of streets and the junctions where they meet."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np

from sb3_esad.envs.geometry import Floats
from sb3_esad.envs.lanes import LANE_WIDTH, NO_LANE, Lane
from sb3_esad.envs.pieces import Piece, turning
from sb3_esad.envs.roads import DASH_LENGTH, DASH_PERIOD, Markings, Road
from sb3_esad.envs.roundabouts import Roundabout

SIDE_TURN = math.pi / 6  # a way through a junction that turns by more than this leads to the side [rad]
COMFORTABLE = 2.5  # nobody need take a bend with a greater acceleration to the side than this [m/s^2]
FACET = math.pi / 18  # arcs are drawn as straight facets of at most this angle [rad]


class Carriageway(NamedTuple):
    """
    The lanes of one direction of a street, from the left to the right.

    :param lanes: indices of each lane's pieces from start to end
    """

    lanes: tuple[tuple[int, ...], ...]

    @property
    def entries(self) -> list[int]:
        """The first piece of each lane."""
        return [lane[0] for lane in self.lanes]

    @property
    def exits(self) -> list[int]:
        """The last piece of each lane."""
        return [lane[-1] for lane in self.lanes]


class Way(NamedTuple):
    """
    A way through a junction.

    :param source: lane that it comes from
    :param target: lane that it leads to
    :param lanes: in between
    :param junction: number of the junction
    """

    source: int
    target: int
    lanes: tuple[int, ...]
    junction: int


class Network:
    """Collects lanes; all traffic keeps to the right."""

    def __init__(self) -> None:
        self.ways: list[Way] = []
        self._junctions = 0
        self._pieces: list[Piece] = []
        self._rest: list[dict[str, Any]] = []
        self._lines: list[Floats] = []
        self._dashes: list[Floats] = []

    def street(
        self, pieces: Sequence[Piece], lanes: int, speed_limit: float, narrowest: float = LANE_WIDTH
    ) -> tuple[Carriageway, Carriageway]:
        """
        Add a street for both directions.

        :param pieces: of the line between the directions
        :param lanes: number of lanes in either direction
        :param speed_limit: [m/s]
        :param narrowest: width of the lanes on all but the first and the last piece [m]
        :return: the lanes along the pieces, and those against them
        """
        there = self.carriageway(pieces, lanes, speed_limit, narrowest)
        return there, self.carriageway([piece.reversed() for piece in reversed(pieces)], lanes, speed_limit, narrowest)

    def carriageway(
        self, pieces: Sequence[Piece], count: int, speed_limit: float, narrowest: float = LANE_WIDTH
    ) -> Carriageway:
        """
        Add lanes of one direction.

        :param pieces: of the line at their left
        :param count: number of lanes
        :param speed_limit: [m/s]
        :param narrowest: width of the lanes on all but the first and the last piece [m]
        :return: the lanes
        """
        first, last = len(self._pieces), len(pieces) - 1
        for number, piece in enumerate(pieces):
            width = narrowest if 0 < number < last else LANE_WIDTH
            for place in range(count):
                self._add(
                    piece.beside((place + 0.5) * LANE_WIDTH),
                    speed_limit,
                    left=len(self._pieces) - 1 if place > 0 else NO_LANE,
                    right=len(self._pieces) + 1 if place < count - 1 else NO_LANE,
                    following=len(self._pieces) + count if number < last else NO_LANE,
                    width=width,
                )
            self._mark(piece, count, (LANE_WIDTH - width) / 2)
        return Carriageway(tuple(tuple(range(first + place, len(self._pieces), count)) for place in range(count)))

    def _add(self, piece: Piece, speed_limit: float, **rest: float) -> None:
        in_bends = math.sqrt(COMFORTABLE / max(abs(piece.curvature), 1e-6))
        self._pieces.append(piece)
        self._rest.append({**rest, "speed_limit": min(speed_limit, in_bends)})

    def _mark(self, piece: Piece, count: int, inset: float) -> None:
        self._lines += [facets(piece.beside(across)) for across in (inset, count * LANE_WIDTH - inset)]
        for place in range(1, count):
            between = piece.beside(place * LANE_WIDTH)
            for start in np.arange(0.0, between.length, DASH_PERIOD).tolist():
                self._dashes.append(facets(between.cut(start, min(start + DASH_LENGTH, between.length))))

    def follow(self, sources: Sequence[int], targets: Sequence[int]) -> None:
        """
        Let lanes that start where others end continue them.

        :param sources: lanes that end
        :param targets: the lane that starts where each of them ends
        """
        for source, target in zip(sources, targets, strict=True):
            self._rest[source]["following"] = target

    def choose(self, source: int, targets: Sequence[int]) -> None:
        """
        Let routes go on, past the end of a lane, on any of several lanes beside each other.

        :param source: lane that ends
        :param targets: the lane that continues it, and others beside that one
        """
        self.ways += [Way(source, target, (), self._junctions) for target in targets]

    def connect(self, source: int, target: int, speed_limit: float) -> None:
        """
        Lead from the end of a lane to the start of another.

        :param source: index of the lane that ends
        :param target: index of the lane that starts
        :param speed_limit: lower where it turns sharply [m/s]
        :raises ValueError: if no arc leads there
        """
        end, start = self._pieces[source], self._pieces[target]
        x, y = end.end.tolist()
        self._lead(source, target, turning((x, y), end.heading_at(end.length), start.start, start.heading), speed_limit)

    def _lead(self, source: int, target: int, pieces: Sequence[Piece], speed_limit: float) -> None:
        first = len(self._pieces)
        for number, piece in enumerate(pieces, 1):
            self._add(piece, speed_limit, following=first + number if number < len(pieces) else target)
        if self._rest[source]["following"] == NO_LANE:
            self._rest[source]["following"] = first
        self.ways.append(Way(source, target, tuple(range(first, len(self._pieces))), self._junctions))

    def junction(self, arriving: Sequence[Carriageway], leaving: Sequence[Carriageway], speed_limit: float) -> None:
        """
        Lead from every street to every other one: to the right from the rightmost lane, to the left from the leftmost.

        Where only two streets meet, every lane leads on.

        :param arriving: lanes that end here, one carriageway for each street
        :param leaving: lanes that start here, in the same order
        :param speed_limit: [m/s]
        :raises ValueError: if a street cannot be reached by an arc
        """
        self._junctions += 1
        for number, coming in enumerate(arriving):
            for other, going in enumerate(leaving):
                if other != number:
                    for source, target in self._lanes_to_join(coming, going, len(arriving) == 2):
                        self.connect(source, target, speed_limit)

    def _lanes_to_join(self, coming: Carriageway, going: Carriageway, is_bend: bool) -> list[tuple[int, int]]:
        end, start = self._pieces[coming.exits[0]], self._pieces[going.entries[0]]
        turn = math.remainder(start.heading - end.heading_at(end.length), 2 * math.pi)
        if is_bend or abs(turn) <= SIDE_TURN:
            return list(zip(coming.exits, going.entries, strict=False))
        side = -1 if turn > 0 else 0
        return [(coming.exits[side], going.entries[side])]

    def roundabout(
        self, ring: Roundabout, arriving: Sequence[Carriageway], leaving: Sequence[Carriageway], speed_limit: float
    ) -> None:
        """
        Lead from every street to every other one by a ring, on which one turns to the left.

        :param ring: its geometry
        :param arriving: lanes that end at its rim, one carriageway for each street
        :param leaving: lanes that start there, in the same order
        :param speed_limit: [m/s]
        """
        self._junctions += 1
        arms = [self._pieces[going.entries[0]].heading for going in leaving]
        order = sorted(range(len(arms)), key=lambda arm: -(arms[arm] % (2 * math.pi)))
        first = len(self._pieces)
        for arm, following in zip(order, [*order[1:], order[0]], strict=True):
            self._add(ring.ring(arms[arm] - ring.opening, arms[following] + ring.opening), speed_limit, following=NO_LANE)
        for place, arm in enumerate(order):
            before, after = first + (place - 1) % len(order), first + place
            self._lead(arriving[arm].exits[-1], after, [ring.entry(arms[arm])], speed_limit)
            self._lead(before, leaving[arm].entries[-1], [ring.exit(arms[arm])], speed_limit)
            past = ring.ring(arms[arm] + ring.opening, arms[arm] - ring.opening)
            self._lead(before, after, [past], speed_limit)

    def road(self) -> Road:
        """
        Finish.

        :return: the lanes and what the drawings show of them
        """
        lanes = [Lane(**asdict(piece), **rest) for piece, rest in zip(self._pieces, self._rest, strict=True)]
        surfaces = [surface(lane) for lane in lanes]
        lines = np.concatenate([np.zeros((0, 2, 2)), *self._dashes, *self._lines])
        is_dash = np.arange(len(lines)) < sum(map(len, self._dashes))
        along = np.repeat(np.arange(len(lanes)), [len(each) for each in surfaces])
        return Road(lanes, Markings(np.concatenate(surfaces), along, lines, is_dash))


def facets(piece: Piece) -> Floats:
    """
    Draw a piece as straight lines.

    :param piece: straight or an arc
    :return: from point to point, shape ``(n, 2, 2)`` [m]
    """
    count = max(1, math.ceil(abs(piece.curvature) * piece.length / FACET - 1e-6))
    points = np.array([piece.position(piece.length * index / count) for index in range(count + 1)])
    return np.stack([points[:-1], points[1:]], axis=1)


def surface(lane: Lane) -> Floats:
    """
    Draw the asphalt of a lane.

    :param lane: where it is
    :return: convex pieces of four corners, shape ``(n, 4, 2)`` [m]
    """
    left, right = facets(lane.beside(-lane.width / 2)), facets(lane.beside(lane.width / 2))
    return np.concatenate([left, right[:, ::-1]], axis=1)
