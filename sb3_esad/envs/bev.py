"""Bird's-eye view of the traffic around the ego vehicle, drawn with OpenCV to a fraction of a pixel."""

import numpy as np
from numpy.typing import NDArray

from sb3_esad.envs.lights import StopLines
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Bools, Markings
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.view import SUBPIXEL_BITS, Frame, Image, View

BLEED = 0.7 * 2**SUBPIXEL_BITS  # measured: a filled shape comes out this much larger on every side [px / 16]
STANDING_GREY, USER_SPAN, EGO_SPAN, OBSTACLE_GREY = 95, 160, 100, 255
TOP_SPEED = 40.0  # the speed of the brightest grey level [m/s]
AMBER_GREY = 210  # of the line before an amber light
DIAL_SPEED, DIAL_GREY = 32.0, 160  # the speed at which the dial is as high as the image [m/s]
DIAL_SHARE = 1 / 16  # of the image's width, at either edge
OFF_ROUTE_GREY, ROUTE_GREY, DASH_GREY, LINE_GREY = 40, 80, 160, 220
_NEXT_CORNER, _LAST_CORNER = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])


class Ground:
    """
    What does not move, as quadrilaterals in the order in which they are drawn, and the circles around them.

    Asphalt comes first, brighter where the route leads, then painted lines, whose first two corners are their ends.

    :param markings: of the road
    :param route: whether each lane belongs to the ego vehicle's route, shape ``(lanes,)``
    """

    def __init__(self, markings: Markings, route: Bools) -> None:
        surfaces, on_route = markings.with_route_on_top(route)
        self.corners = np.concatenate([surfaces, markings.lines[:, [0, 1, 1, 0]]])
        asphalt, paint = np.where(on_route, ROUTE_GREY, OFF_ROUTE_GREY), np.where(markings.dashed, DASH_GREY, LINE_GREY)
        self.greys = np.concatenate([asphalt, paint])
        self.is_line = np.arange(len(self.corners)) >= len(surfaces)
        self.centres = self.corners.mean(1)
        offset = self.corners - self.centres[:, None]
        self.radii = np.hypot(offset[..., 0], offset[..., 1]).max(1)


def inset(shapes: NDArray[np.int32]) -> NDArray[np.int32]:
    """
    Move the sides of parallelograms inwards by what OpenCV's anti-aliasing adds, so that they cover their true area.

    :param shapes: pixel coordinates of their corners in order, shape ``(n, 4, 2)`` [px / 16]
    :return: the same, smaller
    """
    sides = shapes.take(_NEXT_CORNER, axis=1) - shapes  # several times faster than an index
    lengths = np.maximum(np.hypot(sides[..., 0], sides[..., 1]), 1.0)
    steps = BLEED / lengths[..., None] * sides
    return np.rint(shapes + steps - steps.take(_LAST_CORNER, axis=1)).astype(np.int32)


def user_grey(traffic: Traffic, row: int) -> int:
    """
    Grey level that tells the speed of a vehicle, the ego vehicle's span being the smaller; 255 for what must not be hit.

    :param traffic: all road users
    :param row: one of them
    :return: never 0, which means that nobody is there
    """
    if not traffic.is_vehicle[row]:
        return OBSTACLE_GREY
    span = EGO_SPAN if row == EGO else USER_SPAN
    return round(STANDING_GREY + span * min(float(traffic.speed[row]) / TOP_SPEED, 1.0))


def draw_dial(image: Image, speed: float) -> None:
    """
    Show a speed as the height of a bar at either edge, to a fraction of a pixel, over what may be there.

    Grey levels alone are too faint for this: an agent that learns to see by squared error would take notice of its own speed
    only after it has learned everything else, and until then believe that braking changes nothing.

    :param image: drawn into, shape ``(rows, columns)``
    :param speed: [m/s]
    """
    rows, width = image.shape[0], max(1, round(DIAL_SHARE * image.shape[1]))
    height = min(speed / DIAL_SPEED, 1.0) * rows
    whole = int(height)
    dial = np.zeros(rows + 1, dtype=np.uint8)  # one more, above the image, for the fraction of a pixel on top of a full dial
    dial[rows + 1 - whole :], dial[rows - whole] = DIAL_GREY, round(DIAL_GREY * (height - whole))
    image[:, :width] = image[:, -width:] = dial[1:, None]


class BirdsEyeView:
    """
    The image an agent sees, channel first; a mirrored world gives the mirrored image.

    Channel 0 is the road: surface, brighter where the route leads, and painted lines. Channel 1 holds the moving users,
    brighter the faster they are. Channel 2 holds the ego vehicle, brightened likewise, its speed as a dial at both edges, and
    what must not be hit at 255; the line before a light is less bright while it is amber.

    :param view: size and scale of the image
    """

    def __init__(self, view: View) -> None:
        self.view = view

    def draw(self, ground: Ground, traffic: Traffic, stop_lines: StopLines, heading: float) -> Image:
        """
        Draw the surroundings of the ego vehicle.

        :param ground: the road
        :param traffic: all road users
        :param stop_lines: before lights that are not green
        :param heading: the direction that points up [rad]
        :return: the image, shape ``(3, rows, columns)``
        """
        frame = Frame(self.view, traffic.position[EGO], heading)
        image = np.zeros((3, *self.view.shape), dtype=np.uint8)
        road, users, obstacles = image
        still = frame.near(ground.centres, ground.radii)
        rows = frame.near(traffic.position, traffic.radius)
        shapes = frame.pixels(np.concatenate([ground.corners.take(still, axis=0), stop_lines.corners, traffic.corners[rows]]))
        shapes[len(still) :] = inset(shapes[len(still) :])
        layers = [road] * len(still) + [obstacles] * len(stop_lines.red)
        greys = ground.greys[still].tolist() + [OBSTACLE_GREY if red else AMBER_GREY for red in stop_lines.red]
        for row in rows.tolist():
            layers.append(users if row != EGO and traffic.is_vehicle[row] else obstacles)
            greys.append(user_grey(traffic, row))
        is_line = ground.is_line[still].tolist() + [False] * (len(layers) - len(still))
        self.view.draw(layers, shapes, greys, is_line)
        draw_dial(obstacles, float(traffic.speed[EGO]))
        return image
