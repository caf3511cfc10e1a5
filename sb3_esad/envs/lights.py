"""Traffic lights: at a junction the streets of one direction have green while those across have red."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_esad.envs.geometry import Floats, box_corners
from sb3_esad.envs.networks import Way
from sb3_esad.envs.roads import Bools, Road

GREEN, AMBER, CLEARING = 8.0, 2.0, 1.0  # for one direction, then amber, then red for all [s]
PERIOD = 2 * (GREEN + AMBER + CLEARING)  # of both directions [s]
SETBACK = 7.0  # one stops so far before the junction, for people cross in between [m]
LINE_DEPTH = 1.0  # of the line to stop at, along the lane [m]


class StopLines(NamedTuple):
    """
    Lines that one had better not cross.

    :param corners: shape ``(n, 4, 2)`` [m]
    :param red: whether the light is red already, not amber, shape ``(n,)``
    """

    corners: Floats
    red: Bools


NO_LINES = StopLines(np.zeros((0, 4, 2)), np.zeros(0, dtype=bool))


class TrafficLights:
    """
    Lights for all ways of a road, each junction with a cycle that starts at its own time.

    :param road: the lanes
    :param ways: through all junctions
    :param offsets: by how much the cycle of each junction is ahead, shape ``(junctions,)`` [s]
    """

    def __init__(self, road: Road, ways: Sequence[Way], offsets: Floats) -> None:
        source = np.array([way.source for way in ways])
        heading = road.heading_at(source, road.length[source])
        across = np.abs(np.sin(heading)) > np.abs(np.cos(heading))
        self._delay = np.where(across, PERIOD / 2, 0.0)
        self._ahead = offsets[np.array([way.junction for way in ways]) - 1]
        lanes, self._first_way = np.unique(source, return_index=True)  # all ways from a lane turn green together
        ends = np.array([road.position(lane, road.length[lane] - SETBACK) for lane in lanes])
        size = np.tile([LINE_DEPTH, road.width[0]], (len(lanes), 1))
        self._lines = box_corners(ends, heading[self._first_way], size)

    def _phase(self, time: float) -> Floats:
        """Time since each way's light turned green [s]."""
        return np.asarray((time + self._ahead - self._delay) % PERIOD)

    def closed(self, time: float) -> Bools:
        """
        Tell which ways have amber or red: who can stop, stops.

        :param time: since the start [s]
        :return: one truth value per way
        """
        return self._phase(time) >= GREEN

    def red(self, time: float) -> Bools:
        """
        Tell which ways must not be entered.

        :param time: since the start [s]
        :return: one truth value per way
        """
        return self._phase(time) >= GREEN + AMBER

    def lines(self, time: float) -> StopLines:
        """
        Show where one stops.

        :param time: since the start [s]
        :return: the lines before all lights that are not green
        """
        closed = self.closed(time)[self._first_way]
        return StopLines(self._lines[closed], self.red(time)[self._first_way][closed])
