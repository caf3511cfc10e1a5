"""Oriented boxes: their corners and whether they overlap. x points forward, y to the right, angles turn from x to y."""

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
AnyFloat = TypeVar("AnyFloat", float, Floats)
FloatKind = TypeVar("FloatKind", bound=np.floating)

_UNIT_CORNERS = np.array([[0.5, 0.5, -0.5, -0.5], [-0.5, 0.5, 0.5, -0.5]])[..., None]


def wrap_angle(angle: AnyFloat) -> AnyFloat:
    """
    Bring angles into [-pi, pi).

    :param angle: a number, or an array of any shape [rad]
    :return: the same directions, in [-pi, pi)
    """
    turned = angle + math.pi
    turned -= math.tau * np.floor(turned / math.tau)  # several times faster than %
    turned -= math.pi
    return turned


def bounded(value: NDArray[FloatKind], limit: float) -> NDArray[FloatKind]:
    """
    Keep values within plus and minus a limit; several times faster than ``np.clip`` on short arrays.

    :param value: any shape
    :param limit: at least 0
    :return: the same values, those beyond the limit replaced by it
    """
    return np.minimum(np.maximum(value, -limit), limit)


def directions(heading: Floats) -> Floats:
    """
    Unit vectors.

    :param heading: shape ``(n,)`` [rad]
    :return: shape ``(n, 2)``
    """
    return np.array([np.cos(heading), np.sin(heading)]).T.copy()  # as np.stack would lay it out, in less time


def in_frame(offset: Floats, direction: Floats) -> tuple[Floats, Floats]:
    """
    See points as a vehicle does, or each of n vehicles.

    :param offset: from its centre, along x and y, shape ``(2, ...)``, the last dimension being n if they are several [m]
    :param direction: of the vehicle, a unit vector, shape ``(2,)``, or of each, ``(n, 2)``
    :return: how far the points are ahead of it and to its right, each of the shape of ``offset[0]`` [m]
    """
    (x, y), (cos, sin) = offset, direction.T
    return x * cos + y * sin, y * cos - x * sin


def outlines(size: Floats) -> Floats:
    """
    Corners of boxes in their own frames: front left, front right, rear right, rear left.

    :param size: length and width, shape ``(n, 2)`` [m]
    :return: how far ahead of the centre they are and how far to the right, shape ``(2, 4, n)`` [m]
    """
    return _UNIT_CORNERS * size.T[:, None]


def placed(outline: Floats, position: Floats, direction: Floats) -> Floats:
    """
    Place boxes in the world.

    :param outline: from :func:`outlines`, shape ``(2, 4, n)`` [m]
    :param position: centres, shape ``(n, 2)`` [m]
    :param direction: of the long side, unit vectors, shape ``(n, 2)``
    :return: corners, shape ``(n, 4, 2)`` [m]
    """
    x, y = position.T
    cos_sin = direction.T[:, None]
    (ahead_cos, right_sin), (ahead_sin, right_cos) = outline * cos_sin, outline * cos_sin[::-1]
    return np.array([x + ahead_cos - right_sin, y + ahead_sin + right_cos]).transpose(2, 1, 0)


def box_corners(position: Floats, heading: Floats, size: Floats) -> Floats:
    """
    Corners of oriented boxes: front left, front right, rear right, rear left.

    :param position: centres, shape ``(n, 2)`` [m]
    :param heading: directions of the long side, shape ``(n,)`` [rad]
    :param size: length and width, shape ``(n, 2)`` [m]
    :return: corners, shape ``(n, 4, 2)`` [m]
    """
    return placed(outlines(size), position, directions(heading))


def boxes_overlap(box: Floats, others: Floats) -> NDArray[np.bool_]:
    """
    Whether one rectangle overlaps each of several, by the separating axis theorem.

    :param box: corners of one rectangle in order, shape ``(4, 2)`` [m]
    :param others: corners of the others, shape ``(n, 4, 2)`` [m]
    :return: one truth value per other rectangle, shape ``(n,)``; touching counts as overlap
    """
    pairs = np.empty((2, *others.shape))
    pairs[0], pairs[1] = box, others
    sides = pairs[:, :, 1:3] - pairs[:, :, :2]
    spans = np.concatenate([sides[0], sides[1]], axis=1) @ pairs.swapaxes(2, 3)  # of either box along each of four axes
    return np.asarray(~(spans.min(-1) > spans.max(-1)[::-1]).any((0, 2)))


def box_distances(box: Floats, others: Floats) -> Floats:
    """
    Room between one rectangle and each of several.

    :param box: corners of one rectangle in order, shape ``(4, 2)`` [m]
    :param others: corners of the others, shape ``(n, 4, 2)`` [m]
    :return: smallest distance to each of the others, 0 where they overlap, shape ``(n,)`` [m]
    """
    own = np.broadcast_to(box, others.shape)
    nearest = np.minimum(_corners_to_sides(own, others), _corners_to_sides(others, own))
    return np.where(boxes_overlap(box, others), 0.0, nearest)


def _corners_to_sides(corners: Floats, shapes: Floats) -> Floats:
    """Smallest distance from the corners of each first rectangle to the sides of each second one, shape ``(n,)`` [m]."""
    start, side = shapes[:, None], np.roll(shapes, -1, axis=1)[:, None] - shapes[:, None]
    offset = corners[:, :, None] - start
    share = np.clip((offset * side).sum(-1) / (side**2).sum(-1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * side, axis=-1).min((1, 2)))
