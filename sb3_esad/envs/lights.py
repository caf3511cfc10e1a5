"""Traffic lights: at a junction the streets of one direction have green while those across have red."""

from collections.abc import Sequence

import numpy as np

from sb3_esad.envs.geometry import Floats, box_corners
from sb3_esad.envs.networks import Way
from sb3_esad.envs.roads import Bools, Road

GREEN, ALL_RED = 8.0, 3.0  # for one direction, and for all of them after it [s]
AMBER = 2.0  # who cannot stop any more may pass a light that has been red for no longer than this [s]
SETBACK = 7.0  # one stops so far before the junction, for people cross in between [m]
LINE_DEPTH = 1.0  # of the line to stop at, along the lane [m]


class TrafficLights:
    """
    Lights for all ways of a road, each junction with a cycle that starts at its own time.

    :param road: the lanes
    :param ways: through all junctions
    :param offsets: by how much the cycle of each junction is ahead, shape ``(junctions,)`` [s]
    """

    def __init__(self, road: Road, ways: Sequence[Way], offsets: Floats) -> None:
        self._source = np.array([way.source for way in ways])
        heading = road.heading[self._source] + road.curvature[self._source] * road.length[self._source]
        self._across = np.abs(np.sin(heading)) > np.abs(np.cos(heading))
        self._ahead = offsets[np.array([way.junction for way in ways]) - 1]
        lines, self._line_of = np.unique(self._source, return_inverse=True)
        ends = np.array([road.position(lane, road.length[lane] - SETBACK) for lane in lines])
        size = np.tile([LINE_DEPTH, road.width[0]], (len(lines), 1))
        self._lines = box_corners(ends, heading[np.unique(self._line_of, return_index=True)[1]], size)

    def red(self, time: float) -> Bools:
        """
        Tell which ways must not be entered.

        :param time: since the start [s]
        :return: one truth value per way
        """
        phase = (time + self._ahead) % (2 * (GREEN + ALL_RED))
        green = np.where(self._across, (phase >= GREEN + ALL_RED) & (phase < 2 * GREEN + ALL_RED), phase < GREEN)
        return ~green

    def forbidden(self, time: float) -> Bools:
        """
        Tell which ways nobody may enter any more, not even those who could not stop.

        :param time: since the start [s]
        :return: one truth value per way
        """
        return self.red(time) & self.red(time - AMBER)

    def red_lines(self, time: float) -> Floats:
        """
        Show where one must stop.

        :param time: since the start [s]
        :return: corners of the lines before red lights, shape ``(n, 4, 2)`` [m]
        """
        return self._lines[np.unique(self._line_of[self.red(time)])]
