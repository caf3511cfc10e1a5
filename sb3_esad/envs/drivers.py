"""Scripted drivers that set the marks for a scenario; some read the simulator's state, which an agent cannot."""

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from sb3_esad.envs.course import Course
from sb3_esad.envs.course_driver import CourseDriver
from sb3_esad.envs.lanes import NO_LANE
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.scenario import Scenario, scenario_of
from sb3_esad.envs.traffic import Traffic

Driver = Callable[[gymnasium.Env[Any, Any]], NDArray[np.float32]]

HEADING_GAIN, LATERAL_GAIN = 2.5, 0.7  # gentler than the traffic's, for who decides 5 times a second [1/s]
FALL_BACK = 2.0  # gently [m/s^2]
CREEP_SPEED, CREEP_ROOM = 3.0, 6.5  # [m/s], between centres [m]
SETTLED_OFFSET, SETTLED_HEADING = 0.5, 0.05  # a lane change is over within these [m], [rad]
_SELF = np.array([EGO])


class SpeedKeeper:
    """Holds its speed and its lane, whatever is ahead."""

    def __call__(self, env: gymnasium.Env[Any, Any]) -> NDArray[np.float32]:
        """
        Choose an action.

        :param env: a driving scenario, wrapped or not
        :return: acceleration and steering, shape ``(2,)``
        """
        scenario = scenario_of(env)
        return self._action(scenario, 0.0, int(scenario.traffic.lane[EGO]))

    def _action(self, scenario: Scenario, acceleration: float, lane: int) -> NDArray[np.float32]:
        wheel_angle = float(scenario.traffic.steering(_SELF, np.array([lane]), HEADING_GAIN, LATERAL_GAIN)[0])
        return scenario.controls.encode(acceleration, wheel_angle, float(scenario.traffic.speed[EGO]))


class CarFollower(SpeedKeeper):
    """Keeps its lane and follows the car ahead by the Intelligent Driver Model."""

    def __call__(self, env: gymnasium.Env[Any, Any]) -> NDArray[np.float32]:
        """See :meth:`SpeedKeeper.__call__`."""
        scenario = scenario_of(env)
        lane = self._lane(scenario)
        return self._action(scenario, self._acceleration(scenario, lane), lane)

    def _acceleration(self, scenario: Scenario, lane: int) -> float:
        lanes = {int(scenario.traffic.lane[EGO]), lane}
        waiting = float(scenario.traffic.stopping_acceleration(_SELF)[0])
        return min(waiting, *(self._following(scenario, each) for each in lanes))

    def _lane(self, scenario: Scenario) -> int:
        return int(scenario.traffic.lane[EGO])

    @staticmethod
    def _following(scenario: Scenario, lane: int) -> float:
        front, _ = scenario.traffic.neighbours(_SELF, np.array([lane]))
        return float(scenario.traffic.following_acceleration(_SELF, front, _SELF)[0])


class ReferenceDriver(CarFollower):
    """Follows by the Intelligent Driver Model and overtakes by MOBIL; one object per environment."""

    def __init__(self) -> None:
        self._episode: object = None
        self._target = NO_LANE

    def _lane(self, scenario: Scenario) -> int:
        traffic, lane = scenario.traffic, int(scenario.traffic.lane[EGO])
        reached = self._target not in (scenario.road.left[lane], scenario.road.right[lane])
        if scenario.episode is not self._episode or reached:
            self._episode, self._target = scenario.episode, lane
        if lane != self._target:
            if traffic.rival_ahead(EGO, self._target, traffic.target_lane):
                self._target = lane
        elif self._is_settled(scenario, lane):
            self._target = self._best_lane(scenario, lane)
        return self._target

    def _acceleration(self, scenario: Scenario, lane: int) -> float:
        """Fall back behind who is in the way of getting back; get out from behind an obstacle at a walking pace."""
        traffic, wanted = scenario.traffic, super()._acceleration(scenario, lane)
        own_lane = int(traffic.lane[EGO])
        if lane == own_lane and self._must_get_back(traffic, lane):
            return min(wanted, max(self._following(scenario, int(traffic.paths.towards[EGO, lane])), -FALL_BACK))
        if lane != own_lane and self._is_behind_obstacle(scenario):  # to follow the obstacle would be to stay
            return max(wanted, min(CREEP_SPEED - float(traffic.speed[EGO]), self._following(scenario, lane)))
        return wanted

    @staticmethod
    def _is_behind_obstacle(scenario: Scenario) -> bool:
        traffic, front = scenario.traffic, scenario.traffic.front[:1]
        return front[0] >= 0 and traffic.speed[front[0]] == 0 and traffic.distance(_SELF, front)[0] >= CREEP_ROOM

    @staticmethod
    def _must_get_back(traffic: Traffic, lane: int) -> bool:
        return bool(traffic.must_get_back(_SELF, np.array([lane]))[0])

    @staticmethod
    def _is_settled(scenario: Scenario, lane: int) -> bool:
        traffic = scenario.traffic
        straight = abs(scenario.heading_error) < SETTLED_HEADING
        return abs(traffic.across[lane, EGO]) < SETTLED_OFFSET and (straight or traffic.speed[EGO] < CREEP_SPEED)

    @staticmethod
    def _best_lane(scenario: Scenario, lane: int) -> int:
        road, traffic, route = scenario.road, scenario.traffic, scenario.route
        if ReferenceDriver._must_get_back(traffic, lane):
            back = int(traffic.paths.towards[EGO, lane])
            return back if traffic.change_is_safe(_SELF, np.array([back]))[0] else lane
        beside = [int(each) for each in (road.left[lane], road.right[lane]) if each != NO_LANE and route.contains[each]]
        beside = [each for each in beside if not ReferenceDriver._must_get_back(traffic, each)]
        worth = [each for each in beside if traffic.change_is_worth_it(_SELF, np.array([each]))[0]]
        return max(worth, key=lambda each: CarFollower._following(scenario, each)) if worth else lane


class RandomDriver:
    """
    Draws every action anew.

    :param seed: of its random numbers
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = np.random.default_rng(seed)

    def __call__(self, env: gymnasium.Env[Any, Any]) -> NDArray[np.float32]:
        """See :meth:`SpeedKeeper.__call__`."""
        return self._random.uniform(-1.0, 1.0, 2).astype(np.float32)


DRIVERS: dict[str, Callable[[Scenario, int], Driver]] = {
    "reference": lambda scenario, seed: CourseDriver() if isinstance(scenario, Course) else ReferenceDriver(),
    "follower": lambda scenario, seed: CarFollower(),
    "keeper": lambda scenario, seed: SpeedKeeper(),
    "random": lambda scenario, seed: RandomDriver(seed),
}
"""Makes a scripted driver for an episode of a scenario with a seed."""
