"""
E1: which loss of the cost's variance makes risk what it is? ``python benchmark/variance_loss.py MODEL.zip BUFFER.pkl``.

The critics' estimate of the variance begins anew and learns from recorded windows together with that of the mean, by the
squared error or by the 2-Wasserstein distance of arXiv 2407.06317. Then the policy drives unseen episodes, and in bins of the
expected risk that is set against the conditional value at risk of what came.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import torch as th
from calibration import UNSEEN, Visits, by_expectation, drive, figures
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_esad import ESADLEND
from sb3_esad.common.critics import CostCritic
from sb3_esad.common.functional import capped_cvar
from sb3_esad.esad_lend.policies import CnnPolicy


class WassersteinCostCritic(CostCritic):
    """Cost critic whose deviations, not variances, learn from their targets (arXiv 2407.06317; Yang et al. 2021)."""

    def loss(
        self, state: PyTorchObs, action: th.Tensor, mean_targets: th.Tensor, variance_targets: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """
        Cross-entropy of the means and squared error of the deviation.

        :param state: N states
        :param action: their actions, of shape (N, A)
        :param mean_targets: discounted costs, of shape (N,)
        :param variance_targets: their variance, of shape (N,)
        :return: both losses, of shape (N,)
        """
        mean_loss, _ = super().loss(state, action, mean_targets, variance_targets)
        _, variance = self.raw(state, action)
        return mean_loss, (variance.sqrt() - variance_targets.sqrt()).square()


class WassersteinPolicy(CnnPolicy):
    """Policy with that critic."""

    cost_critic_class = WassersteinCostCritic


ARMS: dict[str, type[CnnPolicy]] = {"squared error": CnnPolicy, "2-Wasserstein": WassersteinPolicy}


def fit(policy_class: type[CnnPolicy], model: Path, buffer: Path, env_id: str, gradient_steps: int) -> ESADLEND:
    """
    Let the cost critics learn what a trained policy costs.

    :param policy_class: with the critic to judge
    :param model: trained
    :param buffer: what it recorded
    :param env_id: scenario
    :param gradient_steps: of the critics
    :return: the model with its critics
    """
    trained = ESADLEND.load(model, device="cpu")
    fitted = ESADLEND(policy_class, make_vec_env(env_id, trained.n_envs), cost_gamma=trained.cost_gamma, seed=0, device="cpu")
    known = {name: value for name, value in trained.policy.state_dict().items() if ".variance." not in name}
    fitted.policy.load_state_dict(known, strict=False)
    fitted.load_replay_buffer(buffer)
    fitted.replay_buffer.recency = 3.0
    fitted.fit_cost_critic(gradient_steps)
    return fitted


def risks(visits: Visits, risk_level: float) -> tuple[float, float]:
    """
    Conditional value at risk over a set of states.

    :param visits: states
    :param risk_level: worst fraction of outcomes
    :return: mean of what was expected, and what came
    """
    mean, variance = th.as_tensor(visits.mean), th.as_tensor(visits.variance)
    worst = np.sort(visits.cost_to_come)[-math.ceil(risk_level * len(visits.cost_to_come)) :]
    return capped_cvar(mean, variance, risk_level, 1.0).mean().item(), worst.mean()


def main() -> None:
    """Fit, drive, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model", type=Path)
    parser.add_argument("buffer", type=Path)
    parser.add_argument("--env", default="esad-highway-v0")
    parser.add_argument("--updates", type=int, default=300)
    parser.add_argument("--steps", type=int, default=120_000)
    parser.add_argument("--n-envs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=UNSEEN)
    args = parser.parse_args()
    for name, policy_class in ARMS.items():
        model = fit(policy_class, args.model, args.buffer, args.env, args.updates)
        visits = drive(model, args.env, args.steps, args.n_envs, args.seed)
        expected, came = np.array([risks(each, model.risk_level) for each in by_expectation(visits)]).T
        slope = (expected * came).sum() / (expected**2).sum()
        mean, found_mean, deviation, found_deviation = figures(visits)
        print(f"{name}: {len(visits.mean)} states, {np.count_nonzero(visits.cost)} costs")
        print(f"    mean {mean:.5f} against {found_mean:.5f}, deviation {deviation:.4f} against {found_deviation:.4f}")
        print(f"    risk {expected.mean():.5f} against {came.mean():.5f}, slope {slope:.2f}", flush=True)


if __name__ == "__main__":
    main()
