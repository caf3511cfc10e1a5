"""Episode records for the environments of highway-env itself, so that the same metrics tell about them."""

from typing import Any, NamedTuple, SupportsFloat

import gymnasium
import numpy as np

from sb3_esad.envs.episode import Episode
from sb3_esad.envs.geometry import Floats
from sb3_esad.envs.hazards import time_to_collision

USUAL_LIMIT = 30.0  # of lanes without a limit of their own [m/s]


class Bodies(NamedTuple):
    """Vehicles and obstacles of a stock environment as arrays, the agent's vehicle first; see :class:`RoadUsers`."""

    position: Floats
    direction: Floats
    speed: Floats
    velocity: Floats
    size: Floats


def is_stock(env: gymnasium.Env[Any, Any]) -> bool:
    """
    Tell the environments of highway-env.

    :param env: any environment, wrapped or not
    :return: whether it is one of them
    """
    return any(each.__module__.startswith("highway_env.") for each in type(env.unwrapped).__mro__)


class StockRecord(gymnasium.Wrapper[Any, Any, Any, Any]):
    """
    Puts the record of an episode into ``info["driving"]`` at its end, as our scenarios do.

    A stock environment has no route: its completion is what was driven on the road, over what the speed limit allows in the
    whole duration. Leaving the road counts as a collision with something static, each time it happens.

    :param env: an environment of highway-env with one agent
    """

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Start an episode.

        :param seed: passed on
        :param options: passed on
        :return: what the environment returns
        """
        result = super().reset(seed=seed, options=options)
        scene: Any = self.unwrapped
        limit = scene.vehicle.lane.speed_limit or USUAL_LIMIT
        self.episode = Episode(scene.config["duration"] * limit)
        self._crashed, self._on_road = False, True
        return result

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        Step the environment and note what happened.

        :param action: passed on
        :return: what the environment returns, at an episode's end with the record
        """
        scene: Any = self.unwrapped
        before = scene.vehicle.position.copy()
        heading = float(scene.vehicle.heading)
        observation, reward, terminated, truncated, info = self.env.step(action)
        metres = float(np.hypot(*(scene.vehicle.position - before)))
        self._note_infractions(scene)
        progress = self.episode.furthest + (metres if self._on_road else 0.0)
        self.episode.add_motion(1 / scene.config["policy_frequency"], metres, progress, on_route=True)
        self.episode.add_path(metres, float(scene.vehicle.heading) - heading, np.inf)
        self.episode.add_outcome(float(reward), float(scene.vehicle.crashed), time_to_collision(_bodies(scene)))
        if terminated or truncated:
            info["driving"] = self.episode.record(success=truncated and not scene.vehicle.crashed)
        return observation, reward, terminated, truncated, info

    def _note_infractions(self, scene: Any) -> None:
        """Once for each event: a crash, or leaving the road."""
        vehicle = scene.vehicle
        if vehicle.crashed and not self._crashed:
            others = [each for each in scene.road.vehicles if each is not vehicle and each.crashed]
            self.episode.add_infraction("vehicle" if others else "static")
        elif self._on_road and not vehicle.on_road:
            self.episode.add_infraction("static")
        self._crashed, self._on_road = bool(vehicle.crashed), bool(vehicle.on_road)


def _bodies(scene: Any) -> Bodies:
    others = [each for each in (*scene.road.vehicles, *scene.road.objects) if each is not scene.vehicle]
    users = [scene.vehicle, *others]
    heading, speed = (np.array([float(getattr(user, name)) for user in users]) for name in ("heading", "speed"))
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    position = np.array([user.position for user in users], dtype=np.float64)
    size = np.array([[user.LENGTH, user.WIDTH] for user in users])
    return Bodies(position, direction, speed, speed[:, None] * direction, size)
