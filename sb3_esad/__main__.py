"""The command line: ``python -m sb3_esad evaluate | demo``, and RL Zoo's commands."""

import argparse
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import torch as th
from stable_baselines3.common.utils import set_random_seed

from sb3_esad import __version__
from sb3_esad.algorithms import load_model
from sb3_esad.demo import ENV_ID, MINUTES, TIMESTEPS, run_demo
from sb3_esad.driving_evaluation import evaluate_driver, evaluate_model
from sb3_esad.envs.drivers import DRIVERS
from sb3_esad.report import format_table, summarise_any, write_json
from sb3_esad.video import record_driver, record_explanation, record_model

ZOO_COMMANDS = {
    "train": "train an agent",
    "optimize": "search for settings that keep the cost limit",
    "enjoy": "watch an agent",
    "record_video": "film an agent",
    "record_training": "film how an agent became what it is",
    "plot_train": "plot the episodes of trainings",
    "all_plots": "plot evaluations of trainings, their costs too",
    "push_to_hub": "share an agent",
    "load_from_hub": "fetch an agent that somebody has shared",
}
"""Commands that take RL Zoo's options."""
ZOO_PACKAGES = ("rl_zoo3", "requests", "seaborn", "moviepy", "imageio_ffmpeg")


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command.

    :param arguments: words of the command line, None for those of the process
    :return: exit code, 2 if the user must change something
    """
    args = make_parser().parse_args(arguments)
    try:
        args.run(args)
    except (ValueError, ImportError, OSError, gymnasium.error.Error) as error:
        print(f"sb3_esad {args.command}: {error}", file=sys.stderr)
        return 2
    return 0


def make_parser() -> argparse.ArgumentParser:
    """
    Describe the commands; each sets ``run`` to the function that carries it out.

    :return: the parser
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_esad", description="Safe model-based reinforcement learning for driving."
    )
    parser.add_argument("--version", action="version", version=f"sb3_esad {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_evaluate(commands.add_parser("evaluate", help="drive episodes with a model or a scripted driver, print the metrics"))
    _add_explain(commands.add_parser("explain", help="film an episode beside what the model thinks of it"))
    _add_demo(commands.add_parser("demo", help="train briefly, evaluate, write model, learning curve, results and video"))
    for name, text in ZOO_COMMANDS.items():
        # No word starts with a null, so all of them are handed on, --help too
        _add_zoo(commands.add_parser(name, help=f"{text} (RL Zoo)", add_help=False, prefix_chars="\0"))
    return parser


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_evaluate)
    who = parser.add_mutually_exclusive_group(required=True)
    who.add_argument("--model", type=Path, metavar="FILE.zip", help="saved model of any algorithm")
    who.add_argument("--driver", choices=DRIVERS, help="scripted driver")
    _add_trusted(parser)
    _add_env(parser)
    parser.add_argument("--episodes", type=_positive, default=100, metavar="N", help="how many (default: %(default)s)")
    parser.add_argument(
        "--seed", type=_not_negative, default=0, metavar="S", help="episode i uses seed S + i (default: %(default)s)"
    )
    parser.add_argument("--stochastic", action="store_true", help="sample the model's actions")
    parser.add_argument("--video", type=Path, metavar="FILE.mp4", help="film the first episode")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write figures and episode records")


def _evaluate(args: argparse.Namespace) -> None:
    seeds = range(args.seed, args.seed + args.episodes)
    if args.driver:
        name, how = args.driver, "scripted"
        if args.video:
            record_driver(args.video, args.driver, args.env, args.seed)
        records = evaluate_driver(args.driver, args.env, seeds)
    else:
        name, how = args.model.name, "stochastic" if args.stochastic else "deterministic"
        model = load_model(args.model, args.trusted)
        if args.video:
            set_random_seed(args.seed)
            record_model(args.video, model, args.env, args.seed, not args.stochastic)
        set_random_seed(args.seed)  # here, so that the figures are the same with and without a video
        records = evaluate_model(model, args.env, seeds, not args.stochastic)
    figures = summarise_any(records)
    print(
        f"{args.env}, {args.episodes} episodes with the seeds {seeds[0]} to {seeds[-1]}, {how}; in brackets 95 % intervals\n"
    )
    print(format_table({name: figures}))
    if args.json:
        about = {"env": args.env, "driver": name, "how": how, "sb3_esad": __version__}
        write_json(args.json, {**about, "figures": figures, "records": records})


def _add_explain(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_explain)
    parser.add_argument("--model", type=Path, required=True, metavar="FILE.zip", help="saved model that imagines")
    _add_trusted(parser)
    _add_env(parser)
    parser.add_argument("--seed", type=_not_negative, default=0, metavar="S", help="of the episode (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("explanation.mp4"), metavar="FILE.mp4", help="(default: %(default)s)")


def _add_env(parser: argparse.ArgumentParser) -> None:
    text = "environment, as MODULE:ID if a module of yours registers it (default: %(default)s)"
    parser.add_argument("--env", default=ENV_ID, metavar="ID", help=text)


def _add_trusted(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--trusted", action="store_true", help="let the model run what code its file holds")


def _explain(args: argparse.Namespace) -> None:
    record_explanation(args.out, load_model(args.model, args.trusted), args.env, args.seed)
    print(f"Written: {args.out}")


def _add_demo(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_demo)
    parser.add_argument(
        "--out", type=Path, default=Path("demo"), metavar="FOLDER", help="where to write (default: %(default)s)"
    )
    parser.add_argument("--env", default=ENV_ID, metavar="ID", help="driving scenario (default: %(default)s)")
    parser.add_argument("--seed", type=_not_negative, default=0, metavar="S", help="of the training (default: %(default)s)")
    parser.add_argument(
        "--timesteps", type=_positive, default=TIMESTEPS, metavar="N", help="environment steps (default: %(default)s)"
    )
    parser.add_argument(
        "--minutes", type=_above_zero, default=MINUTES, metavar="M", help="of training at most (default: %(default)s)"
    )
    parser.add_argument(
        "--episodes", type=_positive, default=100, metavar="N", help="of the evaluation (default: %(default)s)"
    )
    parser.add_argument("--threads", type=_positive, default=2, metavar="N", help="of the processor (default: %(default)s)")


def _demo(args: argparse.Namespace) -> None:
    th.set_num_threads(args.threads)
    run_demo(args.out, args.seed, args.timesteps, args.minutes, args.episodes, args.env)


def _add_zoo(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(run=_zoo)
    parser.add_argument("words", nargs=argparse.REMAINDER)


def _zoo(args: argparse.Namespace) -> None:
    missing = [name for name in ZOO_PACKAGES if find_spec(name) is None]
    if missing:
        raise ImportError(f"RL Zoo's commands need {', '.join(missing)}: pip install 'sb3_esad[zoo]'.")
    from sb3_esad.zoo.commands import run  # takes seconds

    run(args.command, args.words)


def _positive(text: str) -> int:
    return _at_least(1, text)


def _not_negative(text: str) -> int:
    return _at_least(0, text)


def _at_least(least: int, text: str) -> int:
    if not text.lstrip("+-").isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"'{text}' is no whole number from {least} on")
    return int(text)


def _above_zero(text: str) -> float:
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is no number above 0")
    return number


if __name__ == "__main__":
    sys.exit(main())
