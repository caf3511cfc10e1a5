"""What an action means: acceleration and front-wheel angle of the ego vehicle."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Controls:
    """
    Translates between actions in [-1, 1]^2 and the bicycle model's inputs.

    The first component is acceleration (0 holds the speed), the second steering (positive to the right). Full lock is the
    wheels' limit at low speed and a lateral acceleration at high speed, so that the same command is sane at any speed.

    :param max_acceleration: reached at 1 [m/s^2]
    :param max_braking: reached at -1 [m/s^2]
    :param max_wheel_angle: [rad]
    :param max_lateral_acceleration: [m/s^2]
    :param max_speed: speeds stay within 0 and this [m/s]
    :param vehicle_size: length and width [m]
    """

    max_acceleration: float
    max_braking: float
    max_wheel_angle: float
    max_lateral_acceleration: float
    max_speed: float
    vehicle_size: tuple[float, float]

    def full_lock(self, speed: float) -> float:
        """
        Wheel angle of a full steering command.

        :param speed: [m/s]
        :return: [rad]
        """
        slip = np.arcsin(min(self.max_lateral_acceleration * self.vehicle_size[0] / 2 / max(speed, 1e-3) ** 2, 1.0))
        return float(min(np.arctan(2 * np.tan(slip)), self.max_wheel_angle))

    def decode(self, action: NDArray[np.floating], speed: float) -> tuple[float, float]:
        """
        Turn an action into acceleration and wheel angle.

        :param action: acceleration and steering, shape ``(2,)``, within [-1, 1]
        :param speed: [m/s]
        :return: acceleration [m/s^2] and wheel angle [rad]
        """
        pedal, wheel = float(action[0]), float(action[1])
        acceleration = pedal * (self.max_acceleration if pedal > 0 else self.max_braking)
        return acceleration, wheel * self.full_lock(speed)

    def encode(self, acceleration: float, wheel_angle: float, speed: float) -> NDArray[np.float32]:
        """
        Turn a wish into the nearest action, the inverse of :meth:`decode`.

        :param acceleration: [m/s^2]
        :param wheel_angle: [rad]
        :param speed: [m/s]
        :return: the action, shape ``(2,)``
        """
        pedal = acceleration / (self.max_acceleration if acceleration > 0 else self.max_braking)
        return np.clip([pedal, wheel_angle / self.full_lock(speed)], -1.0, 1.0).astype(np.float32)

    def limit(self, acceleration: float, speed: float, dt: float) -> float:
        """
        Keep the speed within its range over the next time step.

        :param acceleration: wanted [m/s^2]
        :param speed: present [m/s]
        :param dt: length of the step [s]
        :return: allowed [m/s^2]
        """
        return min(max(acceleration, -speed / dt), (self.max_speed - speed) / dt)
