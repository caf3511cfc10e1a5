"""Pieces of constant curvature, of which every centre line is made; x points forward, y to the right."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sb3_esad.envs.geometry import Floats

Point = tuple[float, float]
STRAIGHT = 1e-9  # a turn below this is none [rad]
SHORTEST = 1e-3  # a piece shorter than this is left out [m]


@dataclass(frozen=True)
class Piece:
    """
    A straight line or an arc.

    :param start: first point [m]
    :param heading: direction at the start [rad]
    :param length: [m]
    :param curvature: 0 if it is straight, positive where it turns right [1/m]
    """

    start: Point
    heading: float
    length: float
    curvature: float = 0.0

    def heading_at(self, along: float) -> float:
        """
        Direction.

        :param along: distance from the start [m]
        :return: not wrapped [rad]
        """
        return self.heading + self.curvature * along

    def position(self, along: float, across: float = 0.0) -> Floats:
        """
        Point at given coordinates.

        :param along: distance from the start [m]
        :param across: distance to the right [m]
        :return: shape ``(2,)`` [m]
        """
        half = self.curvature * along / 2
        chord = along * np.sinc(half / np.pi)
        middle, turned = self.heading + half, self.heading_at(along)
        forward = chord * np.array([math.cos(middle), math.sin(middle)])
        return np.asarray(self.start + forward + across * np.array([-math.sin(turned), math.cos(turned)]))

    @property
    def end(self) -> Floats:
        """The last point, shape ``(2,)`` [m]."""
        return self.position(self.length)

    def cut(self, first: float, last: float) -> "Piece":
        """
        Take a part of it.

        :param first: where the part starts, distance from the start [m]
        :param last: where it ends [m]
        :return: the part
        """
        x, y = self.position(first).tolist()
        return Piece((x, y), self.heading_at(first), last - first, self.curvature)

    def beside(self, across: float) -> "Piece":
        """
        Move it sideways, so that it stays parallel.

        :param across: distance to the right, less than the radius of an arc that turns right [m]
        :return: the piece that accompanies this one
        """
        x, y = self.position(0.0, across).tolist()
        stretch = 1.0 - self.curvature * across
        return Piece((x, y), self.heading, self.length * stretch, self.curvature / stretch)

    def reversed(self) -> "Piece":
        """
        Turn it round.

        :return: the same points from end to start
        """
        x, y = self.end.tolist()
        return Piece((x, y), self.heading_at(self.length) + math.pi, self.length, -self.curvature)


def rounded(points: Sequence[Point], radius: float) -> list[Piece]:
    """
    Connect points by straight lines whose corners are rounded.

    :param points: at least two [m]
    :param radius: of the corners [m]
    :return: the pieces, each starting where the one before it ends, in its direction
    :raises ValueError: if two corners are too close to each other for the radius
    """
    pieces: list[Piece] = []
    places = np.asarray(points, dtype=np.float64)
    steps = np.diff(places, axis=0)
    lengths, headings = np.hypot(steps[:, 0], steps[:, 1]), np.arctan2(steps[:, 1], steps[:, 0])
    turns = (np.diff(headings) + np.pi) % (2 * np.pi) - np.pi
    tangents = np.concatenate([[0.0], radius * np.tan(np.abs(turns) / 2), [0.0]])
    for index, length in enumerate(lengths.tolist()):
        heading, first, last = float(headings[index]), float(tangents[index]), float(tangents[index + 1])
        if length - first - last < -SHORTEST:
            raise ValueError(f"corners at {points[index]} and {points[index + 1]} are too close for a radius of {radius} m")
        line = Piece(points[index], heading, length)
        if length - first - last > SHORTEST:
            pieces.append(line.cut(first, length - last))
        if index < len(turns) and abs(turns[index]) > STRAIGHT:
            x, y = line.position(length - last).tolist()
            pieces.append(Piece((x, y), heading, radius * abs(float(turns[index])), math.copysign(1 / radius, turns[index])))
    return pieces


def turning(start: Point, heading: float, end: Point, end_heading: float) -> list[Piece]:
    """
    Lead from one line onto another by the widest arc that fits, and a straight piece before or after it.

    :param start: where to leave the first line [m]
    :param heading: of the first line [rad]
    :param end: where to arrive on the second line [m]
    :param end_heading: of the second line [rad]
    :return: one or two pieces
    :raises ValueError: if the lines do not meet between the points
    """
    turn = (end_heading - heading + math.pi) % (2 * math.pi) - math.pi
    x, y = end[0] - start[0], end[1] - start[1]
    ahead, beside = x * math.cos(heading) + y * math.sin(heading), y * math.cos(heading) - x * math.sin(heading)
    if abs(turn) < STRAIGHT and abs(beside) < SHORTEST:
        return [Piece(start, heading, ahead)]
    after = beside / math.sin(turn) if abs(turn) > STRAIGHT else -1.0
    before = ahead - after * math.cos(turn)
    if min(before, after) <= 0 or math.pi - abs(turn) < STRAIGHT:
        raise ValueError(f"no arc leads from {start} onto the line to {end}: their lines do not meet between these points")
    corner = (start[0] + before * math.cos(heading), start[1] + before * math.sin(heading))
    radius = min(before, after) / math.tan(abs(turn) / 2)
    return rounded([start, corner, end], radius)
