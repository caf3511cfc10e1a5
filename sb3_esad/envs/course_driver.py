"""A scripted driver for where there are no lanes: it tries out arcs and takes the one that leads nearest to the goal."""

import heapq
import math
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from sb3_esad.envs.geometry import Floats, wrap_angle
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.scenario import Scenario, scenario_of
from sb3_esad.envs.users import Kind

CELL, INFLATION = 0.25, 0.75  # of the grid on which the way to the goal is searched, and of what is in the way there [m]
STEP, STEPS = 0.1, 28  # of the arcs [s]
WHEELS, SPEEDS = np.linspace(-1.0, 1.0, 17), np.array([0.0, 0.5, 1.0, 1.5, 2.0])  # [full lock], [m/s]
CONTACT, COMFORT = 0.12, 0.6  # room to others that an arc must leave, and that it had better leave [m]


class CourseDriver:
    """Searches the way to the goal once an episode, and arcs along it at every decision."""

    def __init__(self) -> None:
        self._episode: object = None

    def __call__(self, env: gymnasium.Env[Any, Any]) -> NDArray[np.float32]:
        """
        Choose an action.

        :param env: an indoor course, wrapped or not
        :return: acceleration and steering, shape ``(2,)``
        """
        scenario = scenario_of(env)
        if scenario.episode is not self._episode:
            self._episode, self._field = scenario.episode, distance_to_goal(scenario)
        traffic, speed = scenario.traffic, float(scenario.traffic.speed[EGO])
        wheels, targets = (each.ravel() for each in np.meshgrid(WHEELS, SPEEDS))
        places, headings = self._arcs(scenario, wheels, targets)
        room = clearance(scenario, places, headings)
        here = clearance(scenario, traffic.position[None, :1], traffic.heading[None, :1]).item()
        harmless = room.min(1) > min(CONTACT, here - 1e-6)  # who is nearer to something already must not get even nearer
        left = self._field.at(places[:, -1]) + 0.3 * np.abs(wrap_angle(headings[:, -1] - traffic.heading[EGO]))
        worth = left + 2.0 * np.maximum(COMFORT - room.min(1), 0.0) - 0.2 * targets
        best = int(np.where(harmless, worth, np.inf).argmin())
        target = targets[best] if harmless[best] else 0.0
        wheel_angle = wheels[best] * scenario.controls.full_lock(speed)
        return scenario.controls.encode((target - speed) * scenario.config["policy_frequency"], wheel_angle, speed)

    @staticmethod
    def _arcs(scenario: Scenario, wheels: Floats, targets: Floats) -> tuple[Floats, Floats]:
        traffic, controls = scenario.traffic, scenario.controls
        speed = np.full(len(wheels), traffic.speed[EGO])
        heading, place = np.full(len(wheels), traffic.heading[EGO]), np.tile(traffic.position[EGO], (len(wheels), 1))
        places, headings = [], []
        slip = np.arctan(0.5 * np.tan(wheels * controls.max_wheel_angle))
        for _ in range(STEPS):
            course = heading + slip
            place = place + (speed * STEP)[:, None] * np.stack([np.cos(course), np.sin(course)], -1)
            heading = heading + speed * np.sin(slip) / (controls.vehicle_size[0] / 2) * STEP
            speed = speed + np.clip(targets - speed, -controls.max_braking * STEP, controls.max_acceleration * STEP)
            places.append(place)
            headings.append(heading)
        return np.stack(places, 1), np.stack(headings, 1)


