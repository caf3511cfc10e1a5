"""The named terms of the reward (the paper's section "Design of the Reward Function"): pure functions, and their sum."""

import math
from collections import Counter
from typing import Any

REGION_LENGTH = 20.0  # [m]


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

    :param visits: steps n that were made in the region before
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


class DrivingReward:
    """
    The terms of one step, and their weighted sum.

    :param config: of the scenario; reads the weights, sharpnesses, tolerance and decay
    """

    def __init__(self, config: dict[str, Any]) -> None:
        self._config = config
        self._visits: Counter[tuple[int, int]] = Counter()

    def forget(self) -> None:
        """Count the visits of regions anew."""
        self._visits.clear()

    def terms(self, speed: float, error: float, lane: int, offset: float, progress: float) -> dict[str, float]:
        """
        Judge a step.

        :param speed: [m/s]
        :param error: angle between the vehicle and its lane [rad]
        :param lane: index of its lane
        :param offset: distance to the centre of its lane, either sign [m]
        :param progress: position along the route [m]
        :return: the terms by name
        """
        config, target, along_route = self._config, self._config["target_speed"], speed * math.cos(error)
        share = progress_share(along_route, target)
        region = (lane, int(progress // REGION_LENGTH))
        visits = self._visits[region]
        self._visits[region] += 1
        return {
            "velocity": velocity_reward(along_route, target, config["velocity_sharpness"]),
            "lane": lane_reward(offset, config["lane_tolerance"]) * share,
            "orientation": orientation_reward(error, config["orientation_sharpness"]) * share,
            "exploration": exploration_reward(visits, config["exploration_decay"]),
        }

    def total(self, terms: dict[str, float]) -> float:
        """
        Sum up.

        :param terms: of a step
        :return: the reward, 1 for a perfect step
        """
        return sum(self._config["reward_weights"][name] * value for name, value in terms.items())
