"""Critics: they learn the mean and the spread of what is known, and their targets are constants."""

from typing import Any, cast

import pytest
import torch as th

from sb3_esad.common.critics import MIN_VARIANCE, CostCritic, CostTargets, QEnsemble
from sb3_esad.common.imagined_returns import imagined_costs, imagined_returns
from sb3_esad.common.target_networks import make_target, update_target
from sb3_esad.common.torch_layers import GridReadout
from sb3_esad.common.type_aliases import Imagination, Predictions
from sb3_esad.esad_lend.targets import (
    Transitions,
    cost_targets,
    recorded_cost_targets,
    recorded_return_targets,
)

SHAPE = (1, 1, 1)
GAMMA = 0.95
HAZARDS = [(0.01, 0.1681, 0.2562), (0.05, 0.5128, 0.2959)]
"""Chance of a crash at each step, and mean and deviation of the discounted cost of a life under it."""


def state_and_action(n: int = 1) -> tuple[th.Tensor, th.Tensor]:
    """The only state there is, and the only action."""
    return th.ones(n, *SHAPE), th.zeros(n, 1)


def hazard_dream(hazard: float, steps: int, reward: float = 0.0) -> Imagination:
    """What a perfect model imagines of one life: expected values, the same at every step."""
    ones = th.ones(steps, 1)
    predictions = Predictions(reward * ones, hazard * ones, (1 - hazard) * ones)
    weights = (GAMMA * predictions.continues).cumprod(0)
    return Imagination(th.ones(steps + 1, 1, *SHAPE), th.zeros(steps + 1, 1, 1), predictions, weights)


def hazard_record(hazard: float, n: int, steps: int = 1) -> Transitions:
    """What really happens to many lives, as drawn by chance, in windows of some steps."""
    grids, actions = state_and_action(n)
    crashes = (th.rand(n) < hazard).float()
    outcomes = Predictions(th.zeros(n), crashes, 1 - crashes)
    return Transitions(grids, actions, grids, actions, outcomes, th.ones(n), followed(steps, n // steps))


def followed(steps: int, n_windows: int) -> th.Tensor:
    """Windows in which each step but the last is followed by another."""
    return (th.arange(steps) < steps - 1)[:, None].expand(steps, n_windows)


def make_cost_critic(bound: float = 1.0) -> CostCritic:
    critic = CostCritic(GridReadout(SHAPE, 8), 1, [8])
    critic.raise_bound(bound)
    return critic


def fit(critic: CostCritic, make_targets: Any, n: int, steps: int = 300) -> tuple[float, float]:
    """Fitted Q iteration; an average over the last steps."""
    optimizer = th.optim.Adam(critic.parameters(), lr=0.02)
    schedule = th.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.02, steps)
    estimates = []
    for step in range(steps):
        targets = make_targets()
        mean_loss, variance_loss = critic.loss(*state_and_action(n), targets.means.flatten(), targets.variances.flatten())
        optimizer.zero_grad()
        (mean_loss + variance_loss).mean().backward()
        optimizer.step()
        schedule.step()
        if step >= steps // 2:
            means, variance = critic(*state_and_action())
            estimates.append([means.mean().item(), variance.sqrt().item()])
    mean, deviation = th.tensor(estimates).mean(0).tolist()
    return mean, deviation


@pytest.mark.parametrize(("hazard", "mean", "deviation"), HAZARDS)
@pytest.mark.parametrize("bound", [1.0, 20.0])
def test_hazard_chain_learned_from_dreams(hazard: float, mean: float, deviation: float, bound: float) -> None:
    critic, dream = make_cost_critic(bound), hazard_dream(hazard, steps=5)
    learned = fit(critic, lambda: cost_targets(critic, dream, GAMMA, 0.95, continue_after_cost=0.0), n=5)
    assert learned == pytest.approx((mean, deviation), rel=0.05)


@pytest.mark.parametrize(("hazard", "mean", "deviation"), HAZARDS)
@pytest.mark.parametrize("steps", [1, 16])
def test_hazard_chain_learned_from_the_road(steps: int, hazard: float, mean: float, deviation: float) -> None:
    critic = make_cost_critic()

    def draw() -> CostTargets:
        return recorded_cost_targets(critic, hazard_record(hazard, 2048, steps), GAMMA, 0.95)

    learned = fit(critic, draw, n=2048)
    assert learned == pytest.approx((mean, deviation), rel=0.05)


def test_costs_that_do_not_end_the_episode() -> None:
    """A cost of probability p at every step, forever: mean p / (1 - gamma), variance p (1 - p) / (1 - gamma^2)."""
    critic, steps, p = make_cost_critic(bound=1 / (1 - GAMMA)), 5, 0.1
    dream = hazard_dream(p, steps)
    predictions = dream.predictions._replace(continues=th.ones(steps, 1))
    dream = dream._replace(predictions=predictions)
    learned = fit(critic, lambda: cost_targets(critic, dream, GAMMA, 0.95, continue_after_cost=1.0), n=steps)
    assert learned == pytest.approx((p / (1 - GAMMA), (p * (1 - p) / (1 - GAMMA**2)) ** 0.5), rel=0.05)


def test_targets_of_the_mean_are_the_mean_of_the_critics() -> None:
    """Pessimism within the bootstrap would compound."""
    critic = make_cost_critic()
    dream, record = hazard_dream(0.0, steps=1), hazard_record(0.0, 3)
    means, variance = critic(*state_and_action())
    assert abs(means[0] - means[1]) > 1e-4
    imagined = cost_targets(critic, dream, GAMMA, 0.95, 0.0)
    recorded = recorded_cost_targets(critic, record, GAMMA, 0.95)
    expected_variance = (GAMMA * means.mean() - means.mean()) ** 2 + GAMMA**2 * variance
    for targets in (imagined, recorded):
        th.testing.assert_close(targets.means.flatten(), GAMMA * means.mean().expand(targets.means.numel()))
        th.testing.assert_close(targets.variances.flatten(), expected_variance.expand(targets.means.numel()))


def test_costs_are_put_down_to_the_steps_that_led_to_them() -> None:
    """Two windows of three steps whose last one costs; in the second an episode without a cost ended after the first step."""
    critic, record = make_cost_critic(), hazard_record(0.0, 6, steps=3)
    costs, goes_on = th.tensor([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]]), th.tensor([[True, False], [True, True], [False, False]])
    outcomes = Predictions(th.zeros(6), costs.flatten(), 1 - costs.flatten())
    targets = recorded_cost_targets(critic, record._replace(outcomes=outcomes, followed=goes_on), GAMMA, 1.0)
    value = critic(*state_and_action())[0].mean().item()
    expected = [[GAMMA**2, GAMMA * value], [GAMMA, GAMMA], [1.0, 1.0]]  # the same state: corrections cancel
    th.testing.assert_close(targets.means.view(3, 2), th.tensor(expected))


