"""One lane of a road: a piece of constant curvature, and its place among the others."""

import math
from dataclasses import dataclass
from typing import Any

from sb3_esad.envs.pieces import Piece

CAR_LENGTH = 5.0
NO_LANE = -1
LANE_WIDTH = 4.0


@dataclass(frozen=True)
class Lane(Piece):
    """
    A lane of constant curvature; the fields of :class:`Piece` are those of its centre line.

    :param left: index of the lane one may change to on the left, ``NO_LANE`` if there is none
    :param right: the same on the right
    :param following: index of the lane that continues this one for who has no path, ``NO_LANE`` if it ends
    :param speed_limit: [m/s]
    :param width: [m]
    """

    left: int = NO_LANE
    right: int = NO_LANE
    following: int = NO_LANE
    speed_limit: float = 30.0
    width: float = LANE_WIDTH

    @classmethod
    def between(cls, start: tuple[float, float], end: tuple[float, float], **kwargs: Any) -> "Lane":
        """
        Make a straight lane.

        :param start: first point of the centre line [m]
        :param end: its last point [m]
        :param kwargs: the other fields
        :return: the lane
        """
        x, y = end[0] - start[0], end[1] - start[1]
        return cls(start, math.atan2(y, x), math.hypot(x, y), **kwargs)
