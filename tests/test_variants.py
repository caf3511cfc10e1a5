"""What experiments compare ESAD-LEND with differs where it says."""

import math

import numpy as np
import pytest
import torch as th
from calibration import Visits, by_expectation
from driving import ALGORITHMS
from gymnasium import spaces
from stable_baselines3.common.logger import configure
from variance_loss import WassersteinCostCritic, WassersteinPolicy
from variants import VARIANTS, CriticsOnlyPenalty, GaussianCostCritic, RoadOnlyPenalty

from sb3_esad import ESADLEND
from sb3_esad.common.critics import CostCritic
from sb3_esad.common.imagined_returns import imagined_costs
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.schedules import HoldThenFall
from sb3_esad.common.torch_layers import GridReadout
from tests.conftest import RandomEnv
from tests.test_esad_lend import imagine

IMAGES = RandomEnv(spaces.Box(0, 255, (3, 64, 64), np.uint8))


def make_critic(critic_class: type[CostCritic]) -> CostCritic:
    th.manual_seed(0)
    return critic_class(GridReadout((4, 1, 1), 16), action_dim=1, net_arch=[16])


@pytest.mark.parametrize(
    ("critic_class", "variance", "risk"),
    [
        (CostCritic, 0.04, 0.2),
        (CostCritic, 0.01, 0.1798),
        (GaussianCostCritic, 0.04, 0.2596),
        (GaussianCostCritic, 0.01, 0.1798),
    ],
)
def test_the_bound_of_risk_is_what_differs(critic_class: type[CostCritic], variance: float, risk: float) -> None:
    found = make_critic(critic_class).risk(th.tensor([[0.1], [0.05]]), th.tensor([variance]), risk_level=0.5)
    assert found.item() == pytest.approx(risk, abs=1e-4)


def test_a_gaussian_may_be_narrower() -> None:
    critic = make_critic(GaussianCostCritic)
    th.nn.init.constant_(critic.variance[-1].bias, -100.0)
    assert critic(th.zeros(1, 4, 1, 1), th.zeros(1, 1))[1].item() == pytest.approx(1e-6, rel=0.1)


@pytest.mark.parametrize(
    ("penalty_class", "moved"), [(AugmentedLagrangian, 0.0), (CriticsOnlyPenalty, 0.1), (RoadOnlyPenalty, -0.1)]
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


@pytest.mark.parametrize(("critic_class", "learned"), [(CostCritic, 0.1), (WassersteinCostCritic, 0.01)])
def test_deviations_that_learn_from_samples_end_below_the_truth(critic_class: type[CostCritic], learned: float) -> None:
    """Where a squared error is 1 with a chance of .1, else 0, the variance is .1; the mean deviation squared is .01."""
    critic = make_critic(critic_class)
    state, action = th.zeros(100, 4, 1, 1), th.zeros(100, 1)
    targets = (th.arange(100) < 10).float()
    optimizer = th.optim.Adam(critic.variance.parameters(), lr=0.01)
    for _ in range(400):
        optimizer.zero_grad()
        critic.loss(state, action, targets, targets)[1].mean().backward()
        optimizer.step()
    assert critic(state, action)[1][0].item() == pytest.approx(learned, rel=0.1)


@pytest.mark.parametrize(
    ("policy_class", "critic_class"), [("CnnPolicy", CostCritic), (WassersteinPolicy, WassersteinCostCritic)]
)
def test_a_policy_builds_its_critic_and_the_average_of_it(policy_class: str, critic_class: type[CostCritic]) -> None:
    policy = ESADLEND(policy_class, IMAGES, buffer_size=100).policy
    assert type(policy.cost_critic) is type(policy.cost_critic_target) is critic_class


PARTS = {"gaussian_risk": GaussianCostCritic, "critics_only": CriticsOnlyPenalty, "road_only": RoadOnlyPenalty}


@pytest.mark.parametrize("name", VARIANTS)
def test_variants_can_be_trained_by_name(name: str) -> None:
    assert ALGORITHMS[name].args[0] is VARIANTS[name]


@pytest.mark.parametrize("name", PARTS)
def test_variants_have_their_part(name: str) -> None:
    model = VARIANTS[name]("CnnPolicy", IMAGES, buffer_size=100)
    assert PARTS[name] in {type(model.policy.cost_critic), type(model.penalty)}


@pytest.mark.parametrize(("name", "rate"), [("esad_lend", 0.0), ("steady_model", 0.25)])
def test_the_steady_model_goes_on_learning(name: str, rate: float) -> None:
    """At the end, where the rate of all others but the cost critics is 0."""
    algorithm = {"esad_lend": ESADLEND, **VARIANTS}[name]
    model = algorithm("CnnPolicy", IMAGES, HoldThenFall(start=1.0, hold=0.5), buffer_size=100, min_cost_critic_rate=0.25)
    model.set_logger(configure(None, []))
    model._current_progress_remaining = 0.0
    model._update_learning_rate([network.optimizer for network in (model.policy.world_model, model.policy.actor)])
    rates = [network.optimizer.param_groups[0]["lr"] for network in (model.policy.world_model, model.policy.actor)]
    assert rates == [rate, 0.0]


def test_the_actor_descends_the_risk_of_a_gaussian() -> None:
    """At the variance .04 it is .798 x .2 above the expected cost, however small that is."""
    settings = {"buffer_size": 100, "learning_starts": 20, "batch_size": 2, "sequence_length": 8}
    model = VARIANTS["gaussian_risk"]("CnnPolicy", IMAGES, **settings).learn(20)
    _, _, imagined = imagine(model)
    output = model.policy.cost_critic.variance[-1]
    th.nn.init.zeros_(output.weight)
    th.nn.init.constant_(output.bias, math.log(math.expm1(0.04)))
    costs = imagined_costs(model.policy.cost_critic, imagined, model.discount_of_cost, model.lambda_return)
    th.testing.assert_close(model._imagined_risk(imagined), costs + 0.1596, atol=1e-3, rtol=0)


def test_states_are_sorted_by_what_was_expected() -> None:
    visits = Visits(*(np.array([5, 1, 3, 2, 4, 0, 9, 7, 8, 6]) * scale for scale in (1, 2, 3, 4)))
    bins = by_expectation(visits)
    assert [each.mean.item() for each in bins] == list(range(10))
    assert [each.cost_to_come.item() for each in bins] == list(range(0, 40, 4))