def random_record(steps: int, n_windows: int) -> Transitions:
    """Windows in which every state and every action is another one."""
    n = steps * n_windows
    grids, next_grids = th.randn(2, n, *SHAPE)
    actions, next_actions = 2 * th.rand(2, n, 1) - 1
    costs = (th.rand(n) < 0.3).float()
    outcomes = Predictions(th.zeros(n), costs, 1 - costs)
    return Transitions(grids, actions, next_grids, next_actions, outcomes, th.ones(n), followed(steps, n_windows))


def make_lively_critic() -> CostCritic:
    critic = make_cost_critic()
    for network in (*critic.means, critic.variance):
        th.nn.init.normal_(network[-1].weight)
        th.nn.init.zeros_(network[-1].bias)
    return critic


def test_without_traces_recorded_targets_are_those_of_one_step() -> None:
    critic, record = make_lively_critic(), random_record(steps=3, n_windows=5)
    taken, reached = (record.grids, record.actions), (record.next_grids, record.next_actions)
    expected = critic.targets(taken, reached, record.outcomes.costs, record.outcomes.continues, GAMMA)
    for target, one_step in zip(recorded_cost_targets(critic, record, GAMMA, 0.0), expected, strict=True):
        th.testing.assert_close(target, one_step)


def test_recorded_targets_step_by_step() -> None:
    critic, record = make_lively_critic(), random_record(steps=3, n_windows=1)
    with th.no_grad():
        (means, variances), (next_means, next_variances) = (
            critic(record.grids, record.actions),
            critic(record.next_grids, record.next_actions),
        )
    q, v, next_q, next_v = (each.tolist() for each in (means.mean(0), variances, next_means.mean(0), next_variances))
    cost_to_come, variance_to_come = [0.0] * 3, [0.0] * 3
    for t in (2, 1, 0):
        cost, goes_on = record.outcomes.costs[t].item(), record.outcomes.continues[t].item()
        later = (0.8 * (cost_to_come[t + 1] - q[t + 1]), 0.8 * (variance_to_come[t + 1] - v[t + 1])) if t < 2 else (0.0, 0.0)
        cost_to_come[t] = cost + GAMMA * goes_on * (next_q[t] + later[0])
        error = (cost + GAMMA * goes_on * next_q[t] - q[t]) ** 2
        variance_to_come[t] = error + GAMMA**2 * goes_on * (next_v[t] + later[1])
    targets = recorded_cost_targets(critic, record, GAMMA, 0.8)
    assert targets.means.tolist() == pytest.approx(cost_to_come, abs=1e-5)
    assert targets.variances.tolist() == pytest.approx([max(variance, 0.0) for variance in variance_to_come], abs=1e-5)


