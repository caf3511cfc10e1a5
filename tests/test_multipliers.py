"""Penalties, their multiplier and the entropy coefficient."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_esad.common.entropy import FixedCoefficient, LearnedCoefficient, make_entropy_coefficient
from sb3_esad.common.episode_record import EpisodeRecord
from sb3_esad.common.functional import discounted_budget
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.penalties import NoPenalty


def make_penalty(**kwargs: Any) -> AugmentedLagrangian:
    defaults = {"cost_limit": 1.0, "cost_gamma": 1.0, "risk_level": 1.0, "penalty_warmup": 0, "road_steps": 20}
    return AugmentedLagrangian(**{**defaults, "lagrangian_multiplier_init": 1.0, "barrier_coef": 1.0, **kwargs})


def observe_episodes(penalty: AugmentedLagrangian, cost: float, n: int = 50, length: int = 1) -> None:
    """Let ``n`` episodes end, each with ``cost`` in its last step."""
    for _ in range(n):
        for step in range(length):
            last = step == length - 1
            penalty.observe(np.array([cost * last]), np.array([last]))


def calibrate(penalty: AugmentedLagrangian, cost: float) -> None:
    """Make the critics agree with a road on which every episode costs ``cost``."""
    observe_episodes(penalty, cost)
    penalty.note_prediction(th.full((4,), cost))


@pytest.mark.parametrize(("violation", "expected"), [(0.5, 0.625), (-2.0, -0.5)])
def test_psi_known_values(violation: float, expected: float) -> None:
    assert make_penalty()(th.tensor(violation)).item() == pytest.approx(expected)


def test_psi_equals_the_two_branches() -> None:
    for multiplier, coef, scale in 10 ** th.empty(100, 3, dtype=th.float64).uniform_(-1, 1):
        penalty = make_penalty(penalty_coef=coef.item()).double()
        penalty.multiplier.copy_(multiplier)
        g = scale * th.randn(100, dtype=th.float64)
        textbook = th.where(multiplier + coef * g > 0, multiplier * g + coef * g**2 / 2, -(multiplier**2) / (2 * coef))
        square = (th.relu(multiplier + coef * g) ** 2 - multiplier**2) / (2 * coef)
        th.testing.assert_close(penalty(g), textbook)
        th.testing.assert_close(penalty(g), square)


def test_psi_without_proportional_part_is_linear() -> None:
    penalty = make_penalty(penalty_coef=0.0)
    g = th.linspace(-5, 5, 11)
    th.testing.assert_close(penalty(g), g)
    penalty.multiplier.zero_()
    th.testing.assert_close(penalty(g), th.zeros(11))


@pytest.mark.parametrize(("lambda_lr", "penalty_coef"), [(1.0, 1.0), (0.1, 1.0), (0.5, 2.0), (0.1, 5.0)])
def test_finds_the_constrained_minimum(lambda_lr: float, penalty_coef: float) -> None:
    """Min x^2 subject to x >= 1 has x = 1 and the multiplier 2 (Karush, Kuhn, Tucker)."""
    penalty = make_penalty(lambda_lr=lambda_lr, penalty_coef=penalty_coef, min_episodes=51, window=51)
    penalty._signals = lambda violation: {"violation_model": violation}  # type: ignore[method-assign]
    x = th.tensor(0.0)
    for _ in range(400):
        x.requires_grad_()
        (slope,) = th.autograd.grad(x**2 + penalty(1 - x), x)
        x = (x - slope / (2 + penalty_coef)).detach()  # Newton's step, for the loss is quadratic near the minimum
        penalty.update(1 - x)
    assert x.item() == pytest.approx(1.0, abs=1e-3)
    assert penalty.multiplier.item() == pytest.approx(2.0, abs=5e-3)


def test_budget() -> None:
    penalty = make_penalty(cost_limit=0.05, cost_gamma=0.95, episode_length=40)
    assert penalty.budget == pytest.approx(discounted_budget(0.05, 0.95, 40)) == pytest.approx(0.0218, abs=1e-4)
    assert make_penalty(cost_limit=3.0, cost_gamma=1.0).budget == 3.0
    strict = make_penalty(cost_limit=0.0, cost_gamma=0.9)
    assert strict.budget == 0.0 and strict.budget_scale == 0.01


def test_horizon_follows_cost_free_episodes_only() -> None:
    penalty = make_penalty(cost_gamma=0.9, episode_length=40)
    observe_episodes(penalty, cost=1.0, length=3)
    assert penalty.episodes.episode_length == 40
    observe_episodes(penalty, cost=0.0, n=500, length=10)
    assert penalty.episodes.episode_length == pytest.approx(10, abs=0.01)


def test_combine() -> None:
    penalty = make_penalty(barrier_coef=2.0, cost_limit=0.5)
    objective, risk = th.tensor([1.0, -1.0]), th.tensor([0.5, 0.25], requires_grad=True)
    barrier = th.tensor([-1.0, 0.25], requires_grad=True)
    loss = penalty.combine(objective, risk, barrier)
    th.testing.assert_close(loss, th.tensor([1.5, -1.0 + 2 * 0.25]) / 2.5)
    loss.sum().backward()
    assert barrier.grad is None
    th.testing.assert_close(risk.grad, th.tensor([1.0, 2.0]) / 2.5)


def test_weight_never_rewards_cost_nor_exceeds_its_bound() -> None:
    penalty = make_penalty(penalty_coef=5.0, multiplier_bounds=(0.05, 3.0))
    penalty.mean_violation.fill_(-1.0)
    zeros, ones = th.zeros(2), th.ones(2)
    assert penalty.base_weight.item() == 0.0
    th.testing.assert_close(penalty.combine(zeros, ones, zeros), zeros)
    th.testing.assert_close(penalty.combine(zeros, ones, 1e9 * ones), th.full((2,), 3.0 / 4.0))


def test_admissible() -> None:
    penalty = make_penalty(cost_limit=0.0)
    risk, barrier = th.tensor([0.005, 0.02, 0.005]), th.tensor([0.0, -1.0, 0.1])
    assert penalty.admissible(risk, barrier).tolist() == [True, False, False]


def test_both_signals_move_the_multiplier() -> None:
    penalty = make_penalty(lambda_lr=0.01)
    calibrate(penalty, 5.0)
    for _ in range(100):
        logs = penalty.update(99.0)
    assert logs["safety/violation_model"] == logs["safety/violation_road"] == 1.0
    assert penalty.multiplier.item() == pytest.approx(2.0, abs=1e-4)
    for _ in range(48):
        penalty.update(th.tensor(99.0), gradient_steps=101)
    assert penalty.multiplier.item() == 50.0


def test_at_the_allowed_rate_the_signal_of_the_road_has_no_direction() -> None:
    """Crashes at random in one of 40 episodes, half of the limit, for the worst half of the episodes holds them all."""
    penalty = make_penalty(cost_limit=0.05, risk_level=0.5, episode_length=150, window=500, min_episodes=20, road_steps=2000)
    rng = np.random.default_rng(0)
    signals = []
    for _ in range(1000):
        crashes = rng.random(10) < 0.025
        for step in range(150):
            last = np.full(10, step == 149)
            penalty.observe(crashes * last, last)
        signals.append(penalty.update(0.0)["safety/violation_road"])
    assert np.mean(signals[20:]) == pytest.approx(0.0, abs=0.1)
    single_crash = 150 / 3000 / 0.5  # in the two episodes of each environment that are remembered
    assert min(signals) == pytest.approx(-0.05 / single_crash, abs=0.05) and max(signals[20:]) == 1.0


def observe_in_step(penalty: AugmentedLagrangian, costs: list[float], n_envs: int, n_episodes: int) -> None:
    """All environments live through the same episode at the same time, whose end is its time limit."""
    for _ in range(n_episodes):
        for step, cost in enumerate(costs, start=1):
            last = np.full(n_envs, step == len(costs))
            penalty.observe(np.full(n_envs, cost), last, truncated=last)
            penalty.update(0.0)


@pytest.mark.parametrize("n_envs", [1, 4, 16])
@pytest.mark.parametrize(("cost", "rises"), [(1.0, True), (0.25, False)])
def test_the_signal_of_the_road_is_the_same_for_any_number_of_environments(n_envs: int, cost: float, rises: bool) -> None:
    """A cost near the end of long episodes, twice or half of the limit, would be missing in most shorter windows."""
    penalty = make_penalty(cost_limit=0.5, lagrangian_multiplier_init=10.0, episode_length=100, road_steps=200)
    observe_in_step(penalty, [0.0] * 95 + [cost] + [0.0] * 4, n_envs, n_episodes=12)
    assert (penalty.multiplier.item() > 12.0) == rises
    assert (penalty.multiplier.item() < 8.5) == (not rises)


def test_every_episode_has_a_cost_and_the_limit_allows_it() -> None:
    """Lengths count although no episode is cost-free: at 20 steps and a cost of .5 the limit of 1 is kept."""
    penalty = make_penalty(cost_limit=1.0, cost_gamma=0.97, episode_length=1000, road_steps=200)
    observe_in_step(penalty, [0.0] * 10 + [0.5] + [0.0] * 9, n_envs=2, n_episodes=100)
    assert penalty.episodes.expected_cost == pytest.approx(0.5, rel=0.05)
    assert penalty.budget == pytest.approx(discounted_budget(1.0, 0.97, 20, timeouts=1.0))
    assert penalty.multiplier.item() == pytest.approx(0.05)


@pytest.mark.parametrize(("gamma", "length"), [(0.97, 20), (0.99, 20), (0.9, 20)])
def test_critics_that_look_beyond_a_time_limit_are_right(gamma: float, length: int) -> None:
    """Every step costs 1 by the chance that is allowed, whatever is done: critics must say p / (1 - gamma)."""
    penalty, random = make_penalty(cost_limit=1.0, risk_level=1.0, cost_gamma=gamma), np.random.default_rng(0)
    hazard = 1.0 / length
    for step in range(1, 6001):
        penalty.note_prediction(th.full((4,), hazard / (1 - gamma)))
        last = np.full(4, step % length == 0)
        penalty.observe((random.random(4) < hazard).astype(float), last, truncated=last)
    assert penalty.budget == pytest.approx(hazard / (1 - gamma), rel=1e-5)
    assert penalty.calibration == pytest.approx(1.0, abs=0.15)


def test_long_episodes_with_a_cost_are_not_taken_for_short_ones() -> None:
    """Half of the episodes are short and free, half are long and cost 1: half a cost an episode."""
    record = EpisodeRecord(cost_gamma=0.9, episode_length=1000, window=50, road_steps=2200)
    for _ in range(40):
        drive(record, [0.0] * 20, done_every=20)
        drive(record, [0.0] * 100 + [1.0] + [0.0] * 99, done_every=200)
    assert record.expected_cost == pytest.approx(0.5, rel=0.1)


def test_a_strict_limit_does_not_wind_up_where_nothing_happens() -> None:
    """Critics never say exactly 0; where the road agrees with a limit of 0 that is no reason to grow."""
    penalty = make_penalty(cost_limit=0.0, cost_gamma=0.9, lagrangian_multiplier_init=2.0)
    observe_episodes(penalty, cost=0.0, n=400)
    penalty.note_prediction(th.full((4,), 0.002))
    for _ in range(1000):
        penalty.update(0.004)
    assert penalty.calibrated and penalty.multiplier.item() == 2.0


def test_combine_and_update_find_the_constrained_optimum() -> None:
    """
    Speed v is worth v, and ends an episode of 10 steps by a cost with the chance v^2.

    The best v with v^2 <= .16 is .4, and there the price of a cost is 1 / 2v = 1.25 (Karush, Kuhn, Tucker).
    """
    penalty = make_penalty(cost_limit=0.16, lambda_lr=0.02, episode_length=10, road_steps=2000, min_episodes=20)
    speed, rng, recent = th.tensor(0.9), np.random.default_rng(0), []
    for _ in range(4000):
        crashes = rng.random(20) < speed.item() ** 2
        for step in range(10):
            last = np.full(20, step == 9)
            penalty.observe(crashes * last, last)
        penalty.note_prediction(th.full((20,), speed.item() ** 2))
        penalty.update(speed.item() ** 2 - penalty.budget)
        speed.requires_grad_()
        (slope,) = th.autograd.grad(penalty.combine(-speed, speed**2, th.tensor(-1.0)), speed)
        speed = (speed - 0.05 * slope).clamp(0.01, 1.0).detach()
        recent.append((speed.item(), penalty.multiplier.item()))
    mean_speed, mean_multiplier = np.mean(recent[2000:], axis=0)
    assert mean_speed == pytest.approx(0.4, abs=0.03)
    assert mean_multiplier == pytest.approx(1.25, abs=0.15)


def test_multiplier_stays_above_its_lower_bound() -> None:
    penalty = make_penalty(lambda_lr=0.1)
    calibrate(penalty, 0.0)
    for _ in range(1000):
        penalty.update(-99.0)
    assert penalty.multiplier.item() == pytest.approx(0.05)


@pytest.mark.parametrize("violation", [1.0, 0.5])
def test_disagreement_holds_the_multiplier(violation: float) -> None:
    penalty = make_penalty()
    calibrate(penalty, 0.0)
    for _ in range(1000):
        logs = penalty.update(violation)
    assert (logs["safety/violation_model"], logs["safety/violation_road"]) == (violation, -1.0)
    assert penalty.multiplier.item() == 1.0
    assert penalty.mean_violation.item() == pytest.approx((violation - 1.0) / 2, abs=1e-3)


def test_steps_scale_with_gradient_steps() -> None:
    one, four = make_penalty(), make_penalty()
    for penalty in (one, four):
        calibrate(penalty, 5.0)
    for _ in range(4):
        one.update(0.5)
    four.update(0.5, gradient_steps=4)
    th.testing.assert_close(one.multiplier, four.multiplier)
    th.testing.assert_close(one.mean_violation, four.mean_violation)
    th.testing.assert_close(one.n_updates, four.n_updates)


def test_uncalibrated_critics_have_no_vote() -> None:
    penalty = make_penalty()
    assert "safety/violation_model" not in penalty.update(1.0)
    observe_episodes(penalty, cost=0.0)
    assert not penalty.calibrated
    penalty.note_prediction(th.full((3,), 99.0))
    assert penalty.calibration == pytest.approx(100.0) and not penalty.calibrated
    assert "safety/violation_model" not in penalty.update(1.0)
    for _ in range(21):
        penalty.note_prediction(th.zeros(3))
        observe_episodes(penalty, cost=0.0, n=1)
    assert penalty.calibrated and penalty.update(1.0)["safety/violation_model"] == 1.0


def test_few_episodes_have_no_vote() -> None:
    penalty = make_penalty(road_steps=100)
    observe_episodes(penalty, cost=9.0, n=18)
    penalty.note_prediction(th.tensor([9.0]))
    assert not penalty.calibrated
    assert "safety/violation_road" not in penalty.update(1.0)
    assert penalty.multiplier.item() == 1.0 and penalty.mean_violation.item() == 0.0
    observe_episodes(penalty, cost=9.0, n=10)
    assert penalty.update(1.0)["safety/violation_road"] == 1.0


def test_warm_up_and_missing_updates_hold_the_multiplier() -> None:
    penalty = make_penalty(penalty_warmup=10)
    calibrate(penalty, 5.0)
    for _ in range(20):
        penalty.update(None)
    for _ in range(10):
        penalty.update(1.0)
    assert penalty.multiplier.item() == 1.0
    penalty.update(1.0)
    assert penalty.multiplier.item() > 1.0


def test_an_episode_that_began_with_random_actions_is_never_remembered() -> None:
    record = EpisodeRecord(cost_gamma=0.5, episode_length=200, window=50, road_steps=10_000)
    record.pass_over(np.array([False, True]))
    for step in range(6):
        record.observe(np.array([0.0, 0.0]), np.array([step == 1, step == 3]))
    assert record.size == 1 and record.episode_length == 4, "two steps of an episode are not its length"
    record.observe(np.zeros(2), np.array([True, False]))
    assert record.size == 2 and record.episode_length == 4.5


def drive(record: EpisodeRecord, costs: list[float], done_every: int) -> None:
    """Observe one cost after another in one environment."""
    for step, cost in enumerate(costs, start=1):
        record.observe(np.array([cost]), np.array([step % done_every == 0]))


def test_road_signal_is_the_present_rate_over_an_episode_of_full_length() -> None:
    record = EpisodeRecord(cost_gamma=0.5, episode_length=10, window=50, road_steps=500)
    drive(record, [0.0, 0.0, 0.0, 0.0, 1.0] * 40, done_every=5)
    assert record.expected_cost == pytest.approx(2.0, rel=0.02)  # without a crash they would have lasted for ten steps
    assert record.tail_cost(0.5) == pytest.approx(record.expected_cost)  # all episodes alike: no tail
    drive(record, [0.0] * 20, done_every=20)
    assert record.episode_length == 20  # of the cost-free episodes, crashes do not shorten it
    drive(record, [0.0] * 500, done_every=20)
    assert record.expected_cost == 0.0  # what the agent did before is forgotten, and not by and by


def test_road_signal_of_rare_crashes_is_their_share_over_the_risk_level() -> None:
    record = EpisodeRecord(cost_gamma=0.5, episode_length=10, window=50, road_steps=10_000)
    drive(record, ([0.0] * 490 + [0.0] * 9 + [1.0]) * 10, done_every=10)
    assert record.tail_cost(1.0) == pytest.approx(0.02, rel=0.1)
    assert record.tail_cost(0.5) == pytest.approx(0.04, rel=0.1)


def test_calibration_compares_the_cost_to_come_on_the_same_states() -> None:
    """Costs 0, 1 at discount .5: .5 is to come at the first step, 1 at the second."""
    record = EpisodeRecord(cost_gamma=0.5, episode_length=10, window=50, road_steps=200)
    drive(record, [0.0, 1.0] * 50, done_every=2)
    assert record.calibration(1e-9) == pytest.approx(0.0, abs=1e-6)
    record.note_prediction(th.tensor([0.5, 1.0]))
    assert record.calibration(1e-9) == pytest.approx(1.0, rel=1e-4)


def test_calibration_is_of_the_present() -> None:
    """Critics that still expect the crashes of a policy that is gone must not be confirmed by them."""
    record = EpisodeRecord(cost_gamma=0.5, episode_length=10, window=50, road_steps=100)
    for cost in [1.0] * 100 + [0.0] * 100:
        record.note_prediction(th.ones(1))
        record.observe(np.array([cost]), np.array([True]))
    assert record.calibration(0.01) > 90


def test_a_loaded_record_forgets_as_the_saved_one_does() -> None:
    """Episodes of 8 environments are longer than ``road_steps``, and the window is longer, too."""
    records = [EpisodeRecord(cost_gamma=0.5, episode_length=50, window=50, road_steps=100) for _ in range(2)]
    for step in range(95):
        records[0].observe(np.full(8, 1.0 * (step < 50)), np.full(8, step % 50 == 49))
    records[1].load_state_dict(records[0].state_dict())
    for record in records:
        for _ in range(10):
            record.note_prediction(th.ones(8))
            record.observe(np.zeros(8), np.zeros(8, dtype=bool))
    assert records[0].expected_cost == records[1].expected_cost > 0


def test_another_number_of_environments() -> None:
    penalty = make_penalty()
    penalty.observe(np.ones(2), np.zeros(2, dtype=bool))
    penalty.observe(np.ones(3), np.array([True, False, True]))
    assert penalty.episodes.costs[:2].tolist() == [1.0, 1.0]


def update_silently(penalty: AugmentedLagrangian, times: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(times):
            penalty.update(1.0)


def test_warns_once_at_the_upper_bound() -> None:
    penalty = make_penalty(lagrangian_multiplier_init=50.0, episode_length=1)
    calibrate(penalty, 5.0)
    update_silently(penalty, 499)
    with pytest.warns(UserWarning, match="bound 50.0 for 500 .* still costs 5: cost_limit=1.0 looks infeasible"):
        penalty.update(1.0)
    update_silently(penalty, 600)


def test_a_multiplier_at_its_bound_is_no_infeasible_limit_where_the_road_is_content() -> None:
    penalty = make_penalty(lagrangian_multiplier_init=50.0, episode_length=1)
    calibrate(penalty, 0.5)
    update_silently(penalty, 499)
    with pytest.warns(UserWarning, match=r"bound 50.0 for 500 updates though an episode of 1 steps costs 0.5 of 1.0 allowed;"):
        penalty.update(1.0)
    observe_episodes(penalty, cost=5.0)
    penalty.note_prediction(th.full((100,), 5.0))
    with pytest.warns(UserWarning, match="an episode of 1 steps still costs 5: cost_limit=1.0 looks infeasible"):
        penalty.update(1.0)


def test_a_high_multiplier_below_its_bound_is_no_reason_to_warn() -> None:
    penalty = make_penalty(lagrangian_multiplier_init=49.0, lambda_lr=0.0)
    calibrate(penalty, 5.0)
    for _ in range(1000):
        penalty.update(1.0)


@pytest.mark.parametrize(("expected", "came"), [(0.0, 20.0), (20.0, 0.0)])
def test_warns_once_of_blind_critics(expected: float, came: float) -> None:
    """Costs happen and next to nothing is expected, or the reverse."""
    penalty = make_penalty()
    observe_episodes(penalty, came)
    penalty.note_prediction(th.full((4,), expected))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(499):
            penalty.update(-1.0)
    with pytest.warns(UserWarning, match=f"500 updates the cost critics have expected {expected:.3g} where {came:.3g} came"):
        penalty.update(-1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(600):
            penalty.update(-1.0)


@pytest.mark.parametrize(("expected", "came", "episodes"), [(1.0, 5.0, 50), (20.0, 3.0, 50), (0.0, 0.0, 50), (0.0, 5.0, 19)])
def test_critics_that_are_a_little_off_or_not_judged_yet_are_not_blind(expected: float, came: float, episodes: int) -> None:
    penalty = make_penalty()
    observe_episodes(penalty, came, n=episodes)
    penalty.note_prediction(th.full((4,), expected))
    for _ in range(1000):
        penalty.update(-1.0)


def test_critics_that_see_now_and_then_are_not_blind() -> None:
    penalty = make_penalty()
    for _ in range(4):
        observe_episodes(penalty, cost=20.0)
        penalty.note_prediction(th.zeros(4))
        for _ in range(400):
            penalty.update(-1.0)
        penalty.note_prediction(th.full((400,), 20.0))
        penalty.update(-1.0)


def test_state_dict_round_trip() -> None:
    penalty, loaded = make_penalty(), make_penalty()
    calibrate(penalty, 5.0)
    for _ in range(30):
        logs = penalty.update(1.0)
    state = penalty.state_dict()
    assert all(entry.dtype == th.float32 and entry.isfinite().all() for entry in state.values())
    loaded.load_state_dict(state)
    assert loaded.update(None) == penalty.update(None)
    assert loaded.calibrated and logs["lagrangian_multiplier"] == loaded.multiplier.item()


def test_survives_random_state() -> None:
    """SB3's save-and-load tests fill every entry with random numbers."""
    penalty = make_penalty(cost_gamma=0.9)
    penalty.load_state_dict({name: th.rand_like(entry) for name, entry in penalty.state_dict().items()})
    observe_episodes(penalty, cost=1.0, n=3)
    penalty.note_prediction(th.ones(2))
    assert np.isfinite(list(penalty.update(0.3).values())).all()
    penalty.load_state_dict({name: th.zeros_like(entry) for name, entry in penalty.state_dict().items()})
    assert np.isfinite(list(penalty.update(0.3).values())).all()


