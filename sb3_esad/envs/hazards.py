"""What the ego vehicle has hit, and how soon it would hit what is in its path."""

from typing import NamedTuple

import numpy as np

from sb3_esad.envs.geometry import Floats, box_corners, box_distances, boxes_overlap
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Ints, Road
from sb3_esad.envs.traffic import Traffic

NEARBY = 5.0  # room beyond this need not be known [m]


def users_hit(traffic: Traffic) -> Ints:
    """
    Road users whose boxes overlap the ego vehicle's.

    :param traffic: all road users
    :return: their rows
    """
    reach = traffic.radius + traffic.radius[EGO]
    offset = np.abs(traffic.position - traffic.position[EGO])
    rows = np.flatnonzero((offset[:, 0] <= reach) & (offset[:, 1] <= reach))  # the ego vehicle comes first
    if rows.size == 1:
        return rows[1:]
    corners = box_corners(traffic.position[rows], traffic.heading[rows], traffic.size[rows])
    return rows[1:][boxes_overlap(corners[0], corners[1:])]


def is_off_road(road: Road, traffic: Traffic) -> bool:
    """
    Whether a corner of the ego vehicle is past the edge of the asphalt.

    :param road: the lanes
    :param traffic: all road users
    :return: True if it is
    """
    own = slice(EGO, EGO + 1)
    corners = box_corners(traffic.position[own], traffic.heading[own], traffic.size[own])[0]
    return not bool(road.contains(corners).all())


def clearance(road: Road, traffic: Traffic) -> float:
    """
    Room between the ego vehicle and what is nearest: another road user, or the edge of the lanes it may use.

    :param road: the lanes
    :param traffic: all road users
    :return: at most 5 m, negative past the edge [m]
    """
    corners = box_corners(traffic.position[:1], traffic.heading[:1], traffic.size[:1])[0]
    lane = int(traffic.lane[EGO])
    _, across = road.project(corners)
    room = min(NEARBY, *(side for corner in across.T for side in road.room(lane, corner)))
    reach = traffic.radius + traffic.radius[EGO] + NEARBY
    offset = np.abs(traffic.position - traffic.position[EGO])
    rows = np.flatnonzero((offset < reach[:, None]).all(1))[1:]
    if rows.size == 0:
        return room
    others = box_corners(traffic.position[rows], traffic.heading[rows], traffic.size[rows])
    return min(room, float(box_distances(corners, others).min()))


class Bodies(NamedTuple):
    """
    Road users that are none of ours, the ego vehicle first; all that a time to collision depends on.

    :param position: centres, shape ``(n, 2)`` [m]
    :param direction: unit vectors, shape ``(n, 2)``
    :param speed: shape ``(n,)`` [m/s]
    :param velocity: shape ``(n, 2)`` [m/s]
    :param size: length and width, shape ``(n, 2)`` [m]
    """

    position: Floats
    direction: Floats
    speed: Floats
    velocity: Floats
    size: Floats


def time_to_collision(traffic: Traffic | Bodies) -> float:
    """
    Smallest distance over closing speed to any user in the ego vehicle's path, if both kept their velocities.

    The path is as wide as the ego vehicle and follows its heading; a user is in it if its own width overlaps it.

    :param traffic: all road users
    :return: infinite if nothing in the path is being approached [s]
    """
    offset = traffic.position - traffic.position[EGO]
    cos, sin = traffic.direction[EGO]
    ahead = offset[:, 0] * cos + offset[:, 1] * sin
    across = offset[:, 1] * cos - offset[:, 0] * sin
    closing = traffic.speed[EGO] - traffic.velocity @ traffic.direction[EGO]
    in_path = (np.abs(across) < (traffic.size[:, 1] + traffic.size[EGO, 1]) / 2) & (ahead > 0) & (closing > 0)
    if not in_path.any():
        return np.inf
    gap = ahead - (traffic.size[:, 0] + traffic.size[EGO, 0]) / 2
    return float((np.maximum(gap[in_path], 0.0) / closing[in_path]).min())
