"""The named terms of the reward (the paper's section "Design of the Reward Function"), as pure functions."""

import math


def velocity_reward(speed: float, target_speed: float, sharpness: float) -> float:
    """
    R_v = 1 / (1 + lambda |v - v*|), shifted and scaled to be 0 at rest and 1 at the target speed.

    Deviation from the paper, whose term pays a parked car: 1 / (1 + lambda v*) a step, for nothing.

    :param speed: along the route, negative if against it [m/s]
    :param target_speed: v* [m/s]
    :param sharpness: lambda [s/m]; the larger, the less speeds far from the target are told apart
    :return: at most 1; 0 at rest and when driving back
    """
    if speed <= 0.0:
        return 0.0
    at_rest = 1.0 / (1.0 + sharpness * target_speed)
    return (1.0 / (1.0 + sharpness * abs(speed - target_speed)) - at_rest) / (1.0 - at_rest)


def lane_reward(offset: float, tolerance: float) -> float:
    """
    R_l = 1 - d / d_max, and -1 past d_max.

    :param offset: distance d to the nearest lane centre of the route's direction, either sign [m]
    :param tolerance: d_max [m]
    :return: within [-1, 1]
    """
    distance = abs(offset)
    return -1.0 if distance > tolerance else 1.0 - distance / tolerance


def orientation_reward(error: float, sharpness: float) -> float:
    """
    R_o = 1 / (1 + mu |theta - theta*|).

    :param error: angle between the vehicle and its lane [rad]
    :param sharpness: mu [1/rad]
    :return: within (0, 1]
    """
    return 1.0 / (1.0 + sharpness * abs(error))


def exploration_reward(visits: int, decay: float) -> float:
    """
    R_e = exp(-nu n).

    :param visits: how often n the region was entered before
    :param decay: nu
    :return: within (0, 1]
    """
    return math.exp(-decay * visits)


def progress_share(speed: float, target_speed: float) -> float:
    """
    The factor on the lane and orientation terms, so that parking or spinning straight in a lane pays nothing.

    :param speed: along the route, negative if against it [m/s]
    :param target_speed: [m/s]
    :return: 0 at rest, 1 from the target speed on
    """
    return min(max(speed, 0.0) / target_speed, 1.0)