def clearance(scenario: Scenario, places: Floats, headings: Floats) -> Floats:
    """
    Room that the ego vehicle would have on its way, whether people go on as they do or stop.

    :param scenario: with the others where they are now
    :param places: of its centre, shape ``(arcs, steps, 2)`` [m]
    :param headings: shape ``(arcs, steps)`` [rad]
    :return: to the nearest of the others or of the walls, shape ``(arcs, steps)`` [m]
    """
    traffic, (length, width) = scenario.traffic, scenario.controls.vehicle_size
    rows = np.arange(1, len(traffic.speed))
    times = STEP * np.arange(1, places.shape[1] + 1)
    going_on = traffic.position[rows] + times[:, None, None] * traffic.velocity[rows]
    stopping = np.broadcast_to(traffic.position[rows], going_on.shape)
    others = np.concatenate([going_on, stopping], axis=1)
    half = np.tile(traffic.size[rows] / 2 + (traffic.kind[rows] == Kind.PERSON)[:, None] * 0.15, (2, 1))
    offsets = np.linspace(-0.5, 0.5, 3) * (length - width)
    rooms = []
    for offset in offsets.tolist():
        centre = places + offset * np.stack([np.cos(headings), np.sin(headings)], -1)
        apart = np.abs(centre[:, :, None] - others) - half
        outside = np.hypot(*np.moveaxis(np.maximum(apart, 0.0), -1, 0))
        walls = scenario.road.width[0] / 2 - np.abs(centre[..., 1])
        rooms.append(np.minimum(outside.min(-1, initial=np.inf), walls))
    return np.minimum.reduce(rooms) - width / 2


class DistanceField:
    """
    Distance to the goal on a grid.

    :param values: shape ``(columns, rows)`` [m]
    :param corner: centre of the first cell [m]
    """

    def __init__(self, values: Floats, corner: Floats) -> None:
        self._values, self._corner = values, corner

    def at(self, places: Floats) -> Floats:
        """
        Look up.

        :param places: shape ``(n, 2)`` [m]
        :return: shape ``(n,)`` [m]
        """
        scaled = np.clip((places - self._corner) / CELL, 0.0, np.array(self._values.shape) - 1.001)
        cell, share = scaled.astype(int), scaled % 1
        (x, y), (u, v) = cell.T, share.T
        values = self._values
        return (1 - u) * ((1 - v) * values[x, y] + v * values[x, y + 1]) + u * (
            (1 - v) * values[x + 1, y] + v * values[x + 1, y + 1]
        )


def distance_to_goal(scenario: Scenario) -> DistanceField:
    """
    Search the ways to the goal past all that stands, by Dijkstra's algorithm.

    :param scenario: at its start
    :return: distances; 100 m more inside obstacles
    """
    traffic, length, half = scenario.traffic, scenario.route.length, float(scenario.road.width[0]) / 2
    columns, rows = np.arange(-1.0, length + 2.0, CELL), np.arange(-half, half + CELL / 2, CELL)
    cells = np.stack(np.meshgrid(columns, rows, indexing="ij"), -1)
    standing = np.flatnonzero(traffic.kind == Kind.STATIC)
    apart = np.abs(cells[:, :, None] - traffic.position[standing]) - traffic.size[standing] / 2
    blocked = (np.hypot(*np.moveaxis(np.maximum(apart, 0.0), -1, 0)) < INFLATION).any(-1)
    blocked |= half - np.abs(cells[..., 1]) < INFLATION
    values = _dijkstra(blocked, columns >= length)
    return DistanceField(CELL * np.where(np.isfinite(values), values, 400.0), cells[0, 0])


def _dijkstra(blocked: NDArray[np.bool_], goal: NDArray[np.bool_]) -> Floats:
    values = np.full(blocked.shape, np.inf)
    queue = [(0.0, x, y) for x, y in np.argwhere(~blocked & goal[:, None]).tolist()]
    for _, x, y in queue:
        values[x, y] = 0.0
    moves = [(dx, dy, math.hypot(dx, dy)) for dx in (-1, 0, 1) for dy in (-1, 0, 1) if dx or dy]
    while queue:
        distance, x, y = heapq.heappop(queue)
        if distance > values[x, y]:
            continue
        for dx, dy, step in moves:
            u, v = x + dx, y + dy
            inside = 0 <= u < blocked.shape[0] and 0 <= v < blocked.shape[1]
            if inside and not blocked[u, v] and distance + step < values[u, v]:
                values[u, v] = distance + step
                heapq.heappush(queue, (distance + step, u, v))
    return values
