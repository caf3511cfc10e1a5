"""People who walk to and fro across the way of others."""

import numpy as np

from sb3_esad.envs.geometry import Floats, directions, in_frame
from sb3_esad.envs.roads import Bools, Ints
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, User

PERSON_SIZE = (0.6, 0.6)  # [m]
BERTH, BERTH_OF_STANDING = 0.6, 0.45  # people keep this far away from a car, and from one that stands, centre to side [m]
LOOK, LOOK_NEAR_STANDING = 1.0, 0.25  # they look as far ahead [m], and past a car that stands [s]
PATIENCE = 1.5  # who cannot go on for so long turns round [s]


class Walkers:
    """
    People who walk from one place to another, wait, and walk back.

    :param random: where the waiting times come from
    :param ends: the two places of each, shape ``(n, 2, 2)`` [m]
    :param speed: of their walk [m/s]
    :param pause: shortest and longest time of waiting [s]
    :param caution: nobody steps in front of a car that would be there within this time [s]
    """

    def __init__(
        self, random: np.random.Generator, ends: Floats, speed: float, pause: tuple[float, float], caution: float
    ) -> None:
        self._random = random
        self._ends = ends
        self._speed = speed
        self._pause = pause
        self._caution = caution
        self._goal = np.zeros(len(ends), dtype=np.int64)
        self._departure = random.uniform(0.0, pause[1], len(ends))
        self._held_up_since = np.full(len(ends), np.inf)

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
        rows = np.flatnonzero(traffic.is_person)
        offset = self._ends[np.arange(len(rows)), self._goal] - traffic.position[rows]
        arrived = np.flatnonzero((np.hypot(offset[:, 0], offset[:, 1]) < self._speed / 4) & (time >= self._departure))
        self._goal[arrived] = 1 - self._goal[arrived]
        self._departure[arrived] = time + self._random.uniform(*self._pause, len(arrived))
        offset = self._ends[np.arange(len(rows)), self._goal] - traffic.position[rows]
        traffic.heading[rows] = np.arctan2(offset[:, 1], offset[:, 0])
        walks, held_up = time >= self._departure, self._must_wait(traffic, rows)
        traffic.speed[rows] = np.where(walks & ~held_up, self._speed, 0.0)
        self._held_up_since = np.where(walks & held_up, np.minimum(self._held_up_since, time), np.inf)
        turning = time - self._held_up_since >= PATIENCE
        self._goal[turning] = 1 - self._goal[turning]

    def _must_wait(self, traffic: Traffic, rows: Ints) -> Bools:
        """Nobody walks into a car, nor right in front of one; who is in front of one already walks on."""
        cars = np.flatnonzero(traffic.is_vehicle)
        stands, speed, direction = traffic.speed[cars] < 0.1, traffic.speed[cars], traffic.direction[cars]
        look = np.where(stands, LOOK_NEAR_STANDING * self._speed, LOOK)
        here = traffic.position[rows].T[..., None] - traffic.position[cars].T[:, None]
        along, across = in_frame(here + look * directions(traffic.heading[rows]).T[..., None], direction)
        _, across_now = in_frame(here, direction)
        length, width = traffic.size[cars].T / 2 + np.where(stands, BERTH_OF_STANDING, BERTH)
        beside, ahead = np.abs(across) < width, along > 0
        touches = (np.abs(along) < length) & beside
        steps_in_front = ahead & (along < length + self._caution * speed) & beside & (np.abs(across_now) >= width)
        return np.asarray((touches | steps_in_front).any(1))
