"""Oriented boxes: their corners and whether they overlap. x points forward, y to the right, angles turn from x to y."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_UNIT_CORNERS = np.array([[0.5, -0.5], [0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5]])


def wrap_angle(angle: Floats) -> Floats:
    """
    Bring angles into [-pi, pi).

    :param angle: angles of any shape [rad]
    :return: the same directions, in [-pi, pi)
    """
    turned = angle + np.pi
    return turned - 2 * np.pi * np.floor(turned / (2 * np.pi)) - np.pi  # several times faster than %


def box_corners(position: Floats, heading: Floats, size: Floats) -> Floats:
    """
    Corners of oriented boxes: front left, front right, rear right, rear left.

    :param position: centres, shape ``(n, 2)`` [m]
    :param heading: directions of the long side, shape ``(n,)`` [rad]
    :param size: length and width, shape ``(n, 2)`` [m]
    :return: corners, shape ``(n, 4, 2)`` [m]
    """
    local = _UNIT_CORNERS * size[:, None, :]
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    corners = np.empty_like(local)
    corners[..., 0] = position[:, None, 0] + local[..., 0] * cos - local[..., 1] * sin
    corners[..., 1] = position[:, None, 1] + local[..., 0] * sin + local[..., 1] * cos
    return corners


def boxes_overlap(box: Floats, others: Floats) -> NDArray[np.bool_]:
    """
    Whether one rectangle overlaps each of several, by the separating axis theorem.

    :param box: corners of one rectangle in order, shape ``(4, 2)`` [m]
    :param others: corners of the others, shape ``(n, 4, 2)`` [m]
    :return: one truth value per other rectangle, shape ``(n,)``; touching counts as overlap
    """
    own = np.broadcast_to(box, others.shape)
    sides = (own[:, 1] - own[:, 0], own[:, 2] - own[:, 1], others[:, 1] - others[:, 0], others[:, 2] - others[:, 1])
    axes = np.stack(sides, 1)
    first = np.einsum("nad,ncd->nac", axes, own)
    second = np.einsum("nad,ncd->nac", axes, others)
    gaps = (first.min(-1) > second.max(-1)) | (second.min(-1) > first.max(-1))
    return np.asarray(~gaps.any(-1))


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
