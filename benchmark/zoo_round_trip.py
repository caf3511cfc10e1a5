"""
All that RL Zoo and the Hub do with an agent: ``python benchmark/zoo_round_trip.py --folder round_trip``.

Trains for 2,000 steps, watches, films, plots, shares by a stand-in for the Hub on this machine, fetches the agent again and
watches that, each by its command. Every one must end with exit code 0 and without a warning, and both agents must act alike.
"""

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import gymnasium as gym
import numpy as np

from sb3_esad.algorithms import ALGORITHMS

ROOT = Path(__file__).parents[1]
FEW_UPDATES = "learning_starts:500 train_freq:32 gradient_steps:1 pretrain_gradient_steps:0"
"""What is tried is the way, not how well the agent drives in the end."""


@contextmanager
def local_hub() -> Iterator[dict[str, str]]:
    """
    Serve a stand-in for the Hub meanwhile.

    :return: variables by which its client finds it
    """
    command = [sys.executable, str(ROOT / "tests" / "local_hub.py")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as hub:
        assert hub.stdout is not None
        try:
            # Large files have a protocol of their own, which the stand-in does not speak
            yield {"HF_ENDPOINT": hub.stdout.readline().strip(), "HF_TOKEN": "secret", "HF_HUB_DISABLE_XET": "1"}
        finally:
            hub.terminate()


def run(folder: Path, environment: dict[str, str], words: str) -> str:
    """
    Run a command as a user would.

    :param folder: where
    :param environment: variables beside those of this process
    :param words: of the command
    :return: what it printed
    """
    start = time.monotonic()
    variables = {**os.environ, "PYTHONPATH": str(ROOT), **environment}
    command = [sys.executable, "-m", "sb3_esad", *words.split()]
    done = subprocess.run(command, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    if done.returncode != 0 or "Warning" in done.stdout + done.stderr:
        sys.exit(f"{words}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}")
    print(f"{time.monotonic() - start:7.1f} s  {words}", flush=True)
    return done.stdout


def episode(algo: str, env_id: str, path: Path) -> np.ndarray:
    """
    Let a saved model act for an episode.

    :param algo: key of ``ALGORITHMS``
    :param env_id: environment
    :param path: of the model
    :return: its actions, shape ``(steps, A)``
    """
    model, env = ALGORITHMS[algo].load(path), gym.make(env_id)
    actions, state, done, (observation, _) = [], None, False, env.reset(seed=0)
    while not done:
        action, state = model.predict(observation, state, deterministic=True)
        observation, _, terminated, truncated, _ = env.step(action)
        actions.append(action)
        done = terminated or truncated
    return np.array(actions)


def main() -> None:
    """Go the whole way."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=Path("round_trip"), help="a new one (default: %(default)s)")
    parser.add_argument("--algo", choices=ALGORITHMS, default="esad_lend", help="default: %(default)s")
    parser.add_argument("--env", default="esad-highway-v0", help="default: %(default)s")
    parser.add_argument("--steps", type=int, default=2000, help="of the training (default: %(default)s)")
    parser.add_argument("--params", default=FEW_UPDATES, help="changed settings (default: %(default)s)")
    args = parser.parse_args()
    args.folder.mkdir(parents=True)
    agent, plots = f"--algo {args.algo} --env {args.env}", f"-a {args.algo} -e {args.env} -f logs"
    training = f"-n {args.steps} --eval-freq {args.steps // 4} --eval-episodes 5 --seed 0 -params {args.params}"
    with local_hub() as hub:
        run(args.folder, hub, f"train {agent} -f logs {training}")
        watched = run(args.folder, hub, f"enjoy {agent} -f logs --no-render")
        run(args.folder, hub, f"record_video {agent} -f logs -n 100")
        run(args.folder, hub, f"plot_train {plots} -w 5")
        run(args.folder, hub, f"all_plots {plots} -k costs --no-million")
        run(args.folder, hub, f"push_to_hub {agent} -f logs -orga me --episodes 20")
        run(args.folder, hub, f"load_from_hub {agent} -f pulled -orga me")
        pulled = run(args.folder, hub, f"enjoy {agent} -f pulled --no-render")
    ours, theirs = (
        sorted((args.folder / name / args.algo).glob(f"{args.env}_*/{args.env}.zip")) for name in ("logs", "pulled")
    )
    same = np.array_equal(episode(args.algo, args.env, ours[-1]), episode(args.algo, args.env, theirs[-1]))
    rewards = [text.partition("Episode Reward")[2] for text in (watched, pulled)]
    if not same or rewards[0] != rewards[1]:
        sys.exit("The agent that came back acts differently.")
    print("The agent that came back acts as the one that was shared.")


if __name__ == "__main__":
    main()
