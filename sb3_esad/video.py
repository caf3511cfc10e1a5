"""Videos of an episode, beside it what the model remembers and dreams of it."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import gymnasium as gym
import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_esad.common.costs import CostReader
from sb3_esad.common.save_util import whole_file
from sb3_esad.dream import DreamingDriver
from sb3_esad.driving_evaluation import check_spaces, normalised
from sb3_esad.envs.drivers import DRIVERS
from sb3_esad.envs.scenario import scenario_of
from sb3_esad.esad_lend import ESADLEND
from sb3_esad.explanation import ExplainedDriver
from sb3_esad.moments import Moment, dreaming_frame, explaining_frame, image_of, render
from sb3_esad.panels import Picture

ModelDriver = TypeVar("ModelDriver", DreamingDriver, ExplainedDriver)

LAST_FRAMES = 8


def record_model(path: Path, model: ESADLEND, env_id: str, seed: int, deterministic: bool = True) -> None:
    """
    Film an episode of a model, beside it what the model sees, remembers and dreams.

    :param path: where to write the MP4
    :param model: trained on images, or on a dictionary with an ``image``
    :param env_id: driving scenario
    :param seed: of the episode
    :param deterministic: take the best action, not a sampled one
    :raises ValueError: if the environment is no driving scenario with an image, or not one that the model knows
    """
    with closing(_make(env_id)) as env:
        check_imagination(model)
        check_spaces(model, env, env_id)
        check_image(env, env_id)
        driver = DreamingDriver(model, deterministic=deterministic)
        write_video(path, _drive_model(env, driver, seed, dreaming_frame), env.metadata["render_fps"])


def record_explanation(path: Path, model: ESADLEND, env_id: str, seed: int) -> None:
    """
    Film an episode of a model, beside it what it thinks possible, how dangerous that is, and where its filter steps in.

    :param path: where to write the MP4
    :param model: trained on images, or on a dictionary with an ``image``
    :param env_id: driving scenario
    :param seed: of the episode
    :raises ValueError: if the environment is no driving scenario with an image, or not one that the model knows
    """
    with closing(_make(env_id)) as env:
        check_imagination(model)
        check_spaces(model, env, env_id)
        check_image(env, env_id)
        write_video(path, _drive_model(env, ExplainedDriver(model), seed, explaining_frame), env.metadata["render_fps"])


def record_driver(path: Path, name: str, env_id: str, seed: int) -> None:
    """
    Film an episode of a scripted driver.

    :param path: where to write the MP4
    :param name: key of ``DRIVERS``
    :param env_id: driving scenario
    :param seed: of the episode
    :raises ValueError: if the environment is no driving scenario
    """
    with closing(_make(env_id)) as env:
        write_video(path, _drive(env, name, seed), env.metadata["render_fps"])


def write_video(path: Path, frames: Iterable[Picture], fps: int) -> None:
    """
    Write an MP4 in H.264 with 4:2:0 colours, which every browser and player shows.

    :param path: where to
    :param frames: RGB pictures of one size, shape ``(rows, columns, 3)``
    :param fps: pictures a second
    :raises ValueError: if the path has another suffix than ``.mp4``
    :raises ImportError: if imageio-ffmpeg is missing
    """
    if path.suffix not in ("", ".mp4"):
        raise ValueError(f"{path} is no MP4; give the video a name that ends with .mp4.")
    pictures = iter(frames)
    first = next(pictures)
    options = {"fps": fps, "quality": 8, "output_params": ["-movflags", "+faststart"]}
    with (
        whole_file(path, ".mp4") as target,
        closing(video_writer().write_frames(target, first.shape[1::-1], **options)) as writer,
    ):
        writer.send(None)
        for picture in chain([first], pictures):
            writer.send(np.ascontiguousarray(picture))


def check_imagination(model: BaseAlgorithm) -> None:
    """
    Refuse a model that has nothing to dream with.

    :param model: of any algorithm
    :raises ValueError: if it has no world model
    """
    if not isinstance(model, ESADLEND):
        name = type(model).__name__
        raise ValueError(f"{name} has no world model whose dreams could be filmed; use RL Zoo's record_video for it.")


def check_image(env: gym.Env[Any, Any], env_id: str) -> None:
    """
    Refuse an environment of which no dream can be shown.

    :param env: environment
    :param env_id: its name
    :raises ValueError: if there is no image in its observations
    """
    if image_of(env.observation_space.sample()) is None:
        raise ValueError(f"{env_id} has no image, so there is no dream to show; choose an id without -vector-.")


def video_writer() -> Any:
    """
    Find the library that writes videos; to ask for it early spares a long training whose video fails.

    :return: the module
    :raises ImportError: if it is missing
    """
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError("Videos need imageio-ffmpeg: pip install 'sb3_esad[demo]'.") from error
    return imageio_ffmpeg


def _make(env_id: str) -> gym.Env[Any, Any]:
    with closing(gym.make(env_id)) as env:  # others may not know the mode, and their sentence would not help
        scenario_of(env)
    return gym.make(env_id, render_mode="rgb_array")


def _drive(env: gym.Env[Any, Any], name: str, seed: int) -> Iterator[Picture]:
    driver, done = DRIVERS[name](scenario_of(env), seed), False
    env.reset(seed=seed)
    while not done:
        yield render(env)
        _, _, terminated, truncated, _ = env.step(driver(env))
        done = terminated or truncated
    yield from [render(env)] * LAST_FRAMES


def _drive_model(
    env: gym.Env[Any, Any], driver: ModelDriver, seed: int, frame: Callable[[Moment, ModelDriver], Picture]
) -> Iterator[Picture]:
    observation, info = env.reset(seed=seed)
    verdict, cost, read_costs = "", 0.0, CostReader(driver.model.cost_key)
    while not verdict:
        action = driver(normalised(driver.model, observation))
        yield frame(Moment(env, observation, info, cost, verdict), driver)
        observation, _, terminated, truncated, info = env.step(action)
        cost += float(read_costs([info])[0])
        if terminated or truncated:
            verdict = _verdict(info, truncated)
    driver(normalised(driver.model, observation))
    yield from [frame(Moment(env, observation, info, cost, verdict), driver)] * LAST_FRAMES


def _verdict(info: dict[str, Any], truncated: bool) -> str:
    if truncated:
        return "Time is up"
    if info["is_success"]:
        return "Arrived"
    return "Off the road" if info["cost_terms"]["off_road"] else "Collision"
