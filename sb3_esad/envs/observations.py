"""What an agent sees of a scenario: an image, a vector, or both."""

import math
from typing import Any, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_esad.envs.bev import BirdsEyeView
from sb3_esad.envs.geometry import Floats, wrap_angle
from sb3_esad.envs.lanes import LANE_WIDTH
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.scene import Scene
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.view import View

SPEED_SCALE, DISTANCE_SCALE, WIDTH_SCALE = 30.0, 100.0, 16.0  # [m/s], [m], [m]
EGO_FEATURES = ("speed", "heading_error", "lane_offset", "route_left", "room_left", "room_right")
USER_FEATURES = ("presence", "ahead", "right", "speed_ahead", "speed_right", "cos", "sin")


class Observation(Protocol):
    """A way to see a scene; ``space`` holds every array that ``observe`` returns."""

    space: spaces.Space[Any]

    def observe(self, scene: Scene) -> Any:
        """
        See the scene as it is now.

        :param scene: the scenario
        :return: an element of ``space``
        """


class ImageObservation:
    """
    Bird's-eye view, uint8, channel first.

    :param config: of the scenario; reads ``image_shape``, ``metres_per_pixel``, ``ahead`` and ``frame``
    """

    def __init__(self, config: dict[str, Any]) -> None:
        view = View(config["image_shape"], config["metres_per_pixel"], config["ahead"])
        self.space: spaces.Space[Any] = spaces.Box(0, 255, (3, *view.shape), np.uint8)
        self._bev = BirdsEyeView(view)
        self._frame = config["frame"]

    def observe(self, scene: Scene) -> NDArray[np.uint8]:
        """See :meth:`Observation.observe`."""
        traffic = scene.traffic
        heading = traffic.heading[EGO] - (scene.heading_error if self._frame == "lane" else 0.0)
        return self._bev.draw(scene.ground, traffic, scene.stop_lines, heading)


class EgoObservation:
    """
    The state of the ego vehicle, ``EGO_FEATURES`` in this order, scaled to [-1, 1] and cut off there.

    :param config: of the scenario; reads nothing
    """

    def __init__(self, config: dict[str, Any]) -> None:
        self.space: spaces.Space[Any] = spaces.Box(-1.0, 1.0, (len(EGO_FEATURES),), np.float32)

    def observe(self, scene: Scene) -> NDArray[np.float32]:
        """See :meth:`Observation.observe`."""
        traffic, lane = scene.traffic, int(scene.traffic.lane[EGO])
        offset = float(traffic.across[lane, EGO])
        left, right = scene.road.room(lane, traffic.across[:, EGO])
        values = (
            traffic.speed[EGO] / SPEED_SCALE,
            scene.heading_error / math.pi,
            offset / (LANE_WIDTH / 2),
            scene.remaining,
            left / WIDTH_SCALE,
            right / WIDTH_SCALE,
        )
        return np.clip(values, -1.0, 1.0).astype(np.float32)


class VectorObservation:
    """
    The ego vehicle's state and the nearest road users in its frame, ``USER_FEATURES`` each, padded with zeros.

    :param config: of the scenario; reads ``neighbours``
    """

    def __init__(self, config: dict[str, Any]) -> None:
        self._ego = EgoObservation(config)
        self._count = int(config["neighbours"])
        length = len(EGO_FEATURES) + self._count * len(USER_FEATURES)
        self.space: spaces.Space[Any] = spaces.Box(-1.0, 1.0, (length,), np.float32)

    def observe(self, scene: Scene) -> NDArray[np.float32]:
        """See :meth:`Observation.observe`."""
        users = np.zeros((self._count, len(USER_FEATURES)), dtype=np.float32)
        seen = nearest_users(scene.traffic, self._count)
        users[: len(seen)] = seen
        return np.concatenate([self._ego.observe(scene), users.ravel()])


def nearest_users(traffic: Traffic, count: int) -> Floats:
    """
    Road users within 100 m of the ego vehicle, in its frame, nearest first.

    :param traffic: all road users
    :param count: how many at most
    :return: ``USER_FEATURES`` of each within [-1, 1], shape ``(at most count, 7)``
    """
    offset = traffic.position - traffic.position[EGO]
    distance = np.hypot(offset[:, 0], offset[:, 1])
    distance[EGO] = np.inf
    rows = np.argsort(distance, kind="stable")[:count]
    rows = rows[distance[rows] <= DISTANCE_SCALE]
    cos, sin = traffic.direction[EGO]
    to_ego = np.array([[cos, -sin], [sin, cos]])
    velocity = (traffic.velocity[rows] - traffic.velocity[EGO]) @ to_ego / SPEED_SCALE
    turn = wrap_angle(traffic.heading[rows] - traffic.heading[EGO])
    place = offset[rows] @ to_ego / [DISTANCE_SCALE, WIDTH_SCALE]
    features = np.column_stack([np.ones(len(rows)), place, velocity, np.cos(turn), np.sin(turn)])
    return np.clip(features, -1.0, 1.0)


class DictObservation:
    """
    The image, and as ``vector`` the ego vehicle's state.

    :param config: of the scenario
    """

    def __init__(self, config: dict[str, Any]) -> None:
        self._parts: dict[str, Observation] = {"image": ImageObservation(config), "vector": EgoObservation(config)}
        self.space: spaces.Space[Any] = spaces.Dict({name: part.space for name, part in self._parts.items()})

    def observe(self, scene: Scene) -> dict[str, Any]:
        """See :meth:`Observation.observe`."""
        return {name: part.observe(scene) for name, part in self._parts.items()}


OBSERVATIONS: dict[str, type[Any]] = {
    "image": ImageObservation,
    "vector": VectorObservation,
    "dict": DictObservation,
}
