"""The indoor course: from start to goal among boxes and cones, and people who walk across."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_esad.envs.episode import CourseEpisode
from sb3_esad.envs.geometry import Floats
from sb3_esad.envs.hazards import clearance
from sb3_esad.envs.lanes import Lane
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Markings, Road
from sb3_esad.envs.routes import Route
from sb3_esad.envs.scenario import Scenario
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, User
from sb3_esad.envs.walkers import Walkers

BEHIND = 3.0  # the hall goes on this far before the start and past the goal [m]
FREE_START, FREE_END = 5.0, 3.0  # nothing stands this near to the start and to the goal [m]
PASSAGE = 2.0  # between any two obstacles there is as much room [m]
WALL_GAP, PERSON_GAP = 0.7, 1.2  # of obstacles from the walls, and of people's ways from obstacles [m]
CONE = (0.4, 0.4)  # [m]
ATTEMPTS = 30


def hall(length: float, width: float) -> Road:
    """
    Build the hall, as one lane as wide as it.

    :param length: from start to goal, along the x axis [m]
    :param width: from wall to wall [m]
    :return: the road
    """
    start, end, half = -BEHIND, length + BEHIND, width / 2
    floor = np.array([[[start, -half], [end, -half], [end, half], [start, half]]])
    walls = np.array([[[start, y], [end, y]] for y in (-half, half)])
    goal = np.array([[[length, -half], [length, half]]])
    lines = np.concatenate([goal, walls])
    return Road([Lane((start, 0.0), 0.0, end - start, width=width)], Markings(floor, np.array([0]), lines, np.arange(3) < 1))


def _room(x: float, y: float, side: float, other: User) -> float:
    """Room between a square at a place and another one [m]."""
    return max(abs(x - other.position[0]), abs(y - other.position[1])) - (side + other.size[0]) / 2


class Course(Scenario):
    """Reach the goal 40 to 50 m ahead at 2 m/s among obstacles, sparse to dense. See :class:`Scenario`."""

    episode: CourseEpisode

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "duration": 60.0,
            "course_length": (40.0, 50.0),
            "hall_width": 12.0,
            "obstacles": (6, 26),
            "box_side": (0.6, 1.4),
            "people": 0,
            "walking_speed": 1.0,
            "walking_pause": (0.0, 2.0),
            "walking_caution": 0.0,
            "vehicle_size": (1.2, 0.8),
            "start_speed": (1.5, 2.0),
            "target_speed": 2.0,
            "max_speed": 2.5,
            "max_acceleration": 1.5,
            "max_braking": 3.0,
            "max_lateral_acceleration": 2.0,
            "velocity_sharpness": 2.0,
            "lane_tolerance": 6.0,
            "metres_per_pixel": (0.3, 0.2),
            "ahead": 0.8,
        }

    def _make_road(self) -> Road:
        self._length = float(self.np_random.uniform(*self.config["course_length"]))
        return hall(self._length, self.config["hall_width"])

    def _make_route(self) -> Route:
        return Route(self.road, [0], BEHIND, BEHIND + self._length)

    def _make_traffic(self) -> Traffic:
        config, random = self.config, self.np_random
        place = (0.0, float(random.uniform(-2.0, 2.0)))
        speed, size = float(random.uniform(*config["start_speed"])), config["vehicle_size"]
        ego = User(place, speed=speed, target_speed=config["target_speed"], drives=False, size=size)
        obstacles = self._place_obstacles(int(random.integers(config["obstacles"][0], config["obstacles"][1] + 1)))
        ends = self._draw_walks(obstacles)
        self.walkers = Walkers(random, ends, config["walking_speed"], config["walking_pause"], config["walking_caution"])
        return Traffic(self.road, [ego, *obstacles, *self.walkers.people()])

    def _place_obstacles(self, count: int) -> list[User]:
        """Boxes and cones at random places with room to pass between any two of them; fewer if the hall is full."""
        random, placed = self.np_random, list[User]()
        half = self.config["hall_width"] / 2 - WALL_GAP
        for _ in range(count * ATTEMPTS):
            side = float(random.uniform(*self.config["box_side"]))
            size = (side, side) if random.random() < 0.5 else CONE
            x, y = float(random.uniform(FREE_START, self._length - FREE_END)), float(random.uniform(-half, half))
            if all(_room(x, y, size[0], other) > PASSAGE for other in placed):
                placed.append(User((x, y), kind=Kind.STATIC, drives=False, size=size))
            if len(placed) == count:
                break
        return placed

    def _draw_walks(self, obstacles: list[User]) -> Floats:
        """Ways across the hall, wall to wall, past all obstacles, shape ``(people, 2, 2)``."""
        random, walks, edge = self.np_random, [], self.config["hall_width"] / 2 - WALL_GAP / 2
        for _ in range(self.config["people"]):
            for _ in range(ATTEMPTS):
                x = float(random.uniform(FREE_START + 3.0, self._length - FREE_END))
                if all(abs(x - each.position[0]) > PERSON_GAP for each in obstacles):
                    side = edge * random.choice([-1.0, 1.0])
                    walks.append([[x, side], [x, -side]])
                    break
        return np.array(walks).reshape(-1, 2, 2)

    def _before_physics(self) -> None:
        self.walkers.walk(self.traffic, self.episode.time)

    def _start_episode(self) -> CourseEpisode:
        return CourseEpisode(self.route.length)

    def _drive(self, action: NDArray[np.floating]) -> None:
        heading, metres = float(self.traffic.heading[EGO]), self.episode.distance
        super()._drive(action)
        turned, driven = float(self.traffic.heading[EGO]) - heading, self.episode.distance - metres
        self.episode.add_path(driven, turned, clearance(self.road, self.traffic))

    def _progress(self) -> float:
        return float(self.traffic.position[EGO, 0])


class PeopleCourse(Course):
    """The course with people who walk across it. See :class:`Course`."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {**super().default_config(), "obstacles": (4, 12), "people": 6}


class Course1(PeopleCourse):
    """With people who walk at 1 m/s. See :class:`Course`."""


class Course2(PeopleCourse):
    """With people who walk at 2 m/s. See :class:`Course`."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {**super().default_config(), "walking_speed": 2.0}


class Course3(PeopleCourse):
    """With people who run at 3 m/s. See :class:`Course`."""

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {**super().default_config(), "walking_speed": 3.0}
