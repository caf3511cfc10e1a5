"""What the ego vehicle has hit, and how soon it would hit what is in its path."""

from typing import NamedTuple

import numpy as np

from sb3_esad.envs.geometry import Floats, box_distances, boxes_overlap, in_frame
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
    x, y = (traffic.position - traffic.position[EGO]).T
    near = np.hypot(x, y) <= traffic.radius + traffic.radius[EGO]
    rows = near.nonzero()[0][1:]  # the ego vehicle comes first
    return rows[boxes_overlap(traffic.corners[EGO], traffic.corners[rows])] if rows.size else rows


def clearance(road: Road, traffic: Traffic) -> float:
    """
    Room between the ego vehicle and what is nearest: another road user, or the edge of the lanes it may use.

    :param road: the lanes
    :param traffic: all road users
    :return: at most 5 m, negative past the edge [m]
    """
    lane = int(traffic.lane[EGO])
    _, across = road.project(traffic.corners[EGO])
    room = min(NEARBY, *(side for corner in across.T for side in road.room(lane, corner)))
    reach = traffic.radius + traffic.radius[EGO] + NEARBY
    offset = np.abs(traffic.position - traffic.position[EGO])
    rows = np.flatnonzero((offset < reach[:, None]).all(1))[1:]
    if rows.size == 0:
        return room
    return min(room, float(box_distances(traffic.corners[EGO], traffic.corners[rows]).min()))


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

    The path is as wide as the ego vehicle and follows its heading; a user is as wide and as long as it is from there.

    :param traffic: all road users
    :return: infinite if nothing in the path is being approached [s]
    """
    ahead, across = in_frame((traffic.position - traffic.position[EGO]).T, traffic.direction[EGO])
    closing = traffic.speed[EGO] - traffic.velocity @ traffic.direction[EGO]
    length, width = traffic.size.T
    cos, sin = np.abs(in_frame(traffic.direction.T, traffic.direction[EGO]))
    beside = (length * sin + width * cos + width[EGO]) / 2
    rows = ((np.abs(across) < beside) & (ahead > 0) & (closing > 0)).nonzero()[0]
    if not rows.size:
        return np.inf
    gap = ahead[rows] - ((length * cos + width * sin)[rows] + length[EGO]) / 2
    return float((np.maximum(gap, 0.0) / closing[rows]).min())
