"""Who is on the road: cars of mixed temper, drawn at random."""

from typing import NamedTuple

import numpy as np

from sb3_esad.envs.lanes import CAR_LENGTH
from sb3_esad.envs.roads import Road
from sb3_esad.envs.users import Temper, User


class Stretch(NamedTuple):
    """
    A stretch of a lane to be filled with cars, distances from the lane's start.

    :param lane: its index
    :param start: no car is placed before this [m]
    :param end: nor past this [m]
    :param clear: between these two none is placed either [m]
    """

    lane: int
    start: float
    end: float
    clear: tuple[float, float] = (0.0, 0.0)


class Mix(NamedTuple):
    """
    What speeds the cars of a stretch would like to have, and how densely they drive; a few are much slower or faster.

    :param mean: of the desired speeds of the rest [m/s]
    :param spread: of these, to either side [m/s]
    :param slow_share: share of slow cars
    :param slow_speed: smallest and largest desired speed of these [m/s]
    :param fast_share: share of fast cars
    :param fast_speed: smallest and largest desired speed of these [m/s]
    :param headway: smallest and largest time gap between cars that are placed one behind the other [s]
    """

    mean: float
    spread: float
    slow_share: float
    slow_speed: tuple[float, float]
    fast_share: float
    fast_speed: tuple[float, float]
    headway: tuple[float, float]


class Population:
    """
    Draws cars.

    :param random: where the draws come from
    :param road: where the cars drive
    """

    def __init__(self, random: np.random.Generator, road: Road) -> None:
        self.random = random
        self.road = road

    def fill(self, stretch: Stretch, mix: Mix, first_speed: float) -> list[User]:
        """
        Fill a stretch with cars, front to back, none much faster than the one ahead of it.

        :param stretch: where
        :param mix: of their desired speeds
        :param first_speed: the first car is at most 1 m/s faster than this [m/s]
        :return: the cars
        """
        cars: list[User] = []
        along, ahead = stretch.end - self.random.uniform(0.0, 40.0), first_speed
        while along > stretch.start:
            desired = self._desired_speed(mix)
            if not stretch.clear[0] < along < stretch.clear[1]:
                speed = min(desired, ahead + 1.0)
                cars.append(self.car(stretch.lane, along, speed, desired, self.temper()))
                ahead = speed
            along -= CAR_LENGTH + desired * self.random.uniform(*mix.headway)
        return cars

    def _desired_speed(self, mix: Mix) -> float:
        draw = self.random.random()
        if draw < mix.slow_share:
            return float(self.random.uniform(*mix.slow_speed))
        if draw > 1.0 - mix.fast_share:
            return float(self.random.uniform(*mix.fast_speed))
        return float(mix.mean + self.random.uniform(-1.0, 1.0) * mix.spread)

    def temper(self) -> Temper:
        """
        Draw how someone drives.

        :return: the parameters of IDM and MOBIL
        """
        random = self.random
        return Temper(
            acceleration=float(random.uniform(2.0, 3.5)),
            gap=float(random.uniform(7.5, 9.5)),
            headway=float(random.uniform(0.7, 1.4)),
            exponent=float(random.uniform(3.5, 4.5)),
            politeness=float(random.uniform(0.0, 0.5)),
        )

    def car(self, lane: int, along: float, speed: float, desired: float, temper: Temper, path: tuple[int, ...] = ()) -> User:
        """
        Place a car in the middle of a lane.

        :param lane: its index
        :param along: distance from the lane's start [m]
        :param speed: [m/s]
        :param desired: the speed it would like to have [m/s]
        :param temper: how it drives
        :param path: lanes that it will take, if it is not to take what continues its own
        :return: the car
        """
        x, y = self.road.position(lane, along).tolist()
        heading = self.road.lanes[lane].heading_at(along)
        timer = float(self.random.uniform(0.0, temper.delay))
        return User((x, y), heading, speed, desired, temper=temper, timer=timer, path=path)
