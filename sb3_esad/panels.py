"""A picture for people: a scene beside what an agent sees, remembers and dreams of it."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from sb3_esad.envs import bev, drawing

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

WIDTH, HEIGHT, ROW = 1280, 368, 256  # all columns, rows without panels, a row of panels: multiples of 16, as codecs like [px]
IN_A_ROW = 3
PANEL = (416, 208)
TITLE = 28
BACKGROUND, TEXT, FAINT = (24, 26, 30), (235, 235, 235), (150, 152, 158)
GOOD, BAD, MARK = (64, 200, 110), (235, 80, 60), (255, 210, 60)
LEGEND = "Green: the agent. Blue: others, the faster the lighter."
ROAD_GREYS = (0, bev.OFF_ROUTE_GREY, bev.ROUTE_GREY, bev.DASH_GREY)
ROAD_COLOURS = np.array([drawing.GRASS, drawing.ASPHALT, drawing.ROUTE, drawing.PAINT])


class Gauge(NamedTuple):
    """
    A labelled bar.

    :param label: what it shows
    :param text: the value as people read it
    :param share: of the bar that is filled, within [0, 1]
    :param mark: share at which a line is drawn, None for none
    :param colour: of the bar
    """

    label: str
    text: str
    share: float
    mark: float | None
    colour: Colour


def paint(observation: NDArray[np.floating]) -> Picture:
    """
    Colour an image observation and turn it so that the road runs to the right.

    :param observation: road, moving users, and ego vehicle with obstacles, within [0, 1], shape ``(3, rows, columns)``
    :return: RGB picture, shape ``(columns, rows, 3)``
    """
    road, users, others = 255.0 * np.clip(observation, 0.0, 1.0)
    picture = np.stack([np.interp(road, ROAD_GREYS, channel) for channel in ROAD_COLOURS.T], axis=-1)
    speed = _share(users, bev.STANDING_GREY, bev.STANDING_GREY + bev.USER_SPAN)
    obstacle = _share(others, bev.STANDING_GREY + bev.EGO_SPAN, bev.OBSTACLE_GREY)
    picture = _blend(picture, _blend(drawing.SLOW_COLOUR, drawing.FAST_COLOUR, speed), _share(users, 0, bev.STANDING_GREY))
    picture = _blend(
        picture, _blend(drawing.EGO_COLOUR, drawing.STATIC_COLOUR, obstacle), _share(others, 0, bev.STANDING_GREY)
    )
    return np.ascontiguousarray(np.rot90(np.rint(picture).astype(np.uint8), -1))


def _share(values: NDArray[np.floating], low: float, high: float) -> NDArray[np.floating]:
    return np.clip((values - low) / (high - low), 0.0, 1.0)[..., None]


def _blend(under: object, over: object, share: NDArray[np.floating]) -> NDArray[np.floating]:
    return (1.0 - share) * np.asarray(under) + share * np.asarray(over)


def compose(scene: Picture, panels: dict[str, Picture], gauges: list[Gauge], verdict: str, caption: str = "") -> Picture:
    """
    Put everything that belongs to one moment into one picture.

    :param scene: what happens, shape ``(320, 960, 3)``
    :param panels: small pictures by their titles, three in a row
    :param gauges: figures of the moment
    :param verdict: how the episode ended, empty as long as it goes on
    :param caption: what else the panels mean
    :return: RGB picture, 1280 pixels wide, 624 high with three panels and 880 with six
    """
    size = (WIDTH, HEIGHT + ROW * -(-len(panels) // IN_A_ROW))
    canvas = Image.new("RGB", size, BACKGROUND)
    draw = ImageDraw.Draw(canvas)
    _write(draw, (8, 5), "What happens", 16)
    canvas.paste(Image.fromarray(scene), (0, TITLE))
    for index, (title, picture) in enumerate(panels.items()):
        row, column = divmod(index, IN_A_ROW)
        left, top = column * (PANEL[0] + 16), TITLE + scene.shape[0] + 16 + row * ROW
        _write(draw, (left + 8, top + 5), title, 16)
        enlarged = cv2.resize(picture, PANEL, interpolation=cv2.INTER_NEAREST)
        canvas.paste(Image.fromarray(enlarged), (left, top + TITLE))
    for index, gauge in enumerate(gauges):
        _draw_gauge(draw, gauge, scene.shape[1] + 24, TITLE + 4 + 82 * index)
    _write(draw, (8, size[1] - 21), f"{LEGEND} {caption}", 14, FAINT)
    if verdict:
        _write(draw, (scene.shape[1] // 2, TITLE + scene.shape[0] - 40), verdict, 30, MARK, "mm")
    return np.asarray(canvas)


def _draw_gauge(draw: ImageDraw.ImageDraw, gauge: Gauge, left: int, top: int, width: int = 272) -> None:
    _write(draw, (left, top), gauge.label, 14, FAINT)
    _write(draw, (left + width, top), gauge.text, 16, anchor="ra")
    low, high = top + 24, top + 40
    draw.rectangle((left, low, left + width, high), outline=FAINT)
    draw.rectangle((left, low, left + round(width * min(max(gauge.share, 0.0), 1.0)), high), fill=gauge.colour)
    if gauge.mark is not None:
        place = left + round(width * gauge.mark)
        draw.line((place, low - 5, place, high + 5), fill=MARK, width=3)


def _write(
    draw: ImageDraw.ImageDraw, place: tuple[int, int], text: str, size: int, colour: Colour = TEXT, anchor: str = "la"
) -> None:
    draw.text(place, text, colour, ImageFont.load_default(size), anchor)
