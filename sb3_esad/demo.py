"""The main job in a few minutes: learn to drive from images, and prove it on episodes that were never seen."""

import os
import platform
import time
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import closing
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path

import gymnasium as gym
import torch as th
from stable_baselines3.common.env_util import make_vec_env

from sb3_esad.common.latent_algorithm import FALLING_RATE
from sb3_esad.common.save_util import whole_file
from sb3_esad.common.side_by_side import torch_threads
from sb3_esad.driving_evaluation import evaluate_driver, evaluate_model
from sb3_esad.envs.scenario import scenario_of
from sb3_esad.esad_lend import ESADLEND
from sb3_esad.hyperparams import load_hyperparams
from sb3_esad.plots import plot_learning_curve
from sb3_esad.progress import Deadline, EpisodeProgressBar
from sb3_esad.report import Figures, format_table, summarise_any
from sb3_esad.video import check_image, record_model, video_writer

ENV_ID = "esad-highway-v0"
TIMESTEPS, MINUTES = 20_000, 7.5
FEW_UPDATES = {
    "learning_rate": FALLING_RATE,
    "train_freq": 32,
    "pretrain_gradient_steps": 0,
    "replay_cost_critic_coef": 1.0,
    "replay_lambda": 0.0,
    "min_cost_critic_rate": 0.0,
}
"""
In hundreds of updates a rate that falls from the start moves the networks too little, and steps, which take hardly any time,
teach more than updates: above all what a collision looks like (docs/experiments.md, sections 12 and 13). And when recorded
costs counted for more one of three seeds was at 83 % without a collision, without that all were at 96 and more (sections 17
and 18).
"""
FIT_UPDATES = 300
"""
Of the cost critics alone, from recorded windows, when the policy stays as it is; with more they come to expect too little
(docs/experiments.md, section 20).
"""
UNSEEN = 1_000_000
"""First seed of the evaluation; a training draws its episodes from its own seed and starts no episode from this one."""


def run_demo(
    folder: Path,
    seed: int = 0,
    timesteps: int = TIMESTEPS,
    minutes: float = MINUTES,
    episodes: int = 100,
    env_id: str = ENV_ID,
) -> None:
    """
    Train, evaluate beside two simple drivers, and write model, learning curve, results and video into a folder.

    :param folder: where to write
    :param seed: of the training
    :param timesteps: environment steps at most
    :param minutes: of training at most, before the cost critics are fitted; the learning rate falls to zero over what comes
        first
    :param episodes: of the evaluation
    :param env_id: driving scenario
    :raises ValueError: if the environment is no driving scenario with an image, or the training too short for an episode
    :raises ImportError: if the library that writes videos is missing
    """
    video_writer()
    with closing(gym.make(env_id)) as env:
        scenario_of(env)
        check_image(env, env_id)
    folder.mkdir(parents=True, exist_ok=True)
    model, training = train(folder, seed, timesteps, minutes, env_id)
    seeds = range(UNSEEN, UNSEEN + episodes)
    print(f"Evaluating on {episodes} unseen episodes ...", flush=True)
    columns = compare(model, env_id, seeds)
    write_results(folder / "results.md", env_id, columns, training, seeds)
    with torch_threads(1):
        record_model(folder / "episode.mp4", model, env_id, seeds[0])
    print(f"\n{format_table(columns)}\n\nIn brackets: 95 % intervals. Written:")
    for name in ("results.md", "learning_curve.png", "episode.mp4", "esad_lend.zip"):
        print(f"  {folder / name}")


def train(folder: Path, seed: int, timesteps: int, minutes: float, env_id: str) -> tuple[ESADLEND, str]:
    """
    Train until the steps are done or the time is over; write the model and its learning curve.

    :param folder: where to write
    :param seed: of the training
    :param timesteps: environment steps at most
    :param minutes: at most, before the cost critics are fitted
    :param env_id: driving scenario
    :return: the model, and a sentence about its training
    """
    hyperparams = load_hyperparams(ESADLEND, "esad_lend", env_id)
    arguments = {**hyperparams.arguments, **FEW_UPDATES}
    model = ESADLEND(env=make_vec_env(env_id, hyperparams.n_envs), seed=seed, **arguments)
    bar = EpisodeProgressBar()
    print(f"Training ESAD-LEND on {env_id} for {timesteps} steps or {minutes:g} minutes ...", flush=True)
    start = time.monotonic()
    model.learn(timesteps, callback=[bar, Deadline(minutes)])
    took = (time.monotonic() - start) / 60
    model.save(folder / "esad_lend.zip")
    if model._n_updates > 0:
        print(f"Learning from {FIT_UPDATES} more batches what the policy costs ...", flush=True)
        model.fit_cost_critic(FIT_UPDATES)
        model.save(folder / "esad_lend.zip")
    history = bar.history
    plot_learning_curve(folder / "learning_curve.png", history.episodes, model.cost_limit)
    clock = "" if model.num_timesteps >= timesteps else ", ended by the clock"
    done = f"{model.num_timesteps} steps, {len(history.episodes)} episodes and {model._n_updates} updates"
    wanted = f"at most {model.cost_limit} cost per episode wanted"
    return model, f"Trained for {done} in {took:.1f} minutes with seed {seed}{clock}; {wanted}."


@torch_threads(1)  # decisions are too small to share, and the other core is taken
def compare(model: ESADLEND, env_id: str, seeds: range) -> dict[str, Figures]:
    """
    Evaluate a model, and at the same time, in another process, two simple drivers.

    :param model: trained model
    :param env_id: driving scenario
    :param seeds: of the episodes
    :return: figures by the name of the driver
    """
    drivers = {"holds speed and lane": "keeper", "random": "random"}
    with ProcessPoolExecutor(1, get_context("spawn")) as other:
        driven = {name: other.submit(evaluate_driver, driver, env_id, seeds) for name, driver in drivers.items()}
        figures = {"ESAD-LEND": summarise_any(evaluate_model(model, env_id, seeds))}
        return figures | {name: summarise_any(records.result()) for name, records in driven.items()}


def write_results(path: Path, env_id: str, columns: Mapping[str, Figures], training: str, seeds: range) -> None:
    """
    Write the table, and all that is needed to get it again.

    :param path: where to
    :param env_id: driving scenario
    :param columns: figures by the name of the driver
    :param training: a sentence about it
    :param seeds: of the evaluation
    """
    versions = ", ".join(f"{name} {version(name)}" for name in ("stable_baselines3", "torch", "gymnasium", "numpy"))
    lines = [
        f"# ESAD-LEND on {env_id}",
        "",
        training,
        f"Evaluated on {len(seeds)} episodes with the seeds {seeds[0]} to {seeds[-1]}, by the best action, not a sampled one.",
        "",
        format_table(columns),
        "",
        "In brackets: 95 % intervals, Wilson's for shares, Poisson's for events per distance, Student's t for means.",
        "",
        f"Python {platform.python_version()}, {versions}; {os.cpu_count()} processors, {th.get_num_threads()} threads.",
    ]
    with whole_file(path) as target:
        target.write_text("\n".join(lines) + "\n", encoding="utf-8")