def test_what_the_policy_would_not_do_is_not_feared() -> None:
    """
    Half of what was recorded crashed in the second step, by an action that the policy never takes.

    A return without correction expects .475 of the first step.
    """
    n = 64
    grids, next_grids = th.cat([th.ones(n, *SHAPE), -th.ones(n, *SHAPE)]), -th.ones(2 * n, *SHAPE)
    reckless = th.cat([th.zeros(n), (th.arange(n) % 2).float()])
    outcomes = Predictions(th.zeros(2 * n), reckless, th.cat([th.ones(n), th.zeros(n)]))
    actions = reckless[:, None]
    record = Transitions(grids, actions, next_grids, 0 * actions, outcomes, th.ones(2 * n), followed(2, n))
    critic = make_cost_critic()
    optimizer = th.optim.Adam(critic.parameters(), lr=0.02)
    for _ in range(300):
        loss = sum(critic.loss(grids, actions, *recorded_cost_targets(critic, record, GAMMA, 1.0)))
        optimizer.zero_grad()
        cast(th.Tensor, loss).mean().backward()
        optimizer.step()
    means, variances = critic(th.stack([grids[0], grids[-1], grids[-1]]), th.tensor([[0.0], [0.0], [1.0]]))
    assert means.mean(0).tolist() == pytest.approx([0.0, 0.0, 1.0], abs=0.03)
    assert variances.sqrt().tolist() == pytest.approx([0.0, 0.0, 0.0], abs=0.1)


def test_decisions_fear_the_larger_estimate() -> None:
    critic = make_cost_critic()
    means, _ = critic(*state_and_action())
    imagined = imagined_costs(critic, hazard_dream(0.1, steps=1), GAMMA, 0.95)
    th.testing.assert_close(imagined, (0.1 + GAMMA * 0.9 * means.max()).view(1, 1))


def make_critic() -> QEnsemble:
    critic = QEnsemble(GridReadout(SHAPE, 8), 1, [8])
    for network in critic.q_networks:
        th.nn.init.normal_(cast(Any, network)[-1].weight, std=0.3)
    return critic


def test_return_targets_take_the_smaller_critic_and_stop_at_the_end() -> None:
    critic = make_critic()
    values = critic(*state_and_action())
    assert values[0] != values[1]
    smaller = values.min()
    imagined = imagined_returns(critic, hazard_dream(0.2, 1, reward=3.0), GAMMA, 0.95)
    th.testing.assert_close(imagined, (3.0 + GAMMA * 0.8 * smaller).view(1, 1))
    grids, actions = state_and_action(2)
    outcomes = Predictions(th.tensor([1.0, 2.0]), th.zeros(2), th.tensor([1.0, 0.0]))
    record = Transitions(grids, actions, grids, actions, outcomes, th.ones(2), followed(1, 2))
    expected = th.stack([1.0 + GAMMA * smaller, th.tensor(2.0)])
    th.testing.assert_close(recorded_return_targets(critic, record, GAMMA), expected)


def test_targets_have_no_gradient() -> None:
    costs, rewards, record = make_cost_critic(), make_critic(), hazard_record(0.1, 3)
    dream = hazard_dream(0.1, 3)
    targets = [
        *cost_targets(costs, dream, GAMMA, 0.95, 0.0),
        *recorded_cost_targets(costs, record, GAMMA, 0.95),
        recorded_return_targets(rewards, record, GAMMA),
    ]
    assert not any(target.requires_grad for target in targets)


