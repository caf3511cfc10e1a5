"""The last word on the action: a filter whose judgement is known, and the drive that it changes."""

import copy
import math
import pickle
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.noise import NormalActionNoise

from sb3_esad import ADEND, ESADLEND
from sb3_esad.common.agent import LatentAgent
from sb3_esad.common.foresight import Foresight, Outlook
from sb3_esad.common.functional import barrier_residual
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.penalties import NoPenalty
from sb3_esad.common.selection import ActionFilter, NoFilter, SafetyFilter, Selection, SelectionRates
from sb3_esad.common.type_aliases import Belief, Imagination, LatentState, Predictions
from tests.conftest import TINY, CountingEnv

BUDGET_SCALE = AugmentedLagrangian(cost_limit=0.05).budget_scale


class Known(Foresight):
    """An action a is worth a and as risky as (a - calm)^2, more in vague worlds; where it leads to all is as before."""

    def __init__(self, calm: float) -> None:
        super().__init__(steps=1, gamma=0.9, cost_gamma=0.9, risk_level=0.5, barrier_decay=0.3)
        self.calm = calm

    def imagine(self, agent: LatentAgent, start: LatentState) -> Imagination:
        stays, nothing = agent.world_model.features(start)[None], th.zeros(1, len(start.action))
        return Imagination(stays, start.action[None], Predictions(nothing, nothing, nothing), nothing)

    def outlook(self, agent: LatentAgent, imagined: Imagination) -> Outlook:
        risks = self.risk(agent, imagined.grids[0], imagined.actions[0])
        return Outlook(risks, risks, risks)

    def values(self, agent: LatentAgent, imagined: Imagination) -> th.Tensor:
        return imagined.actions[0, :, 0]

    def at(self, action: th.Tensor) -> th.Tensor:
        return (action - self.calm).square()

    def risk(self, agent: LatentAgent, grids: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self.at(actions[:, 0]) * grids[:, 0, 0, 0]


@pytest.fixture
def agent() -> LatentAgent:
    return ESADLEND("MlpPolicy", CountingEnv(), **TINY).policy.average


def belief(agent: LatentAgent, n: int) -> Belief:
    state = agent.world_model.initial(n)
    return Belief(state._replace(memory=th.ones_like(state.memory)), th.zeros(n, 8, 1, 1))


class Trusting(AugmentedLagrangian):
    """Finds all critics calibrated."""

    calibrated = True


def make_filter(calm: float, cost_limit: float = 0.05, filter_start: int = 0, **settings: Any) -> SafetyFilter:
    return SafetyFilter(Trusting(cost_limit), filter_start, Known(calm), risk_level=0.5, **settings)


def test_what_is_admissible_is_executed_as_it_is(agent: LatentAgent) -> None:
    proposed = 0.2 + 0.9 * math.sqrt(BUDGET_SCALE) * th.tensor([[-1.0], [0.5], [1.0]])
    selection = make_filter(calm=0.2).select(agent, belief(agent, 3), proposed)
    assert th.equal(selection.actions, proposed)
    assert not selection.intervened.any() and not selection.helpless.any()
    th.testing.assert_close(selection.risks, Known(0.2).at(proposed[:, 0]))


@pytest.mark.parametrize("cost_limit", [0.0, 0.05])
def test_a_steady_risk_within_the_scale_of_the_budget_is_admissible(agent: LatentAgent, cost_limit: float) -> None:
    """The barrier must not be stricter than the limit itself, which under a limit of 0 would refuse everything."""
    safety = make_filter(calm=0.2, cost_limit=cost_limit)
    scale = AugmentedLagrangian(cost_limit).budget_scale
    proposed = 0.2 + th.tensor([[0.95], [1.05]]) * math.sqrt(scale)
    assert safety.select(agent, belief(agent, 2), proposed).intervened.tolist() == [False, True]


class Rising(Known):
    """Little risk now, more of it soon."""

    def __init__(self, soon: float) -> None:
        super().__init__(calm=0.0)
        self.soon = soon

    def outlook(self, agent: LatentAgent, imagined: Imagination) -> Outlook:
        little = th.full_like(imagined.actions[0, :, 0], 0.5 * BUDGET_SCALE)
        return Outlook(little, little, th.full_like(little, self.soon * BUDGET_SCALE))


@pytest.mark.parametrize(("soon", "refused"), [(0.6, False), (0.64, False), (0.66, True), (1.0, True)])
def test_an_action_whose_risk_rises_too_fast_is_refused(agent: LatentAgent, soon: float, refused: bool) -> None:
    """h = Gamma - d_s may move by .3 of its distance to 0: from .5 to .5 + .3 x .5 = .65."""
    safety = SafetyFilter(Trusting(0.05), 0, Rising(soon), risk_level=0.5)
    assert safety.select(agent, belief(agent, 3), th.zeros(3, 1)).helpless.tolist() == 3 * [refused]


def test_only_what_is_not_admissible_is_replaced_by_the_best_that_is(agent: LatentAgent) -> None:
    proposed = th.tensor([[0.2], [-0.9]])
    selection = make_filter(calm=0.2).select(agent, belief(agent, 2), proposed)
    assert selection.intervened.tolist() == [False, True] and not selection.helpless.any()
    assert selection.actions[0] == proposed[0]
    assert Known(0.2).at(selection.actions[1]) <= BUDGET_SCALE


def test_the_choice_is_that_of_brute_force(agent: LatentAgent) -> None:
    n = 6
    safety = make_filter(calm=0.2)
    seen = belief(agent, n)
    th.manual_seed(3)
    others = safety._proposals(agent, seen.state)
    assert others.shape == (4, n, 1)
    th.manual_seed(3)
    scenarios, proposed = seen.state.map(lambda field: field[None]), th.full((n, 1), -0.9)
    own, _ = safety.assess(agent, scenarios, proposed[None])
    actions, helpless = safety._choose(agent, scenarios, seen.state, proposed, own.risks)
    for state in range(n):
        candidates = [-0.9, *others[:, state, 0].tolist()]
        admissible = [a for a in candidates if (a - 0.2) ** 2 <= BUDGET_SCALE]
        expected = max(admissible) if admissible else min(candidates, key=lambda a: (a - 0.2) ** 2)
        assert actions[state].item() == pytest.approx(expected)
        assert helpless[state].item() == (not admissible)


def test_where_nothing_is_admissible_the_least_risk_is_taken(agent: LatentAgent) -> None:
    safety = make_filter(calm=5.0)
    selection = safety.select(agent, belief(agent, 4), th.zeros(4, 1))
    assert selection.helpless.all() and selection.intervened.all()
    assert (selection.actions > 0.5).all()  # the highest of 16 uniform actions, at least


@pytest.mark.parametrize(("risk_level", "expected"), [(0.25, 4.0), (0.5, 3.5), (0.6, 3.0), (1.0, 2.5)])
def test_an_action_is_as_risky_as_in_its_worst_scenarios(agent: LatentAgent, risk_level: float, expected: float) -> None:
    safety = SafetyFilter(Trusting(0.05), 0, Known(0.0), risk_level, n_candidates=4)
    state = agent.world_model.initial(2).map(lambda field: field.expand(4, *field.shape))
    vague = th.tensor([[3.0, 1.0, 4.0, 2.0], [10.0, 20.0, 30.0, 40.0]]).T
    scenarios = state._replace(memory=state.memory + vague[..., None, None, None])
    outlook, _ = safety.assess(agent, scenarios, th.ones(3, 2, 1))
    th.testing.assert_close(outlook.risks, th.tensor([expected, 10 * expected]).expand(3, 2))


class Sided(Known):
    """In some worlds only what is done to the right is dangerous, in the others only what is done to the left."""

    def risk(self, agent: LatentAgent, grids: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return (actions[:, 0] * grids[:, 0, 0, 0]).relu()


def test_each_action_has_its_own_worst_scenarios(agent: LatentAgent) -> None:
    safety = SafetyFilter(Trusting(0.05), 0, Sided(0.0), risk_level=0.5, n_candidates=4)
    state = agent.world_model.initial(1).map(lambda field: field.expand(4, *field.shape))
    side = th.tensor([1.0, -1.0, 1.0, -1.0]).view(4, 1, 1, 1, 1)
    actions = th.tensor([[[0.9]], [[-0.8]], [[0.0]]])
    outlook, _ = safety.assess(agent, state._replace(memory=state.memory + side), actions)
    th.testing.assert_close(outlook.risks, th.tensor([[0.9], [0.8], [0.0]]))


@pytest.mark.parametrize("passive", [NoFilter(), make_filter(calm=5.0, filter_start=1)])
def test_a_filter_that_is_not_to_be_trusted_changes_nothing(agent: LatentAgent, passive: ActionFilter) -> None:
    proposed = 2 * th.rand(4, 1) - 1
    selection = passive.select(agent, belief(agent, 4), proposed)
    assert th.equal(selection.actions, proposed) and not selection.intervened.any() and not selection.judged.any()


def test_without_a_limit_everything_is_admissible(agent: LatentAgent) -> None:
    safety = SafetyFilter(NoPenalty(), 0, Known(5.0), risk_level=0.5)
    proposed = 2 * th.rand(4, 1) - 1
    assert th.equal(safety.select(agent, belief(agent, 4), proposed).actions, proposed)


@pytest.mark.parametrize("risk_level", [0.5, 1.0])
def test_foresight_is_what_model_and_critics_say(agent: LatentAgent, risk_level: float) -> None:
    """One imagined step by hand; the prior is made certain, so that it is the same each time."""
    agent.world_model.rssm.head.prior_net[1].bias.data[4:] = -100.0
    state = agent.world_model.initial(3)._replace(action=2 * th.rand(3, 1) - 1)
    foresight = Foresight(steps=1, gamma=0.9, cost_gamma=0.8, risk_level=risk_level, barrier_decay=0.3)
    th.manual_seed(0)
    imagined = foresight.imagine(agent, state)
    outlook, values = foresight.outlook(agent, imagined), foresight.values(agent, imagined)
    th.manual_seed(0)
    grid = agent.world_model.features(agent.world_model.rssm.imagine(state))
    rewards, costs, continues = (field[0] for field in agent.world_model.predict(grid[None]))
    action = agent.actor(grid, deterministic=True)
    th.testing.assert_close(values, rewards + 0.9 * continues * agent.critic(grid, action).min(0).values)
    means, end_variance = agent.cost_critic(grid, action)
    _, variance = agent.cost_critic(agent.world_model.features(state), state.action)
    to_come = costs + 0.8 * continues * means.max(0).values
    th.testing.assert_close(outlook.risks, agent.cost_critic.risk(to_come[None], variance, risk_level))
    th.testing.assert_close(outlook.next_risks, continues * agent.cost_critic.risk(means, end_variance, risk_level))
    means, _ = agent.cost_critic(agent.world_model.features(state), state.action)
    th.testing.assert_close(outlook.critic_risks, agent.cost_critic.risk(means, variance, risk_level))
    expected = barrier_residual(outlook.next_risks, outlook.critic_risks, 0.1, 0.3)
    th.testing.assert_close(foresight.barrier(outlook, 0.1), expected)


class Always(ActionFilter):
    """Executes the same action whatever is proposed."""

    def __init__(self, **settings: Any) -> None:
        pass

    def select(self, agent: LatentAgent, belief: Belief, proposed: th.Tensor) -> Selection:
        replaced = th.ones(len(proposed), dtype=th.bool)
        return Selection(th.full_like(proposed, 0.25), replaced, ~replaced, th.zeros(len(proposed)))


class Obstinate(ESADLEND):
    filter_class = Always


def test_what_is_executed_is_stored_remembered_and_counted() -> None:
    model = Obstinate("MlpPolicy", CountingEnv(), **TINY, filter_start=0).learn(30)
    actions = model.replay_buffer.actions[:30, 0, 0]
    assert (actions[:20] != 0.25).all() and (actions[20:] == 0.25).all()
    assert model._last_latent is not None and (model._last_latent.action == 0.25).all()
    assert model.predict(np.zeros(1, dtype=np.float32))[0] == 0.25
    assert model._selections.take() == {"filter_rate": 1.0, "intervention_rate": 1.0, "fallback_rate": 0.0}
    assert model._selections.take() == {}


def test_nothing_is_filtered_without_a_limit_or_a_filter() -> None:
    for model in (
        ESADLEND("MlpPolicy", CountingEnv(), **TINY, cost_limit=None, filter_start=0),
        ESADLEND("MlpPolicy", CountingEnv(), **TINY),
        ADEND("MlpPolicy", CountingEnv(), **TINY, filter_start=0),
    ):
        assert isinstance(model.policy.action_filter, NoFilter)


class Proposing(Always):
    """Executes what is proposed, and remembers it."""

    seen: ClassVar[list[float]] = []

    def select(self, agent: LatentAgent, belief: Belief, proposed: th.Tensor) -> Selection:
        self.seen.append(proposed.item())
        return NoFilter().select(agent, belief, proposed)


class Noticing(ESADLEND):
    filter_class = Proposing


def test_noise_is_added_before_the_filter() -> None:
    """Or it would make an admissible action one that is not."""
    noise = NormalActionNoise(np.full(1, 5.0), np.zeros(1))
    Proposing.seen.clear()
    Noticing("MlpPolicy", CountingEnv(), **TINY, filter_start=0, action_noise=noise).learn(30)
    assert len(Proposing.seen) >= 10 and set(Proposing.seen) == {1.0}


def test_the_filter_waits_for_updates_and_for_critics_that_can_be_trusted(agent: LatentAgent) -> None:
    penalty = Trusting(0.05)
    safety = SafetyFilter(penalty, 5, Known(5.0), risk_level=0.5)
    for updates, calibrated, active in ((4, True, False), (5, True, True), (5, False, False)):
        penalty.n_updates.fill_(updates)
        penalty.calibrated = calibrated
        assert safety.select(agent, belief(agent, 1), th.zeros(1, 1)).judged.item() == active


def test_a_copy_of_the_policy_leaves_the_algorithm_alone() -> None:
    model = ESADLEND("MlpPolicy", CountingEnv(), **TINY, filter_start=0)
    copied: dict[int, Any] = {}
    copy.deepcopy(model.policy, copied)
    assert id(model.policy.action_filter) in copied and id(model) not in copied


def test_predictions_by_a_filter_are_the_same_again_and_after_loading(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(AugmentedLagrangian, "calibrated", True)
    model = ESADLEND("MlpPolicy", CountingEnv(), **TINY, filter_start=0, cost_limit=0.0).learn(30)
    observations = np.random.rand(5, 1).astype(np.float32)
    first, _ = model.predict(observations, deterministic=True)
    th.rand(7)  # other random numbers in between change nothing
    model.save(tmp_path / "model")
    again, _ = model.predict(observations, deterministic=True)
    loaded, _ = ESADLEND.load(tmp_path / "model").predict(observations, deterministic=True)
    np.testing.assert_array_equal(first, again)
    np.testing.assert_allclose(first, loaded, rtol=1e-6)
    agent, starts = model.policy.average, th.ones(5, dtype=th.bool)
    seen = agent.observe(th.as_tensor(observations), model.policy.initial_state(5), starts, True)
    assert not np.allclose(first, agent.act(seen.state, True).numpy()), "the filter has not intervened"
    alone = [model.predict(observation, deterministic=True)[0] for observation in observations]
    np.testing.assert_allclose(first, np.stack(alone), rtol=1e-5)


def test_rates_are_shares_of_all_actions_and_take_no_more_room_the_longer_they_are_noted() -> None:
    rates, sizes = SelectionRates(), []
    intervened, helpless = th.tensor([True, True, False, False]), th.tensor([True, False, False, False])
    risks = th.tensor([0.1, 0.1, 0.0, math.nan])
    for _ in range(2):
        for _ in range(100):
            rates.note(Selection(th.zeros(4, 1), intervened, helpless, risks))
        sizes.append(len(pickle.dumps(rates)))
    assert sizes[0] == sizes[1]
    assert rates.take() == {"filter_rate": 0.75, "intervention_rate": 0.5, "fallback_rate": 0.25}
