"""Episode records for the environments of highway-env itself, so that the same metrics tell about them."""

from typing import Any, SupportsFloat

import gymnasium
import numpy as np

from sb3_esad.envs.episode import Episode
from sb3_esad.envs.hazards import Bodies, time_to_collision

USUAL_LIMIT = 30.0  # of lanes without a limit of their own [m/s]
BESIDE = 10.0  # a crashed vehicle this near is the one that was hit [m]


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
    whole duration, or all of it if the episode ended before its time without a crash. Leaving the road counts as a collision
    with something static, each time it happens.

    :param env: an environment of highway-env with one agent and a ``duration``
    :raises ValueError: if it has none
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        scene: Any = self.unwrapped
        if "duration" not in scene.config:
            reason = "its route has no end that a completion could refer to"
            raise ValueError(
                f"{env} has no 'duration' in its configuration: {reason}; give one, or choose another environment."
            )

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
        observation, reward, terminated, truncated, info = self.env.step(action)
        metres = float(np.hypot(*(scene.vehicle.position - before)))
        self._note_infractions(scene)
        progress = self.episode.furthest + (metres if self._on_road else 0.0)
        harmless = self._on_road and not self._crashed
        if terminated and harmless:
            progress = self.episode.route_length
        self.episode.add_motion(1 / scene.config["policy_frequency"], metres, progress, on_route=True)
        self.episode.add_outcome(float(reward), float(scene.vehicle.crashed), time_to_collision(_bodies(scene)))
        if terminated or truncated:
            info["driving"] = self.episode.record(success=harmless)
        return observation, reward, terminated, truncated, info

    def _note_infractions(self, scene: Any) -> None:
        """Once for each event: a crash, or leaving the road."""
        vehicle = scene.vehicle
        if vehicle.crashed and not self._crashed:
            others = [each for each in scene.road.vehicles if each is not vehicle and each.crashed]
            hit = any(np.hypot(*(each.position - vehicle.position)) < BESIDE for each in others)
            self.episode.add_infraction("vehicle" if hit else "static")
        elif self._on_road and not vehicle.on_road:
            self.episode.add_infraction("static")
        self._crashed, self._on_road = bool(vehicle.crashed), bool(vehicle.on_road)


def _bodies(scene: Any) -> Bodies:
    obstacles = [each for each in scene.road.objects if each.solid]
    others = [each for each in (*scene.road.vehicles, *obstacles) if each is not scene.vehicle]
    users = [scene.vehicle, *others]
    heading, speed = (np.array([float(getattr(user, name)) for user in users]) for name in ("heading", "speed"))
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    position = np.array([user.position for user in users], dtype=np.float64)
    size = np.array([[user.LENGTH, user.WIDTH] for user in users])
    return Bodies(position, direction, speed, speed[:, None] * direction, size)
