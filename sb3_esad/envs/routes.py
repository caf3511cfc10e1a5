"""The way that the ego vehicle is to take, as lanes of a road."""

from collections.abc import Sequence

import numpy as np

from sb3_esad.envs.roads import Road


class Route:
    """
    Lanes one after the other; those that one may change to from them belong to it, too.

    :param road: the lanes
    :param lanes: indices of lanes, each continued by the next
    :param start: where the route starts on the first of them [m]
    :param end: where it ends on the last of them [m]
    """

    def __init__(self, road: Road, lanes: Sequence[int], start: float, end: float) -> None:
        self.lanes = tuple(lanes)
        self.contains = np.zeros(len(road.length), dtype=bool)
        self._before = np.zeros(len(road.length))
        self._stretch = np.ones(len(road.length))
        metres = -start
        for lane in lanes:
            for each in road.with_lanes_beside([lane]):
                self.contains[each] = True
                self._before[each], self._stretch[each] = metres, road.length[lane] / road.length[each]
            metres += float(road.length[lane])
        self.length = metres - float(road.length[lanes[-1]]) + end

    def progress(self, lane: int, along: float) -> float:
        """
        Position along the route.

        :param lane: index of a lane of the route
        :param along: distance from the lane's start [m]
        :return: distance from the route's start, as on its own lanes, which are not as long as those beside them in a bend [m]
        """
        return float(self._before[lane] + along * self._stretch[lane])