def test_no_penalty_ignores_everything() -> None:
    penalty = NoPenalty(cost_limit=None, risk_level=0.5)
    nan, objective = th.full((3,), th.nan), th.arange(3.0)
    assert penalty(nan).tolist() == [0.0, 0.0, 0.0]
    assert penalty.combine(objective, nan, nan) is objective
    assert penalty.admissible(nan, nan).all()
    penalty.observe(np.ones(2), np.ones(2))
    penalty.note_prediction(nan)
    assert penalty.update(float("nan"), gradient_steps=3) == {}
    assert len(penalty.state_dict()) == 0


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"cost_limit": -1.0}, "cost_limit is -1.0; choose"),
        ({"cost_limit": float("nan")}, "cost_limit is nan"),
        ({"risk_level": 0.0}, "risk_level is 0.0; choose"),
        ({"risk_level": 1.5}, "risk_level is 1.5; choose"),
        ({"cost_gamma": 1.5}, "cost_gamma is 1.5; choose"),
        ({"episode_length": 0}, "episode_length is 0; choose"),
        ({"penalty_coef": -1.0}, "penalty_coef is -1.0; choose"),
        ({"lambda_lr": -1.0}, "lambda_lr is -1.0; choose"),
        ({"barrier_coef": -1.0}, "barrier_coef is -1.0; choose"),
        ({"lagrangian_multiplier_init": 99.0}, "lagrangian_multiplier_init is 99.0; choose"),
        ({"multiplier_bounds": (2.0, 1.0)}, "one within 2.0 and 1.0"),
    ],
)
def test_refuses_impossible_settings(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_penalty(**kwargs)


def test_learned_coefficient_reaches_the_target_entropy() -> None:
    """A Gaussian policy that trades the entropy against a quadratic: its best variance is the coefficient."""
    coefficient = LearnedCoefficient(target_entropy=0.0, init=0.5, learning_rate=0.01)
    for _ in range(2000):
        variance = coefficient()
        logs = coefficient.update(-0.5 * (2 * th.pi * th.e * variance).log())
    assert logs["ent_coef"] == pytest.approx(1 / (2 * np.pi * np.e), rel=0.02)


@pytest.mark.parametrize(("entropy", "bound"), [(100.0, 1e-4), (-100.0, 1.0)])
def test_learned_coefficient_keeps_its_bounds(entropy: float, bound: float) -> None:
    coefficient = LearnedCoefficient(target_entropy=-1.0, init=0.1, learning_rate=0.1)
    for _ in range(300):
        coefficient.update(th.full((5,), -entropy))
    assert coefficient().item() == pytest.approx(bound, rel=1e-5)
    assert not coefficient().requires_grad


def test_make_entropy_coefficient() -> None:
    automatic, started, fixed = (make_entropy_coefficient(value, -2.0) for value in ("auto", "auto_0.1", 0.2))
    assert isinstance(automatic, LearnedCoefficient) and automatic().item() == pytest.approx(1.0)
    assert isinstance(started, LearnedCoefficient) and started().item() == pytest.approx(0.1)
    assert isinstance(fixed, FixedCoefficient) and fixed().item() == pytest.approx(0.2)
    assert fixed.update(th.zeros(3)) == {"ent_coef": pytest.approx(0.2)}
    assert make_entropy_coefficient("0.3", -2.0)().item() == pytest.approx(0.3)
    for module in (automatic, started, fixed):
        assert all(hasattr(module, name) for name in module.optimizer_names)


@pytest.mark.parametrize("value", ["automatic", "auto_x", "auto_7", "auto_-1", -0.1])
def test_refuses_unknown_coefficients(value: Any) -> None:
    with pytest.raises(ValueError, match=r"ent_coef is 5.0; choose it within its bounds 0.0001 and 1.0"):
        make_entropy_coefficient("auto_5", -1.0)
    with pytest.raises(ValueError, match=r"ent_coef is .*; choose"):
        make_entropy_coefficient(value, -1.0)
