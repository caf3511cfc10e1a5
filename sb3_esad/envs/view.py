"""Windows on the world: what can be seen from a place, and how it is drawn with OpenCV to a fraction of a pixel."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from sb3_esad.envs.geometry import Floats
from sb3_esad.envs.roads import Ints

Image = NDArray[np.uint8]
Colour = int | tuple[int, int, int]

SUBPIXEL_BITS = 4
OUTLINE = 2  # nothing further outside than this leaves a trace in an image [px]


class View:
    """
    A window on the world that looks up the image along a given heading, and draws into it.

    :param shape: rows and columns [px]
    :param metres_per_pixel: along the heading (rows) and across it (columns) [m/px]
    :param ahead: share of the rows that lie ahead of the origin
    """

    def __init__(self, shape: Sequence[int], metres_per_pixel: Sequence[float], ahead: float) -> None:
        rows, columns = self.shape = (int(shape[0]), int(shape[1]))
        along, across = metres_per_pixel
        self.scale = 2**SUBPIXEL_BITS / across, -(2**SUBPIXEL_BITS) / along
        """Across the image and up it [px / 16 / m]."""
        self.centre = 2**SUBPIXEL_BITS * (columns / 2 - 0.5), 2**SUBPIXEL_BITS * (rows * ahead - 0.5)
        """Column and row of the origin; OpenCV counts from the middle of the first pixel [px / 16]."""
        self.reach = (ahead - 0.5) * rows * along
        """How far the middle of the image is ahead of the origin [m]."""
        self.radius = math.hypot((rows / 2 + OUTLINE) * along, (columns / 2 + OUTLINE) * across)
        """Of the circle around the image [m]."""
        self._limit = np.array([columns, rows]) * 2**SUBPIXEL_BITS

    def draw(
        self,
        images: Sequence[Image],
        shapes: NDArray[np.int32],
        colours: Sequence[Colour],
        is_line: Sequence[bool],
        thickness: int = 1,
    ) -> None:
        """
        Draw convex quadrilaterals and straight lines, one after the other.

        :param images: the image each is drawn into, shape ``(rows, columns)`` or ``(rows, columns, 3)``
        :param shapes: pixel coordinates, shape ``(n, 4, 2)`` [px / 16]
        :param colours: one each
        :param is_line: whether it is a line between its first two corners
        :param thickness: of lines [px]
        """
        seen = ((shapes >= 0).any(1) & (shapes <= self._limit).any(1)).all(1)  # OpenCV would do this more slowly
        for index in seen.nonzero()[0].tolist():
            if is_line[index]:
                ends = shapes[index, :2]
                cv2.polylines(images[index], [ends], False, colours[index], thickness, cv2.LINE_AA, SUBPIXEL_BITS)
            else:
                cv2.fillConvexPoly(images[index], shapes[index], colours[index], cv2.LINE_AA, SUBPIXEL_BITS)


class Frame:
    """
    What a :class:`View` sees from one place.

    :param view: size and scale of the image
    :param origin: the point of view, shape ``(2,)`` [m]
    :param heading: the direction that points up [rad]
    """

    def __init__(self, view: View, origin: Floats, heading: float) -> None:
        x, y = origin.tolist()
        cos, sin = math.cos(heading), math.sin(heading)
        (across, along), (column, row) = view.scale, view.centre
        self._turn = np.array([[-sin * across, cos * along], [cos * across, sin * along]])
        self._shift = np.array([column + (x * sin - y * cos) * across, row - (x * cos + y * sin) * along])
        self._middle = x + view.reach * cos, y + view.reach * sin
        self._radius = view.radius

    def near(self, centres: Floats, radii: Floats) -> Ints:
        """
        Sort out most of what is out of sight.

        :param centres: of circles, shape ``(n, 2)`` [m]
        :param radii: of these, shape ``(n,)`` [m]
        :return: indices of all that may have a part in the image
        """
        x, y = self._middle
        return (np.hypot(centres[:, 0] - x, centres[:, 1] - y) <= radii + self._radius).nonzero()[0]

    def pixels(self, points: Floats) -> NDArray[np.int32]:
        """
        Pixel coordinates of points of the world.

        :param points: shape ``(..., 2)`` [m]
        :return: column and row in fixed point, shape ``(..., 2)`` [px / 16]
        """
        return np.rint(points.reshape(-1, 2) @ self._turn + self._shift).astype(np.int32).reshape(points.shape)
