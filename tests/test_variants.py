"""What experiments compare ESAD-LEND with differs in what it says, and in nothing else."""

import numpy as np
import pytest
import torch as th

from benchmark.calibration import Visits, by_expectation
from benchmark.variance_loss import WassersteinCostCritic, risks
from benchmark.variants import GaussianCostCritic, ModelSignalPenalty, RoadSignalPenalty
from sb3_esad.common.critics import CostCritic
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.torch_layers import GridReadout


@pytest.mark.parametrize(("critic_class", "risk"), [(CostCritic, 0.2), (GaussianCostCritic, 0.2596)])
def test_the_bound_of_risk_is_what_differs(critic_class: type[CostCritic], risk: float) -> None:
    critic = critic_class(GridReadout((4, 1, 1), 16), action_dim=1, net_arch=[16])
    found = critic.risk(th.tensor([[0.1], [0.05]]), th.tensor([0.04]), risk_level=0.5)
    assert found.item() == pytest.approx(risk, abs=1e-4)


@pytest.mark.parametrize(
    ("penalty_class", "moved"), [(AugmentedLagrangian, 0.0), (ModelSignalPenalty, 0.1), (RoadSignalPenalty, -0.1)]
)
def test_signals_that_disagree_move_a_multiplier_that_follows_one(
    penalty_class: type[AugmentedLagrangian], moved: float
) -> None:
    penalty = penalty_class(cost_limit=1.0, cost_gamma=1.0, risk_level=1.0, penalty_warmup=0, road_steps=20, lambda_lr=0.1)
    for _ in range(50):
        penalty.observe(np.array([0.0]), np.array([True]))
    penalty.note_prediction(th.zeros(4))
    before = penalty.multiplier.item()
    penalty.update(1.0)
    assert penalty.multiplier.item() - before == pytest.approx(moved, abs=1e-6)


def test_deviations_that_learn_from_samples_end_below_the_truth() -> None:
    """Where a squared error is 1 with a chance of .01, else 0, the variance is .01; the mean deviation squared is .0001."""
    ends = {}
    for critic_class in (CostCritic, WassersteinCostCritic):
        th.manual_seed(0)
        critic = critic_class(GridReadout((4, 1, 1), 16), action_dim=1, net_arch=[16])
        state, action = th.zeros(100, 4, 1, 1), th.zeros(100, 1)
        targets = (th.arange(100) == 0).float()
        optimizer = th.optim.Adam(critic.variance.parameters(), lr=0.01)
        for _ in range(400):
            optimizer.zero_grad()
            critic.loss(state, action, targets, targets)[1].mean().backward()
            optimizer.step()
        ends[critic_class] = critic(state, action)[1][0].item()
    assert ends[CostCritic] == pytest.approx(0.01, abs=1e-3)
    assert ends[WassersteinCostCritic] == pytest.approx(0.0001, abs=1e-4)


def test_risk_of_what_came_is_the_mean_of_its_worst_part() -> None:
    visits = Visits(np.full(10, 0.1), np.full(10, 0.09), np.zeros(10), np.arange(10) == 3)
    assert risks(visits, risk_level=0.5) == pytest.approx((0.2, 0.2))


def test_states_are_sorted_by_what_was_expected() -> None:
    visits = Visits(*(np.array([5, 1, 3, 2, 4, 0, 9, 7, 8, 6]) * scale for scale in (1, 2, 3, 4)))
    bins = by_expectation(visits)
    assert [each.mean.item() for each in bins] == list(range(10))
    assert [each.cost_to_come.item() for each in bins] == list(range(0, 40, 4))
