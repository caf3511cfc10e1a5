"""The frame that all driving scenarios share: spaces, time, physics, costs, rewards and the episode's record."""

import math
from copy import deepcopy
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_esad.envs.bev import Ground
from sb3_esad.envs.config import COMMON, check_config, merge_config
from sb3_esad.envs.drawing import Window, draw_scene
from sb3_esad.envs.episode import Episode
from sb3_esad.envs.geometry import bounded
from sb3_esad.envs.hazards import time_to_collision, users_hit
from sb3_esad.envs.lights import NO_LINES, StopLines
from sb3_esad.envs.observations import OBSERVATIONS, Observation
from sb3_esad.envs.rewards import DrivingReward
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Road
from sb3_esad.envs.routes import Route
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind
from sb3_esad.envs.vehicle import Controls

ONCOMING = 3 * math.pi / 4  # a lane that is turned further than this from the ego vehicle is one of oncoming traffic [rad]


class Scenario(gymnasium.Env[Any, NDArray[np.float32]]):
    """
    A drive along a route among other road users; subclasses place road and traffic.

    The action is acceleration and steering in [-1, 1]. ``info`` holds at every step ``cost`` (1 on a collision, off the
    road, in the wrong direction or past a red light, else 0, or with ``graded_cost`` up to 1 as something comes near),
    ``cost_terms``, ``rewards`` (the terms by name), ``speed`` and ``crashed``; at an episode's end also ``is_success`` and
    ``driving``, the record of :class:`Episode`.

    :param config: overrides of :meth:`default_config`
    :param observation: ``"image"``, ``"vector"`` or ``"dict"``
    :param render_mode: ``"rgb_array"``, ``"human"`` or None
    """

    metadata = {"render_modes": ["rgb_array", "human"], "render_fps": 5}  # noqa: RUF012 - typed by gymnasium
    road: Road
    route: Route
    traffic: Traffic
    episode: Episode

    def __init__(
        self, config: dict[str, Any] | None = None, observation: str = "image", render_mode: str | None = None
    ) -> None:
        if observation not in OBSERVATIONS:
            raise ValueError(f"unknown observation {observation!r}; choose one of {', '.join(OBSERVATIONS)}")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"unknown render_mode {render_mode!r}; choose one of {self.metadata['render_modes']} or None")
        self.config = merge_config(self.default_config(), config or {})
        check_config(self.config)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": self.config["policy_frequency"]}
        self.controls = Controls(*(self.config[name] for name in Controls.__dataclass_fields__))
        self.observation: Observation = OBSERVATIONS[observation](self.config)
        self.observation_space = self.observation.space
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        self.reward = DrivingReward(self.config)
        self._window: Window | None = None

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """
        Configuration of this scenario, with units in SI.

        :return: a new dictionary; subclasses update ``super()``'s
        """
        return deepcopy(COMMON)

    def _make_road(self) -> Road:
        """Build the road; drawn anew at every reset."""
        raise NotImplementedError

    def _make_route(self) -> Route:
        """Choose the way to take on ``self.road``."""
        raise NotImplementedError

    def _make_traffic(self) -> Traffic:
        """Place the ego vehicle (first) and all others on ``self.road``."""
        raise NotImplementedError

    def _start_episode(self) -> Episode:
        return Episode(self.route.length)

    def _before_physics(self) -> None:
        """Events of this scenario, called once per decision."""

    def _progress(self) -> float:
        """Position of the ego vehicle along the route [m]."""
        raise NotImplementedError

    def _ran_red_light(self) -> bool:
        """Whether the ego vehicle crossed a red light's stop line in this step."""
        return False

    def _is_success(self) -> bool:
        """Whether the route's end is reached."""
        return self._progress() >= self.route.length

    def _is_terminated(self) -> bool:
        """Whether the episode ends in a terminal state."""
        return self.crashed or self._is_success()

    @property
    def crashed(self) -> bool:
        """Whether the ego vehicle hit something or left the road."""
        return self.collided or self.off_road

    @property
    def max_episode_steps(self) -> int:
        """Decisions after which an episode is truncated."""
        return round(self.config["duration"] * self.config["policy_frequency"])

    def _is_truncated(self) -> bool:
        """Whether time is up."""
        return self.episode.steps >= self.max_episode_steps

    @property
    def stop_lines(self) -> StopLines:
        """The lines before lights that are not green."""
        return NO_LINES

    @property
    def remaining(self) -> float:
        """Share of the route that lies ahead, within [0, 1]."""
        return min(max(1.0 - self._progress() / self.route.length, 0.0), 1.0)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        Draw a new episode.

        :param seed: starts the random numbers, and the count of visited regions, anew
        :param options: none are known
        :return: the first observation, and an info with ``speed`` and ``crashed``
        """
        super().reset(seed=seed)
        if seed is not None:
            self.reward.forget()
        self.road = self._make_road()
        self.route = self._make_route()
        self.ground = Ground(self.road.markings, self.route.contains)
        self.traffic = self._make_traffic()
        self.episode = self._start_episode()
        self.collided = self.off_road = False
        self._note_heading()
        if self.render_mode == "human":
            self.render()
        return self.observation.observe(self), self._state()

    def step(self, action: NDArray[np.floating]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """
        Drive for one decision interval.

        :param action: acceleration and steering, shape ``(2,)``; clipped to [-1, 1]
        :return: observation, reward, terminated, truncated, info
        :raises ValueError: if the action has another shape or is not finite
        """
        action = np.asarray(action)
        if action.shape != (2,) or not np.isfinite(action).all():
            raise ValueError(f"action {action} is not two finite numbers; give acceleration and steering in [-1, 1]")
        self._drive(bounded(action, 1.0))
        terms = self._reward_terms()
        reward = self.reward.total(terms)
        cost_terms = self._cost_terms()
        ttc = time_to_collision(self.traffic)
        cost = max(float(any(cost_terms.values())), self._graded_cost(ttc))
        self.episode.add_outcome(reward, cost, ttc)
        terminated = self._is_terminated()
        truncated = not terminated and self._is_truncated()
        info = {"cost": cost, "cost_terms": cost_terms, "rewards": terms, **self._state()}
        if terminated or truncated:
            info.update(self._verdict())
        if self.render_mode == "human":
            self.render()
        return self.observation.observe(self), reward, terminated, truncated, info

    def _state(self) -> dict[str, Any]:
        return {"speed": float(self.traffic.speed[EGO]), "crashed": self.crashed}

    def _verdict(self) -> dict[str, Any]:
        success = self._is_success() and not self.crashed
        return {"is_success": success, "driving": self.episode.record(success)}

    def _drive(self, action: NDArray[np.floating]) -> None:
        traffic, frequency = self.traffic, self.config["physics_frequency"]
        dt, metres, duration = 1.0 / frequency, 0.0, 0.0
        self._before_physics()
        for _ in range(frequency // self.config["policy_frequency"]):
            speed = float(traffic.speed[EGO])
            acceleration, traffic.wheel_angle[EGO] = self.controls.decode(action, speed)
            traffic.acceleration[EGO] = self.controls.limit(acceleration, speed, dt)
            traffic.act()
            traffic.move(dt)
            metres, duration = metres + speed * dt, duration + dt
            self._check_crash()
            if self.crashed:
                break
        self._note_heading()
        self.episode.add_motion(duration, metres, self._progress(), self.on_route)

    def _note_heading(self) -> None:
        """Note the angle from the lane to the ego vehicle [rad], whether it drives against the traffic, or on its route."""
        lane = int(self.traffic.lane[EGO])
        turns, is_there = self.traffic.ego_on_lanes()
        self.heading_error = float(turns[lane])
        # Its lane is one of its direction if there is one nearby, also where it drives on one of oncoming traffic
        on_oncoming = bool(is_there.any() and np.abs(turns[is_there]).min() > ONCOMING)
        self.wrong_way = on_oncoming or abs(self.heading_error) > math.pi / 2
        self.on_route = bool(self.route.contains[lane]) and not self.wrong_way

    def _check_crash(self) -> None:
        hit = users_hit(self.traffic)
        self.collided = bool(hit.size)
        self.off_road = self.traffic.off_road
        if self.collided:
            self.episode.add_infraction(Kind(self.traffic.kind[hit[0]]).name.lower())
        elif self.off_road:
            self.episode.add_infraction("static")

    def _cost_terms(self) -> dict[str, bool]:
        red_light = self._ran_red_light()
        if red_light:
            self.episode.add_infraction("red_light")
        return {
            "collision": self.collided,
            "off_road": self.off_road,
            "wrong_way": self.wrong_way,
            "red_light": red_light,
        }

    def _graded_cost(self, ttc: float) -> float:
        return max(1.0 - ttc / self.config["graded_cost_ttc"], 0.0) if self.config["graded_cost"] else 0.0

    def _reward_terms(self) -> dict[str, float]:
        traffic, lane = self.traffic, int(self.traffic.lane[EGO])
        speed = float(traffic.speed[EGO]) if self.on_route else 0.0  # what leads elsewhere is no way along the route
        offset = float(traffic.across[lane, EGO])
        return self.reward.terms(speed, self.heading_error, lane, offset, self._progress())

    def render(self) -> NDArray[np.uint8] | None:
        """
        Draw the scene for people.

        :return: in mode ``"rgb_array"`` a picture, shape ``(rows, columns, 3)``; in mode ``"human"`` None, after showing it
        """
        if self.render_mode is None:
            return None
        picture = draw_scene(self)
        if self.render_mode == "rgb_array":
            return picture
        self._window = self._window or Window(self.metadata["render_fps"])
        self._window.show(picture)
        return None

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None


def scenario_of(env: gymnasium.Env[Any, Any]) -> Scenario:
    """
    The scenario inside its wrappers.

    :param env: a scenario, wrapped or not
    :return: the scenario
    :raises ValueError: if it is none
    """
    scenario = env.unwrapped
    if not isinstance(scenario, Scenario):
        name = env.spec.id if env.spec else scenario
        raise ValueError(f"{name} is no driving scenario; scripted drivers and videos need an id that starts with esad-.")
    return scenario
