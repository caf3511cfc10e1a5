"""
E1: which loss of the cost's variance gives the true one? ``python benchmark/variance_loss.py MODEL.zip BUFFER.pkl``.

The critics' estimate of the variance begins anew and learns from recorded windows together with that of the mean, by the
squared error or by the 2-Wasserstein distance of arXiv 2407.06317. Then the policy drives unseen episodes, and what was
expected is set against what came, over all states and in bins of the expected mean. Model and buffer:
``benchmark/driving.py esad_lend --few-updates --save-buffer``.
"""

import argparse
from pathlib import Path

import numpy as np
import torch as th
from calibration import UNSEEN, by_expectation, drive, figures
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_esad import ESADLEND
from sb3_esad.common.critics import CostCritic
from sb3_esad.common.functional import wasserstein2
from sb3_esad.demo import FIT_UPDATES
from sb3_esad.esad_lend.policies import CnnPolicy


class WassersteinCostCritic(CostCritic):
    """Cost critic whose variance learns by the 2-Wasserstein distance of Gaussians of the same mean."""

    def loss(
        self, state: PyTorchObs, action: th.Tensor, mean_targets: th.Tensor, variance_targets: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Cross-entropy of the means, as ever, and squared error of the deviation.

        :param state: N states, as the readout takes them
        :param action: their actions, of shape (N, A)
        :param mean_targets: discounted costs, of shape (N,)
        :param variance_targets: their variance, of shape (N,)
        :return: loss of the means summed over critics, and of the variance, each of shape (N,)
        """
        mean_loss, _ = super().loss(state, action, mean_targets, variance_targets)
        _, variance = self.raw(state, action)
        return mean_loss, wasserstein2(mean_targets, variance, mean_targets, variance_targets)


class WassersteinPolicy(CnnPolicy):
    """Policy with that critic."""

    cost_critic_class = WassersteinCostCritic


ARMS: dict[str, type[CnnPolicy]] = {"squared error": CnnPolicy, "2-Wasserstein": WassersteinPolicy}


def fit(policy_class: type[CnnPolicy], path: Path, buffer: Path, env_id: str) -> ESADLEND:
    """
    Let a new estimate of the variance, and the means of a trained model, learn what its policy costs.

    :param policy_class: with the critic to judge
    :param path: of the model
    :param buffer: what it recorded
    :param env_id: scenario with images
    :return: a model with default settings, the networks of the trained one and the critic to judge
    :raises ValueError: if the model has other networks than the default ones
    """
    trained = ESADLEND.load(path, device="cpu")
    env = make_vec_env(env_id, trained.n_envs)
    model = ESADLEND(policy_class, env, cost_gamma=trained.discount_of_cost, seed=0, device="cpu")
    known = {name: value for name, value in trained.policy.state_dict().items() if ".variance." not in name}
    missing, unexpected = model.policy.load_state_dict(known, strict=False)
    if unexpected or any(".variance." not in name for name in missing):
        raise ValueError(f"{path} has other networks than a default model of {env_id}: train one without policy_kwargs.")
    model.load_replay_buffer(buffer)
    model.fit_cost_critic(FIT_UPDATES)
    return model


def main() -> None:
    """Fit, drive, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("buffer", type=Path)
    parser.add_argument("--env", default="esad-highway-v0")
    parser.add_argument("--steps", type=int, default=120_000)
    parser.add_argument("--n-envs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=UNSEEN)
    args = parser.parse_args()
    for name, policy_class in ARMS.items():
        model = fit(policy_class, args.model, args.buffer, args.env)
        visits = drive(model, args.env, args.steps, args.n_envs, args.seed)
        print(f"{name}: {len(visits.mean)} states, {np.count_nonzero(visits.cost)} costs")
        for part in (visits, *by_expectation(visits)):
            mean, found_mean, deviation, found_deviation = figures(part)
            means = f"mean {mean:.5f} against {found_mean:.5f}"
            print(f"    {means}, deviation {deviation:.4f} against {found_deviation:.4f}", flush=True)


if __name__ == "__main__":
    main()
