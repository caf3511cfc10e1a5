"""What a road user is: its kind, its body and, for a car that drives itself, its temper."""

from dataclasses import dataclass, field
from enum import IntEnum

from sb3_esad.envs.lanes import CAR_LENGTH

CAR_WIDTH = 2.0


class Kind(IntEnum):
    """Kinds of road users; the infraction of hitting one is named after it."""

    VEHICLE = 0
    STATIC = 1
    PERSON = 2


@dataclass(frozen=True)
class Temper:
    """
    Parameters of IDM (following) and MOBIL (lane changes); the defaults are highway-env's.

    :param acceleration: comfortable acceleration a [m/s^2]
    :param braking: comfortable deceleration b [m/s^2]
    :param gap: distance between centres when stopped [m]
    :param headway: time gap T to the car ahead [s]
    :param exponent: exponent delta of the free-road term
    :param politeness: weight p of what others gain or lose by a lane change
    :param gain: least advantage that makes a lane change worth it [m/s^2]
    :param imposed_braking: hardest braking a lane change may ask of the new follower [m/s^2]
    :param delay: time between two thoughts about changing lane [s]
    """

    acceleration: float = 3.0
    braking: float = 5.0
    gap: float = 5.0 + CAR_LENGTH
    headway: float = 1.5
    exponent: float = 4.0
    politeness: float = 0.0
    gain: float = 0.2
    imposed_braking: float = 2.0
    delay: float = 1.0


@dataclass(frozen=True)
class User:
    """
    A road user as a scenario places it.

    :param position: centre [m]
    :param heading: [rad]
    :param speed: [m/s]
    :param target_speed: the speed it would like to have [m/s]
    :param kind: what it is
    :param drives: whether it drives by IDM and MOBIL; otherwise it is moved by the scenario or stands
    :param size: length and width [m]
    :param temper: how it drives
    :param timer: time since it last thought about changing lane [s]
    :param path: indices of lanes that it takes one after the other; elsewhere it takes the lane that continues its own
    """

    position: tuple[float, float]
    heading: float = 0.0
    speed: float = 0.0
    target_speed: float = 0.0
    kind: Kind = Kind.VEHICLE
    drives: bool = True
    size: tuple[float, float] = (CAR_LENGTH, CAR_WIDTH)
    temper: Temper = field(default_factory=Temper)
    timer: float = 0.0
    path: tuple[int, ...] = ()
