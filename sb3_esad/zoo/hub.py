"""Agents that are shared by way of the Hub."""

import argparse
import os
import shutil
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, cast

import httpx2
from huggingface_hub import HfApi
from huggingface_sb3 import EnvironmentName, ModelName, ModelRepoId
from rl_zoo3.utils import create_test_env, get_latest_run_id
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_esad.algorithms import ALGORITHMS
from sb3_esad.common.checks import require
from sb3_esad.demo import UNSEEN
from sb3_esad.driving_evaluation import evaluate_model
from sb3_esad.panels import Picture
from sb3_esad.report import summarise_any, write_json
from sb3_esad.video import write_video
from sb3_esad.zoo.agents import CONFIG, CURVES, ENV_KWARGS, Agent, find_agent, pack, unpack
from sb3_esad.zoo.card import model_card


def push_to_hub() -> None:
    """
    Evaluate and film an agent, and share it with a card that says what it can do and what it costs.

    The words of the command line are RL Zoo's. Who may write to the Hub is its client's business: no token passes here.

    :raises ValueError: if there is no such agent, or none that others could use without running its code
    :raises OSError: if the Hub cannot be reached, or refuses
    """
    parser = _parser("Share an agent with a card that says what it can do and what it costs.")
    parser.add_argument("--load-best", action="store_true", help="the best model instead of the last")
    parser.add_argument("-m", "--commit-message", default="An agent of sb3_esad", help="default: %(default)s")
    parser.add_argument("--episodes", type=int, default=100, help="of the evaluation (default: %(default)s)")
    parser.add_argument("-n", "--n-timesteps", type=int, default=1000, help="of the video at most (default: %(default)s)")
    parser.add_argument("--no-render", action="store_true", help="no video")
    args = parser.parse_args()
    for name in ("episodes", "n_timesteps"):
        require(getattr(args, name) >= 1, name, getattr(args, name), "a number >= 1")
    agent, repository = find_agent(args), _repository(args)
    model = ALGORITHMS[agent.algo].load(agent.model)
    with TemporaryDirectory() as name:
        folder = Path(name)
        pack(folder, agent)
        with _errors_on_one_line(repository):  # before the evaluation, which takes minutes
            url = HfApi().create_repo(repository, exist_ok=True)
        if not args.no_render:
            film(folder / "replay.mp4", model, agent, args.n_timesteps)
        describe(folder, model, agent, args.episodes, repository)
        with _errors_on_one_line(repository):
            HfApi().upload_folder(repo_id=repository, folder_path=folder, commit_message=args.commit_message)
    print(f"Shared at {url}")


def load_from_hub() -> None:
    """
    Fetch an agent and lay it where RL Zoo looks for it.

    :raises ValueError: if it holds code and is not trusted, or if the folder is there already
    :raises OSError: if the Hub cannot be reached, or has no such agent
    """
    parser = _parser("Fetch an agent without running any code that it may hold.")
    parser.add_argument("--force", action="store_true", help="replace the experiment if it is there")
    parser.add_argument("--trusted", action="store_true", help="unpickle the model, which may run any code")
    args = parser.parse_args()
    experiments, repository = Path(args.folder, args.algo), _repository(args)
    number = args.exp_id if args.exp_id > 0 else get_latest_run_id(str(experiments), args.env) + 1
    target = experiments / f"{args.env}_{number}"
    if target.exists() and not args.force:
        raise ValueError(f"{target} is there already; replace it by --force, or leave out --exp-id.")
    experiments.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory() as downloaded, TemporaryDirectory(dir=experiments, prefix=".") as unfinished:
        with _errors_on_one_line(repository):
            wanted = [ModelName(args.algo, args.env).filename, CONFIG, ENV_KWARGS, CURVES]
            HfApi().snapshot_download(repository, local_dir=downloaded, allow_patterns=wanted)
        whole = Path(unfinished, target.name)
        unpack(Path(downloaded), args.algo, args.env, whole, args.trusted)
        shutil.rmtree(target, ignore_errors=True)
        os.replace(whole, target)
    print(f"Saved to {target}")


def _parser(description: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--algo", choices=ALGORITHMS, required=True, help="algorithm")
    parser.add_argument("--env", type=EnvironmentName, required=True, help="environment")
    parser.add_argument("-f", "--folder", required=True, help="of RL Zoo's logs")
    parser.add_argument("-orga", "--organization", required=True, help="user or organisation on the Hub")
    parser.add_argument("-name", "--repo-name", help="repository (default: algorithm-environment)")
    parser.add_argument("--exp-id", type=int, default=0, help="experiment, 0 for the latest or a new one")
    return parser


def _repository(args: argparse.Namespace) -> str:
    return ModelRepoId(args.organization, args.repo_name or ModelName(args.algo, args.env))


@contextmanager
def _errors_on_one_line(repository: str) -> Iterator[None]:
    try:
        yield
    except (httpx2.HTTPError, OSError, RuntimeError) as error:
        remedy = "check your connection, the name, and that you are logged in (hf auth login)"
        raise OSError(f"{repository}: {' '.join(str(error).split())} Remedy: {remedy}.") from error


def describe(folder: Path, model: OffPolicyAlgorithm, agent: Agent, n_episodes: int, repository: str) -> None:
    """
    Evaluate an agent on episodes that no training has seen, and write what came of it.

    :param folder: where to write ``results.json`` and the card, ``README.md``
    :param model: that drives
    :param agent: whose environment it is
    :param n_episodes: how many
    :param repository: where it is shared
    """
    print(f"Evaluating on {n_episodes} episodes ...", flush=True)
    seeds = range(UNSEEN, UNSEEN + n_episodes)
    records = evaluate_model(model, agent.env.gym_id, seeds, env_kwargs=agent.env_kwargs)
    figures = summarise_any(records)
    write_json(folder / "results.json", {"mean_reward": figures["return"], "figures": figures, "records": records})
    card = model_card(agent, model, figures, seeds, repository)
    (folder / "README.md").write_text(card, encoding="utf-8")


def film(path: Path, model: OffPolicyAlgorithm, agent: Agent, n_steps: int) -> None:
    """
    Film the first episode of the evaluation.

    :param path: where to write the MP4
    :param model: that drives
    :param agent: whose environment it is
    :param n_steps: of the episode at most
    """
    settings, env_kwargs = {**agent.config, "normalize": False}, {**agent.env_kwargs, "render_mode": "rgb_array"}
    env = create_test_env(agent.env.gym_id, stats_path="", seed=UNSEEN, hyperparams=settings, env_kwargs=env_kwargs)
    with closing(env):
        write_video(path, _pictures(model, env, n_steps), env.get_attr("metadata")[0].get("render_fps", 30))


def _pictures(model: OffPolicyAlgorithm, env: VecEnv, n_steps: int) -> Iterator[Picture]:
    observation, state = cast(Any, env.reset()), None
    for _ in range(n_steps):
        yield cast(Picture, env.render())
        action, state = model.predict(observation, state, deterministic=True)
        observation, _, (done,), _ = env.step(action)
        if done:
            return
