"""A picture of a scene for people, and a window to show it in."""

from typing import Any

import cv2
import numpy as np

from sb3_esad.envs.bev import DASH_GREY, LINE_GREY, OFF_ROUTE_GREY, ROUTE_GREY
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.scene import Scene
from sb3_esad.envs.users import Kind
from sb3_esad.envs.view import Frame, Image, View

Colour = tuple[int, int, int]

SIZE, AHEAD, ZOOM = (960, 320), 0.75, 10.0  # [px], share of what is seen, and pixels for each of those of the agent's image
GRASS, ASPHALT, ROUTE, PAINT = (44, 62, 48), (70, 70, 74), (92, 92, 98), (225, 225, 225)
GROUND_COLOURS = {OFF_ROUTE_GREY: ASPHALT, ROUTE_GREY: ROUTE, DASH_GREY: PAINT, LINE_GREY: PAINT}
EGO_COLOUR, CRASH_COLOUR, STATIC_COLOUR, PERSON_COLOUR = (64, 220, 110), (235, 60, 50), (240, 150, 40), (240, 90, 200)
RED, AMBER = (220, 40, 40), (240, 180, 40)
SLOW_COLOUR, FAST_COLOUR = np.array([60.0, 90.0, 170.0]), np.array([130.0, 200.0, 255.0])
FASTEST = 30.0  # [m/s]


def draw_scene(scene: Scene) -> Image:
    """
    Draw the surroundings of the ego vehicle, its lane's direction to the right, with the figures that matter.

    :param scene: of a scenario that was reset
    :return: RGB picture, shape ``(320, 960, 3)``
    """
    traffic, ground, stop_lines = scene.traffic, scene.ground, scene.stop_lines
    scale = scene.config["metres_per_pixel"][0] / ZOOM
    view = View(SIZE, (scale, scale), AHEAD)
    frame = Frame(view, traffic.position[EGO], float(traffic.heading[EGO]) - scene.heading_error)
    canvas = np.empty((*SIZE, 3), dtype=np.uint8)
    canvas[:] = GRASS
    shapes = frame.pixels(np.concatenate([ground.corners, stop_lines.corners, traffic.corners]))
    colours = [GROUND_COLOURS[grey] for grey in ground.greys.tolist()]
    colours += [RED if red else AMBER for red in stop_lines.red]
    colours += [_colour(scene, row) for row in range(len(traffic.corners))]
    is_line = ground.is_line.tolist() + [False] * (len(shapes) - len(ground.corners))
    view.draw([canvas] * len(shapes), shapes, colours, is_line, 2)
    picture = np.ascontiguousarray(np.rot90(canvas, -1))
    _write(picture, scene)
    return picture


def _colour(scene: Scene, row: int) -> Colour:
    traffic = scene.traffic
    if row == EGO:
        return CRASH_COLOUR if scene.crashed else EGO_COLOUR
    if traffic.kind[row] == Kind.VEHICLE:
        share = min(float(traffic.speed[row]) / FASTEST, 1.0)
        red, green, blue = np.rint(SLOW_COLOUR + share * (FAST_COLOUR - SLOW_COLOUR)).astype(int).tolist()
        return red, green, blue
    return PERSON_COLOUR if traffic.kind[row] == Kind.PERSON else STATIC_COLOUR


def _write(picture: Image, scene: Scene) -> None:
    episode, so_far = scene.episode, scene.episode.record(success=False)
    parts = (
        f"speed {scene.traffic.speed[EGO]:4.1f} m/s",
        f"cost {episode.total_cost:.1f}",
        f"reward {episode.total_reward:.1f}",
        f"route {100 * (1 - scene.remaining):.0f} %",
        f"driving score {100 * so_far['driving_score']:.0f} %",
        f"time to collision {so_far['min_ttc']:.1f} s",
        f"{episode.time:.1f} s",
    )
    committed = ", ".join(f"{count} x {name.replace('_', ' ')}" for name, count in episode.infractions.items() if count)
    for row, text in enumerate(("    ".join(parts), f"infractions: {committed or 'none'}")):
        colour = CRASH_COLOUR if row and committed else PAINT
        cv2.putText(picture, text, (12, 24 + 22 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, 1, cv2.LINE_AA)


class Window:
    """
    Shows pictures on the screen, by pygame.

    :param fps: pictures a second
    """

    def __init__(self, fps: int) -> None:
        import pygame

        self._pygame: Any = pygame
        self._fps = fps
        pygame.display.init()
        self._clock = pygame.time.Clock()
        self._screen: Any = None

    def show(self, picture: Image) -> None:
        """
        Show a picture, and wait for its time to pass.

        :param picture: RGB, shape ``(rows, columns, 3)``
        """
        if self._screen is None:
            self._screen = self._pygame.display.set_mode((picture.shape[1], picture.shape[0]))
        self._screen.blit(self._pygame.surfarray.make_surface(picture.swapaxes(0, 1)), (0, 0))
        self._pygame.event.pump()
        self._pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        self._pygame.display.quit()
