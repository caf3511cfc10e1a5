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


class Population:
    """
    Draws cars; a few of them are much slower or faster than the rest.

    :param random: where the draws come from
    :param road: where the cars drive
    :param slow_share: share of slow cars
    :param slow_speed: smallest and largest desired speed of these [m/s]
    :param fast_share: share of fast cars
    :param fast_speed: smallest and largest desired speed of these [m/s]
    :param spread: of the desired speeds of the rest, to either side of the mean [m/s]
    :param headway: smallest and largest time gap between cars that are placed one behind the other [s]
    """

    def __init__(
        self,
        random: np.random.Generator,
        road: Road,
        slow_share: float,
        slow_speed: tuple[float, float],
        fast_share: float,
        fast_speed: tuple[float, float],
        spread: float,
        headway: tuple[float, float],
    ) -> None:
        self.random = random
        self.road = road
        self.slow_share, self.slow_speed = slow_share, slow_speed
        self.fast_share, self.fast_speed = fast_share, fast_speed
        self.spread = spread
        self.headway = headway

    def fill(self, stretch: Stretch, mean_speed: float, first_speed: float) -> list[User]:
        """
        Fill a stretch with cars, front to back, none much faster than the one ahead of it.

        :param stretch: where
        :param mean_speed: mean of their desired speeds [m/s]
        :param first_speed: the first car is at most 1 m/s faster than this [m/s]
        :return: the cars
        """
        cars: list[User] = []
        along, ahead = stretch.end - self.random.uniform(0.0, 40.0), first_speed
        while along > stretch.start:
            desired = self.desired_speed(mean_speed)
            if not stretch.clear[0] < along < stretch.clear[1]:
                speed = min(desired, ahead + 1.0)
                cars.append(self.car(stretch.lane, along, speed, desired, self.temper()))
                ahead = speed
            along -= CAR_LENGTH + desired * self.random.uniform(*self.headway)
        return cars

    def desired_speed(self, mean: float) -> float:
        """
        Draw the speed that a car would like to have.

        :param mean: of the cars that are neither slow nor fast [m/s]
        :return: [m/s]
        """
        draw = self.random.random()
        if draw < self.slow_share:
            return float(self.random.uniform(*self.slow_speed))
        if draw > 1.0 - self.fast_share:
            return float(self.random.uniform(*self.fast_speed))
        return float(mean + self.random.uniform(-1.0, 1.0) * self.spread)

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
        heading = float(self.road.heading_at(np.array([lane]), np.array([along]))[0])
        timer = float(self.random.uniform(0.0, temper.delay))
        return User((x, y), heading, speed, desired, temper=temper, timer=timer, path=path)
