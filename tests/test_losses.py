"""What counts how much in the losses of actor and critics: by weights, coefficients, discounts and scale that differ."""

from typing import Any

import pytest
import torch as th

from sb3_esad import ESADLEND
from sb3_esad.common.critics import CostTargets
from sb3_esad.common.functional import rising_cvar
from sb3_esad.common.imagined_returns import imagined_returns, taken
from sb3_esad.common.selection import SafetyFilter
from sb3_esad.common.type_aliases import Imagination
from sb3_esad.esad_lend.targets import Transitions, recorded_transitions
from tests.conftest import TINY, CountingEnv


def make_model(**settings: Any) -> ESADLEND:
    return ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, **settings}).learn(24)


def trajectories(model: ESADLEND) -> tuple[Imagination, Transitions]:
    """Imagined and recorded ones, every one of which has another weight."""
    samples = model._sample(4)
    with th.no_grad():
        filtered = model.policy.world_model.observe(samples, th.zeros_like(samples.rewards.T, dtype=th.bool))
        imagined = model._imagine(samples, filtered)
    recorded = recorded_transitions(model.policy, samples, filtered)
    weights = th.linspace(0.1, 1.0, imagined.weights.numel()).view_as(imagined.weights)
    event_weights = th.linspace(0.2, 2.0, recorded.event_weights.numel())
    return imagined._replace(weights=weights), recorded._replace(event_weights=event_weights)


def steps_of(model: ESADLEND, monkeypatch: pytest.MonkeyPatch) -> dict[str, float]:
    """What is minimised, by the name of the network, which stays as it is."""
    losses: dict[str, float] = {}
    monkeypatch.setattr(model, "_step", lambda name, loss: losses.update({name: loss.item()}))
    return losses


def weighted(weights: th.Tensor, losses: th.Tensor) -> float:
    """Mean of all losses by their weights."""
    return float(weights.flatten().double() @ losses.detach().flatten().double()) / losses.numel()


def test_loss_of_the_critics(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(replay_critic_coef=0.7)
    (imagined, recorded), losses = trajectories(model), steps_of(model, monkeypatch)
    critic, target = model.policy.critic, model.policy.critic_target
    with th.no_grad():
        targets = imagined_returns(target, imagined, model.gamma, model.lambda_return)
        dreamed = critic.loss(*taken(imagined), targets.flatten())
        rewards, _, continues = recorded.outcomes
        one_step = rewards + model.gamma * continues * target(recorded.next_grids, recorded.next_actions).min(0).values
        anchored = critic.loss(recorded.grids, recorded.actions, one_step)
    model._update_critic(imagined, recorded)
    expected = weighted(imagined.weights, dreamed) + 0.7 * weighted(recorded.event_weights, anchored)
    assert losses["critic"] == pytest.approx(expected, rel=1e-4)


def test_the_scale_follows_the_imagined_returns(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model()
    (imagined, recorded), _ = trajectories(model), steps_of(model, monkeypatch)
    rewards = th.linspace(0.0, 900.0, imagined.weights.numel()).view_as(imagined.weights)
    imagined = imagined._replace(predictions=imagined.predictions._replace(rewards=rewards))
    model.policy.critic.scale.fill_(2.0)
    model._update_critic(imagined, recorded)
    returns = imagined_returns(model.policy.critic_target, imagined, model.gamma, model.lambda_return)
    low, high = th.quantile(returns, th.tensor([0.05, 0.95])).tolist()
    assert model.policy.critic.scale.item() == pytest.approx(2.0 + 0.01 * (high - low - 2.0), rel=1e-4) != 2.0


def test_loss_of_the_cost_critics(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a look ahead what is to come is the cost of the step itself; rewards look ahead all the same."""
    model = make_model(cost_gamma=0.0, replay_cost_critic_coef=3.0)
    (imagined, recorded), losses = trajectories(model), steps_of(model, monkeypatch)
    critic, seen = model.policy.cost_critic, list[CostTargets]()
    measure = critic.loss

    def watch(grids: th.Tensor, actions: th.Tensor, means: th.Tensor, variances: th.Tensor) -> Any:
        seen.append(CostTargets(means, variances))
        return measure(grids, actions, means, variances)

    monkeypatch.setattr(critic, "loss", watch)
    model._update_cost_critic(imagined, recorded)
    dreamed, came = seen
    th.testing.assert_close(dreamed.means, imagined.predictions.costs.flatten())
    costs = recorded.outcomes.costs.view_as(recorded.followed).T
    th.testing.assert_close(came.means.view_as(recorded.followed).T, costs)
    with th.no_grad():
        imagined_losses = sum(measure(*taken(imagined), *dreamed))
        recorded_losses = sum(measure(recorded.grids, recorded.actions, *came))
    expected = weighted(imagined.weights, imagined_losses) + 3.0 * weighted(recorded.event_weights, recorded_losses)
    assert losses["cost_critic"] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_the_actor_sees_returns_at_their_scale(scale: float, monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(cost_limit=None, ent_coef=0.0)
    (imagined, _), losses = trajectories(model), steps_of(model, monkeypatch)
    model.policy.critic.scale.fill_(scale)
    model._update_actor(imagined)
    returns = imagined_returns(model.policy.critic, imagined, model.gamma, model.lambda_return)
    assert losses["actor"] == pytest.approx(-weighted(imagined.weights, returns) / scale, rel=1e-4)


def test_the_risk_looks_as_far_ahead_as_the_cost_and_not_as_the_return() -> None:
    model = make_model(cost_gamma=0.0)
    imagined, _ = trajectories(model)
    costs = imagined.predictions.costs
    with th.no_grad():
        _, variances = model.policy.cost_critic(*taken(imagined))
        risk = rising_cvar(costs, variances.view_as(costs), model.risk_level)
        th.testing.assert_close(model._imagined_risk(imagined), risk)


def test_the_filter_looks_as_far_ahead_as_cost_and_return() -> None:
    model = make_model(gamma=0.9, cost_gamma=0.3, filter_start=0)
    assert isinstance(model.policy.action_filter, SafetyFilter)
    foresight = model.policy.action_filter.foresight
    assert (foresight.gamma, foresight.cost_gamma) == (0.9, 0.3)
