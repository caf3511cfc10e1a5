"""
Learning curves of driving: ``python benchmark/driving.py esad_lend --seed 0 --steps 20000 --out runs``.

One run trains one algorithm with one seed, stops every so often to drive unseen episodes with the best and with sampled
actions, and appends a line of JSON for each to ``OUT/<algorithm>_<seed>.jsonl``; the log of the training goes into the folder
``OUT/<algorithm>_<seed>``. Time spent on evaluation does not count.
"""

import argparse
import csv
import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.preprocessing import is_image_space
from variants import VARIANTS

from sb3_esad import ADEND, ESADLEND, SADLEN, WCSAC, SACLag
from sb3_esad.common.selection import SelectionRates
from sb3_esad.demo import FEW_UPDATES
from sb3_esad.driving_evaluation import evaluate_model
from sb3_esad.envs.metrics import summarise
from sb3_esad.hyperparams import load_hyperparams

LOGGED = (
    "train/lagrangian_multiplier",
    "safety/cost_calibration",
    *(f"rollout/{name}" for name in SelectionRates.names),
)
"""Of the training's log, what belongs beside its curve."""
UNSEEN = 9_000_000
"""First seed of the evaluation, on whose episodes nothing has been chosen; tune on others (--unseen)."""


def tuned(
    algorithm: type[OffPolicyAlgorithm], name: str, env_id: str, seed: int, changes: dict[str, Any]
) -> OffPolicyAlgorithm:
    """
    Build an algorithm of this package with the scenario's hyperparameters.

    :param algorithm: its class
    :param name: of its hyperparameters
    :param env_id: scenario
    :param seed: of the training
    :param changes: arguments of the constructor to replace
    :return: the algorithm
    """
    hyperparams = load_hyperparams(algorithm, name, env_id)
    return algorithm(env=hyperparams.make_env(env_id), seed=seed, **{**hyperparams.arguments, **changes})


