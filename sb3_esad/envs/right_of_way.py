"""Who may enter a junction: first come, first served, as long as the ways do not cross."""

from collections.abc import Sequence

import numpy as np

from sb3_esad.envs.lanes import NO_LANE
from sb3_esad.envs.networks import Way
from sb3_esad.envs.paths import LOOKAHEAD
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Bools, Road
from sb3_esad.envs.traffic import Traffic

ZONE = 25.0  # from here on one queues up, where there are no lights [m]
HARD_BRAKING = 6.0  # a red light is for those who can still stop like this [m/s^2]
APART = 3.0  # ways whose centre lines come nearer to each other than this cannot be driven at the same time [m]


class Crossings:
    """
    Which ways through junctions cross.

    :param road: the lanes
    :param ways: through all junctions
    """

    def __init__(self, road: Road, ways: Sequence[Way]) -> None:
        self.way_of = np.full(len(road.length), NO_LANE)
        """The way that each lane belongs to, ``NO_LANE`` outside junctions, shape ``(lanes,)``."""
        for number, way in enumerate(ways):
            self.way_of[list(way.lanes)] = number
        self.crosses = crossing(road, ways)


class RightOfWay:
    """
    Lets road users wait at the line before a junction while others are on, or will be first on, a way that crosses theirs.

    All vehicles queue, the ego vehicle too, but what it does is its own affair.

    :param crossings: of the road
    :param zone: how far before a junction one heeds it [m]
    """

    def __init__(self, crossings: Crossings, zone: float = ZONE) -> None:
        self._zone = zone
        self._way_of, self._crosses = crossings.way_of.tolist(), crossings.crosses
        self._queue: dict[int, int] = {}

    def regulate(self, traffic: Traffic, red: Bools | None = None, setback: float = 0.0) -> None:
        """
        Tell everybody where to stop.

        :param traffic: all road users; ``stop_distance`` is set
        :param red: whether each way has a red light; who waits there is in nobody's way
        :param setback: how far before the junction one stops [m]
        """
        vehicles = np.flatnonzero(traffic.is_vehicle).tolist()
        places = {row: place for row in vehicles if (place := self.way_ahead(traffic, row))}
        queue = {row: way for row, way in self._queue.items() if row in places and places[row][0] == way}
        newcomers = sorted((distance, row) for row, (_, distance) in places.items() if row not in queue)
        queue |= {row: places[row][0] for _, row in newcomers}
        inside = [row for row in queue if places[row][1] <= setback]
        waiting = [row for row in queue if places[row][1] > setback]
        self._queue = {row: queue[row] for row in (*inside, *waiting)}
        traffic.stop_distance[:] = np.inf
        before: list[int] = []
        for row, way in self._queue.items():
            left = places[row][1] - setback
            can_stop = left > float(traffic.speed[row]) ** 2 / (2 * HARD_BRAKING)
            must_stop = can_stop and red is not None and red[way]
            if must_stop or (left > 0 and self._crosses[way, before].any()):
                traffic.stop_distance[row] = left
            if not must_stop:
                before.append(way)

    def way_ahead(self, traffic: Traffic, row: int) -> tuple[int, float] | None:
        """
        Find the way that a user is on or comes to next.

        :param traffic: all road users
        :param row: the user
        :return: number of the way, and the distance from the line before it, at most 0 on the way [m]; None if it is far
        """
        lane = int(traffic.lane[row] if row == EGO else traffic.target_lane[row])
        distance = -float(traffic.along[lane, row])
        for _ in range(LOOKAHEAD):
            if (way := self._way_of[lane]) != NO_LANE:
                return way, distance
            distance += traffic.road.lanes[lane].length
            if distance > self._zone:
                return None
            lane = int(traffic.paths.next_lane[row, lane])
            if lane == NO_LANE:
                return None
        return None


def crossing(road: Road, ways: Sequence[Way]) -> Bools:
    """
    Find the ways that cannot be driven at the same time: they cross or merge, and do not come from the same lane.

    :param road: the lanes
    :param ways: through junctions
    :return: symmetric, shape ``(ways, ways)``
    """
    points = [np.concatenate([_points(road, lane) for lane in way.lanes]) for way in ways]
    crosses = np.zeros((len(ways), len(ways)), dtype=bool)
    for first, own in enumerate(ways):
        for second, other in enumerate(ways[:first]):
            if own.junction == other.junction and own.source != other.source:
                apart = points[first][:, None] - points[second][None]
                crosses[first, second] = crosses[second, first] = np.hypot(apart[..., 0], apart[..., 1]).min() < APART
    return crosses


def _points(road: Road, lane: int) -> np.ndarray:
    length = float(road.length[lane])
    return np.array([road.position(lane, along) for along in np.linspace(0.0, length, max(2, round(length)))])