def test_targets_are_averages_whose_buffers_are_up_to_date() -> None:
    critic = CostCritic(GridReadout(SHAPE, 8), 1, [8])
    target = make_target(critic)
    bias = target.means[0][-1].bias
    assert bias.item() == -4.0
    critic.raise_bound(2.0)
    with th.no_grad():
        critic.means[0][-1].bias.fill_(6.0)
    update_target(critic, target, 0.1)
    assert bias.item() == pytest.approx(0.9 * -4.0 + 0.1 * 6.0)
    assert target.bound.item() == 2.0


def test_counters_of_a_network_are_copied() -> None:
    network = th.nn.BatchNorm1d(3)
    target = make_target(network)
    network(th.randn(8, 3))
    update_target(network, target, 0.1)
    assert target.num_batches_tracked == 1 and th.equal(target.running_mean, network.running_mean)


def test_target_networks_are_frozen_copies() -> None:
    critic = CostCritic(GridReadout(SHAPE, 8), 1, [8])
    target = make_target(critic)
    assert not target.training and not any(parameter.requires_grad for parameter in target.parameters())
    before = target(*state_and_action())
    with th.no_grad():
        for parameter in critic.parameters():
            parameter.add_(1.0)
    for one, other in zip(before, target(*state_and_action()), strict=True):
        th.testing.assert_close(one, other)


def test_cost_critic_starts_near_zero_and_is_never_certain() -> None:
    means, variance = CostCritic(GridReadout(SHAPE, 8), 1, [8])(*state_and_action())
    assert (means < 0.05).all() and MIN_VARIANCE < variance < 0.05
    critic = CostCritic(GridReadout(SHAPE, 8), 1, [8])
    for parameter in critic.parameters():
        th.nn.init.constant_(parameter, -100.0)
    means, variance = critic(*state_and_action())
    assert variance.item() == pytest.approx(MIN_VARIANCE)
    variance.sqrt().backward()
    assert all(parameter.grad is None or parameter.grad.isfinite().all() for parameter in critic.parameters())


def test_raised_bound_keeps_small_estimates() -> None:
    critic = CostCritic(GridReadout(SHAPE, 8), 1, [8])
    before, variance_before = critic(*state_and_action())
    critic.raise_bound(33.0)
    after, variance_after = critic(*state_and_action())
    assert critic.bound.item() == 33.0
    th.testing.assert_close(after, before, rtol=0.05, atol=0)
    th.testing.assert_close(variance_after, variance_before)
    critic.raise_bound(2.0)
    assert critic.bound.item() == 33.0, "it is never lowered"
    again, _ = critic(*state_and_action())
    th.testing.assert_close(again, after)


def test_mean_stays_within_its_bound() -> None:
    critic = CostCritic(GridReadout(SHAPE, 8), 1, [8])
    critic.raise_bound(4.0)
    means, _ = critic(th.full((1, *SHAPE), 1e6), th.full((1, 1), 1e6))
    assert ((means >= 0) & (means <= 4.0)).all()
    loss, _ = critic.loss(*state_and_action(), th.tensor([9.0]), th.zeros(1))  # a target beyond the bound counts as the bound
    at_bound, _ = critic.loss(*state_and_action(), th.tensor([4.0]), th.zeros(1))
    th.testing.assert_close(loss, at_bound)


def test_reward_critics_decode_what_they_were_fitted_to() -> None:
    critic = QEnsemble(GridReadout((2, 1, 1), 16), 1, [16])
    grids, actions = th.randn(6, 2, 1, 1), th.randn(6, 1)
    targets = th.tensor([-50.0, -2.0, 0.0, 0.5, 7.0, 400.0])
    assert critic(grids, actions).abs().max() < 1e-3, "untrained critics expect nothing"
    optimizer = th.optim.Adam(critic.parameters(), lr=0.02)
    for _ in range(300):
        loss = critic.loss(grids, actions, targets)
        assert loss.shape == (6,)
        optimizer.zero_grad()
        loss.mean().backward()
        optimizer.step()
    th.testing.assert_close(critic(grids, actions), targets.expand(2, -1), rtol=0.05, atol=0.1)


def test_return_scale_is_the_spread_but_never_below_one() -> None:
    critic = QEnsemble(GridReadout(SHAPE, 8), 1, [8])
    returns = th.arange(101.0).view(1, 101)
    for _ in range(800):
        critic.follow_scale(returns)
    assert critic.scale.item() == pytest.approx(90.0, rel=0.01)
    for _ in range(2000):
        critic.follow_scale(returns / 1e6)
    assert critic.scale.item() == 1.0
    critic.follow_scale(returns, rate=1.0)
    assert critic.scale.item() == pytest.approx(90.0)
