"""The geometry of a roundabout of one lane: arcs that lead in and out touch the ring, for everybody keeps to the right."""

import math
from typing import NamedTuple

from sb3_esad.envs.lanes import LANE_WIDTH
from sb3_esad.envs.pieces import Piece, Point

ENTRY_RADIUS = 14.0  # of the arcs that lead in and out [m]


class Roundabout(NamedTuple):
    """
    A ring with arms.

    :param centre: [m]
    :param radius: of the ring's centre line [m]
    """

    centre: Point
    radius: float

    @property
    def opening(self) -> float:
        """Angle on the ring between the axis of an arm and where its lanes touch [rad]."""
        return math.asin((LANE_WIDTH / 2 + ENTRY_RADIUS) / (self.radius + ENTRY_RADIUS))

    @property
    def half_size(self) -> float:
        """Distance from the centre at which the streets end [m]."""
        return (self.radius + ENTRY_RADIUS) * math.cos(self.opening)

    def ring(self, start: float, end: float) -> Piece:
        """
        Part of the ring, which is driven to the left.

        :param start: direction from the centre to where it starts [rad]
        :param end: direction to where it ends, further to the left [rad]
        :return: the piece
        """
        x = self.centre[0] + self.radius * math.cos(start)
        y = self.centre[1] + self.radius * math.sin(start)
        return Piece((x, y), start - math.pi / 2, self.radius * ((start - end) % (2 * math.pi)), -1 / self.radius)

    def entry(self, arm: float) -> Piece:
        """
        The arc from an arm into the ring.

        :param arm: direction of the arm from the centre [rad]
        :return: the piece
        """
        return self._exit(arm, -1.0).reversed()

    def exit(self, arm: float) -> Piece:
        """
        The arc from the ring into an arm.

        :param arm: direction of the arm from the centre [rad]
        :return: the piece
        """
        return self._exit(arm, 1.0)

    def _exit(self, arm: float, side: float) -> Piece:
        touches = arm + side * self.opening
        x = self.centre[0] + self.radius * math.cos(touches)
        y = self.centre[1] + self.radius * math.sin(touches)
        turn = math.pi / 2 - self.opening
        return Piece((x, y), touches - side * math.pi / 2, ENTRY_RADIUS * turn, side / ENTRY_RADIUS)