class CostInReward(gym.Wrapper[Any, Any, Any, Any]):
    """
    Tells an algorithm that knows no costs about them.

    :param env: environment with a cost
    :param penalty: what a cost of 1 takes from the reward
    """

    def __init__(self, env: gym.Env[Any, Any], penalty: float) -> None:
        super().__init__(env)
        self.penalty = penalty

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """
        Step the environment.

        :param action: passed on
        :return: what the environment returns, its reward less the penalty
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, float(reward) - self.penalty * info["cost"], terminated, truncated, info


def sac(env_id: str, seed: int, changes: dict[str, Any]) -> SAC:
    """
    Build SB3's SAC for images that show speeds in one frame, as tuned in docs/experiments.md, section 14.

    :param env_id: scenario; those of vectors take the settings of images
    :param seed: of the training
    :param changes: arguments of the constructor to replace, and ``penalty``, what a cost takes from the reward
    :return: the algorithm
    """
    env = make_vec_env(env_id, wrapper_class=partial(CostInReward, penalty=changes.pop("penalty", 10.0)))
    arguments: dict[str, Any] = {
        "policy": "CnnPolicy" if is_image_space(env.observation_space) else "MlpPolicy",
        **{"buffer_size": 50_000, "gamma": 0.97, "learning_starts": 1000},
        **{"batch_size": 64, "learning_rate": 1e-3, "ent_coef": "auto_0.1", "target_entropy": -1.0},
        **changes,
    }
    return SAC(env=env, seed=seed, **arguments)


ALGORITHMS: dict[str, Callable[[str, int, dict[str, Any]], OffPolicyAlgorithm]] = {
    "esad_lend": partial(tuned, ESADLEND, "esad_lend"),
    "sad_len": partial(tuned, SADLEN, "sad_len"),
    "ad_end": partial(tuned, ADEND, "ad_end"),
    "wcsac": partial(tuned, WCSAC, "wcsac"),
    "sac_lag": partial(tuned, SACLag, "sac_lag"),
    "sac": sac,
    **{name: partial(tuned, algorithm, "esad_lend") for name, algorithm in VARIANTS.items()},
}


def usual(log: Path, after: int) -> dict[str, float]:
    """
    Average what a training has logged.

    :param log: its progress.csv
    :param after: steps before which lines do not count
    :return: means of those of ``LOGGED`` that there are
    """
    with log.open() as file:
        lines = [line for line in csv.DictReader(file) if int(line["time/total_timesteps"]) > after]
    found = {key: [float(line[key]) for line in lines if line.get(key)] for key in LOGGED}
    return {key: sum(values) / len(values) for key, values in found.items() if values}


class LearningCurve(BaseCallback):
    """
    Drives unseen episodes every ``every`` steps, and at the end.

    :param path: file to which lines of JSON are appended
    :param env_id: scenario
    :param every: environment steps
    :param seeds: of the episodes of each evaluation
    """

    def __init__(self, path: Path, env_id: str, every: int, seeds: range) -> None:
        super().__init__()
        self.path, self.env_id, self.every, self.seeds = path, env_id, every, seeds

    def _on_training_start(self) -> None:
        self._next, self._seconds, self._resumed = self.every, 0.0, time.monotonic()
        self._cost, self._episodes, self._evaluated = 0.0, 0, 0
        self._cost_steps: list[int] = []

    def _on_step(self) -> bool:
        costs = [info["cost"] for info in self.locals["infos"] if info["cost"] > 0]
        self._cost += sum(costs)
        self._cost_steps += [self.num_timesteps] * len(costs)
        self._episodes += int(self.locals["dones"].sum())
        is_last = self.num_timesteps >= self.locals["total_timesteps"]  # the updates that follow belong to the last evaluation
        if self.num_timesteps >= self._next and not is_last:
            self._next += self.every
            self._evaluate()
        return True

    def _on_training_end(self) -> None:
        self._evaluate()

    def _evaluate(self) -> None:
        self._seconds += time.monotonic() - self._resumed
        line: dict[str, Any] = {"steps": self.num_timesteps, "seconds": round(self._seconds), "unseen": self.seeds[0]}
        line |= {"training_cost": self._cost, "training_episodes": self._episodes, "cost_steps": self._cost_steps}
        line["log"] = usual(self.path.with_suffix("") / "progress.csv", self._evaluated)
        self._evaluated = self.num_timesteps
        for name, deterministic in (("best", True), ("sampled", False)):
            line[name] = summarise(evaluate_model(self.model, self.env_id, self.seeds, deterministic))
        with self.path.open("a") as file:
            file.write(json.dumps(line) + "\n")
        self.model.save(self.path.with_suffix(".zip"))
        print(json.dumps(line), flush=True)
        self._resumed = time.monotonic()


def main() -> None:
    """Train and evaluate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("algorithm", choices=list(ALGORITHMS))
    parser.add_argument("--env", default="esad-highway-v0", help="scenario (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--every", type=int, default=1500)
    parser.add_argument("--episodes", type=int, default=100)
    parser.add_argument(
        "--unseen",
        type=int,
        default=UNSEEN,
        help="first seed of the evaluation; to choose among settings take others, such as 500000 (default: %(default)s)",
    )
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("runs"))
    parser.add_argument("--set", type=json.loads, default={}, help="JSON of constructor arguments to replace")
    parser.add_argument("--save-buffer", action="store_true", help="at the end, beside the model")
    parser.add_argument("--few-updates", action="store_true", help="as the demo has them, for algorithms that imagine")
    args = parser.parse_args()
    th.set_num_threads(args.threads)
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / f"{args.algorithm}_{args.seed}.jsonl"
    path.unlink(missing_ok=True)
    curve = LearningCurve(path, args.env, args.every, range(args.unseen, args.unseen + args.episodes))
    changes = {**(FEW_UPDATES if args.few_updates else {}), **args.set}
    model = ALGORITHMS[args.algorithm](args.env, args.seed, changes)
    model.set_logger(configure(str(path.with_suffix("")), ["csv"]))
    model.learn(args.steps, callback=curve)
    if args.save_buffer:
        model.save_replay_buffer(path.with_suffix(".pkl"))


if __name__ == "__main__":
    main()
