"""
One moment of every scenario, as a person sees it and as an agent does: ``python benchmark/gallery.py --out docs/gallery.jpg``.

The reference driver drives for some seconds; left is what ``render`` draws, right the image observation, its three channels
(road, moving users, ego vehicle and what must not be hit) as red, green and blue, the direction of travel upwards.
"""

import argparse
from pathlib import Path

import cv2
import gymnasium as gym
import numpy as np
from gymnasium.envs.registration import registry
from PIL import Image, ImageDraw, ImageFont

import sb3_esad.envs  # noqa: F401  (registers the scenarios)
from sb3_esad.envs.drivers import DRIVERS
from sb3_esad.envs.scenario import scenario_of

SCENE, SEEN, TITLE, GAP = (640, 213), 213, 24, 10


def moment(env_id: str, seed: int, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """
    Let the reference driver drive.

    :param env_id: scenario with images
    :param seed: of the episode
    :param seconds: how long, if the episode lasts
    :return: the picture for people, and the observation
    """
    env = gym.make(env_id, render_mode="rgb_array")
    observation, _ = env.reset(seed=seed)
    scenario = scenario_of(env)
    driver, done = DRIVERS["reference"](scenario, seed), False
    while not done and scenario.episode.time < seconds:
        observation, _, terminated, truncated, _ = env.step(driver(env))
        done = terminated or truncated
    picture = np.asarray(env.render())
    env.close()
    return picture, observation


def main() -> None:
    """Draw all scenarios one below the other."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("gallery.jpg"))
    parser.add_argument("--seed", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=8.0)
    args = parser.parse_args()
    ids = sorted(name for name in registry if name.startswith("esad-") and not name.endswith(("-vector-v0", "-dict-v0")))
    row = TITLE + SCENE[1] + GAP
    page = Image.new("RGB", (SCENE[0] + GAP + SEEN, row * len(ids)), "white")
    draw = ImageDraw.Draw(page)
    for index, env_id in enumerate(ids):
        picture, observation = moment(env_id, args.seed, args.seconds)
        draw.text((2, index * row + 3), env_id, "black", ImageFont.load_default(15))
        page.paste(Image.fromarray(cv2.resize(picture, SCENE, interpolation=cv2.INTER_AREA)), (0, index * row + TITLE))
        seen = np.ascontiguousarray(observation.transpose(1, 2, 0))
        enlarged = cv2.resize(seen, (SEEN, SEEN), interpolation=cv2.INTER_NEAREST)
        page.paste(Image.fromarray(enlarged), (SCENE[0] + GAP, index * row + TITLE))
    page.save(args.out, quality=88)


if __name__ == "__main__":
    main()
