"""People who walk to and fro across the way of others."""

import numpy as np

from sb3_esad.envs.geometry import Floats
from sb3_esad.envs.roads import Bools, Ints
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, User

PERSON_SIZE = (0.6, 0.6)  # [m]
BERTH = 0.6  # people keep this far away from the side of a car, centre to side [m]


class Walkers:
    """
    People who walk from one place to another, wait, and walk back.

    :param random: where the waiting times come from
    :param ends: the two places of each, shape ``(n, 2, 2)`` [m]
    :param speed: of their walk [m/s]
    :param pause: shortest and longest time of waiting [s]
    """

    def __init__(self, random: np.random.Generator, ends: Floats, speed: float, pause: tuple[float, float]) -> None:
        self._random = random
        self._ends = ends
        self._speed = speed
        self._pause = pause
        self._goal = np.zeros(len(ends), dtype=np.int64)
        self._departure = random.uniform(0.0, pause[1], len(ends))

    def people(self) -> list[User]:
        """
        Place everybody at the first end.

        :return: the people, who must stay the only ones among the road users
        """
        return [User((x, y), kind=Kind.PERSON, drives=False, size=PERSON_SIZE) for x, y in self._ends[:, 0].tolist()]

    def walk(self, traffic: Traffic, time: float) -> None:
        """
        Let everybody walk or wait until the next call.

        :param traffic: all road users; speeds and headings of the people are set
        :param time: since the start [s]
        """
        rows = np.flatnonzero(traffic.kind == Kind.PERSON)
        offset = self._ends[np.arange(len(rows)), self._goal] - traffic.position[rows]
        arrived = np.flatnonzero((np.hypot(offset[:, 0], offset[:, 1]) < self._speed / 4) & (time >= self._departure))
        self._goal[arrived] = 1 - self._goal[arrived]
        self._departure[arrived] = time + self._random.uniform(*self._pause, len(arrived))
        offset = self._ends[np.arange(len(rows)), self._goal] - traffic.position[rows]
        traffic.heading[rows] = np.arctan2(offset[:, 1], offset[:, 0])
        free = ~self._would_touch_a_car(traffic, rows)
        traffic.speed[rows] = np.where((time >= self._departure) & free, self._speed, 0.0)

    @staticmethod
    def _would_touch_a_car(traffic: Traffic, rows: Ints) -> Bools:
        """Nobody walks into the side of a car."""
        cars = np.flatnonzero(traffic.kind == Kind.VEHICLE)
        heading = traffic.heading[rows]
        soon = traffic.position[rows] + np.stack([np.cos(heading), np.sin(heading)], -1)
        offset = soon[:, None] - traffic.position[cars]
        cos, sin = traffic.direction[cars].T
        along, across = offset[..., 0] * cos + offset[..., 1] * sin, offset[..., 1] * cos - offset[..., 0] * sin
        length, width = traffic.size[cars].T / 2 + BERTH
        return np.asarray(((np.abs(along) < length) & (np.abs(across) < width)).any(1))
