"""Films for TensorBoard: what happened beside what was imagined of it."""

from io import BytesIO

import numpy as np
import torch as th
from numpy.typing import NDArray
from PIL import Image
from stable_baselines3.common.logger import TensorBoardOutputFormat

FPS = 5
SMALLEST = 128
"""Least height of a film, to which small pictures are enlarged [px]."""
SEEN, ALONE = (64, 200, 110), (235, 80, 60)
"""Colours of the line between the pictures: the model looks, or goes on alone."""


def side_by_side(real: th.Tensor, imagined: th.Tensor, looks: int) -> NDArray[np.uint8]:
    """
    Put two films beside each other, a line between them.

    :param real: pictures within [0, 1], of shape (T, C, H, W)
    :param imagined: likewise
    :param looks: pictures during which the line is green; after them it is red
    :return: RGB pictures, of shape (T, H', W', 3)
    """
    scale = -(-SMALLEST // real.shape[2])
    left, right = (_enlarge(_rgb(pictures), scale) for pictures in (real, imagined))
    line = np.empty((*left.shape[:2], 4, 3), dtype=np.uint8)
    line[:looks], line[looks:] = SEEN, ALONE
    return np.concatenate([left, line, right], axis=2)


def _rgb(pictures: th.Tensor) -> NDArray[np.uint8]:
    """The newest picture of a stack, in colours if there are some."""
    channels = 1 if pictures.shape[1] % 3 else 3
    newest = pictures[:, -channels:].expand(-1, 3, -1, -1).permute(0, 2, 3, 1)
    return (255 * newest.float().clamp(0, 1)).round().byte().cpu().numpy()


def _enlarge(pictures: NDArray[np.uint8], scale: int) -> NDArray[np.uint8]:
    return pictures.repeat(scale, axis=1).repeat(scale, axis=2)


def write_film(output: TensorBoardOutputFormat, key: str, pictures: NDArray[np.uint8], step: int) -> None:
    """
    Write an animated picture.

    Not by SB3's ``Video``: torch makes its pictures with a part of moviepy that moviepy 2 no longer has.

    :param output: where to
    :param key: name in TensorBoard
    :param pictures: RGB, of shape (T, H, W, 3)
    :param step: environment steps made
    """
    from tensorboard.compat.proto.summary_pb2 import Summary  # the output has it, others need not

    first, *others = [Image.fromarray(picture) for picture in pictures]
    encoded = BytesIO()
    first.save(encoded, "GIF", save_all=True, append_images=others, duration=1000 // FPS, loop=0)
    image = Summary.Image(height=first.height, width=first.width, colorspace=3, encoded_image_string=encoded.getvalue())
    assert output.writer.file_writer is not None
    output.writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=key, image=image)]), step)
    output.writer.flush()
