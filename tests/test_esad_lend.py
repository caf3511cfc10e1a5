"""ESAD-LEND: each update moves one network only, what is executed is what is remembered, costs are kept account of."""

import inspect
from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_esad import ESADLEND
from sb3_esad.common.agent import LatentAgent
from sb3_esad.common.functional import barrier_residual, discounted_budget
from sb3_esad.common.latent_algorithm import FALLING_RATE
from sb3_esad.common.latents import Gaussian
from sb3_esad.common.multipliers import AugmentedLagrangian
from sb3_esad.common.optimizers import MuonWithAdam
from sb3_esad.common.penalties import NoPenalty
from sb3_esad.common.policies import LatentPolicy
from sb3_esad.common.precision import autocast
from sb3_esad.common.rssm import Filtered
from sb3_esad.common.target_networks import make_target
from sb3_esad.common.type_aliases import Belief, Imagination, LatentState, Predictions, SequenceSamples
from sb3_esad.esad_lend.targets import recorded_transitions
from tests.conftest import TINY, CountingEnv

NETWORKS = ("world_model", "actor", "critic", "cost_critic")


class FreeEnv(CountingEnv):
    """Nothing costs."""

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, _ = super().step(action)
        return obs, reward, terminated, truncated, {"cost": 0.0}


class RecordingEnv(CountingEnv):
    """Remembers the actions it was given."""

    action_space = spaces.Box(np.array([-3.0, 0.0], np.float32), np.array([5.0, 1.0], np.float32))

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.actions: list[np.ndarray] = []

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.actions.append(np.array(action))
        return super().step(action)


def make_model(env: gym.Env | VecEnv | None = None, **kwargs: Any) -> ESADLEND:
    return ESADLEND("MlpPolicy", env or CountingEnv(), **{**TINY, **kwargs})


def imagine(model: ESADLEND) -> tuple[SequenceSamples, Filtered, Imagination]:
    """Draw recorded windows, filter them and imagine from there."""
    samples = model._sample(4)
    with th.no_grad():
        _, filtered, _ = model.policy.world_model.loss(samples)
    return samples, filtered, model._imagine(samples, filtered)


def moved(model: ESADLEND, before: dict[str, th.Tensor]) -> set[str]:
    """Networks that are not as they were."""
    return {name.split(".")[0] for name, value in model.policy.state_dict().items() if not th.equal(value, before[name])}


def expected_cost(model: ESADLEND) -> float:
    """Mean over recorded steps."""
    samples, filtered, _ = imagine(model)
    recorded = recorded_transitions(model.policy, samples, filtered)
    means, _ = model.policy.cost_critic_target(recorded.grids, recorded.actions)
    return means.mean().item()


def with_gradient(model: ESADLEND) -> set[str]:
    return {
        name
        for name, network in model.policy.named_children()
        if any(parameter.grad is not None for parameter in network.parameters())
    }


def forget_gradients(model: ESADLEND) -> None:
    for parameter in model.policy.parameters():
        parameter.grad = None


@pytest.mark.parametrize("settings", [{"batch_size": 1, "sequence_length": 1}, {"imagination_starts": 2}])
def test_the_smallest_batches_will_do(settings: dict[str, Any]) -> None:
    model = make_model(**settings).learn(32)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    assert np.isfinite(model.logger.name_to_value["train/cvar"])


def test_each_update_moves_one_network() -> None:
    model = make_model().learn(24)
    samples, filtered, imagined = imagine(model)
    recorded = recorded_transitions(model.policy, samples, filtered)
    updates = {
        "world_model": lambda: model._update_world_model(samples),
        "critic": lambda: model._update_critic(imagined.detach(), recorded),
        "cost_critic": lambda: model._update_cost_critic(imagined.detach(), recorded),
        "actor": lambda: model._update_actor(imagine(model)[2]),
    }
    for name, update in updates.items():
        forget_gradients(model)
        before = {each: th.nn.utils.parameters_to_vector(getattr(model.policy, each).parameters()) for each in NETWORKS}
        update()
        assert with_gradient(model) == {name}
        for each, vector in before.items():
            same = th.equal(vector, th.nn.utils.parameters_to_vector(getattr(model.policy, each).parameters()))
            assert same == (each != name)


def test_cost_critics_learn_what_a_policy_costs_that_stays(tmp_path: Path) -> None:
    """After 3 and 6 of 7 steps, whatever is done, comes a cost: at a discount of .5 on average .53 to come."""
    env = CountingEnv()
    trained = make_model(env, cost_gamma=0.5).learn(40)
    trained.save(tmp_path / "model.zip")
    trained.save_replay_buffer(tmp_path / "buffer.pkl")
    model = ESADLEND.load(tmp_path / "model.zip", env)
    model.load_replay_buffer(tmp_path / "buffer.pkl")
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.fit_cost_critic(200, learning_rate=0.005)
    assert moved(model, before) == {"cost_critic", "cost_critic_target"}
    assert expected_cost(model) == pytest.approx(0.53, abs=0.1)


class Normalising(FlattenExtractor):
    """Follows the batches that it sees."""

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(observation_space)
        self.norm = th.nn.BatchNorm1d(self.features_dim)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.norm(super().forward(observations))  # type: ignore[no-any-return]


def test_statistics_of_the_model_stay_where_the_cost_critics_learn() -> None:
    model = make_model(policy_kwargs={**TINY["policy_kwargs"], "features_extractor_class": Normalising}).learn(40)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.fit_cost_critic(2)
    assert moved(model, before) == {"cost_critic", "cost_critic_target"}


@pytest.mark.parametrize(("imagined_coef", "expected"), [(1.0, 0.27), (100.0, 0.0)])
def test_imagined_costs_count_by_their_weight_where_critics_are_fitted(
    monkeypatch: pytest.MonkeyPatch, imagined_coef: float, expected: float
) -> None:
    """The world model imagines that every episode ends at once, without a cost; recorded are .53, as above."""
    model = make_model(cost_gamma=0.5).learn(40)
    imagine_costs = model._imagine

    def imagine_safety(samples: SequenceSamples, filtered: Filtered) -> Imagination:
        imagined = imagine_costs(samples, filtered)
        nothing = th.zeros_like(imagined.predictions.costs)
        return imagined._replace(predictions=imagined.predictions._replace(costs=nothing, continues=nothing))

    monkeypatch.setattr(model, "_imagine", imagine_safety)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    model.fit_cost_critic(200, learning_rate=0.005, imagined_coef=imagined_coef)
    assert moved(model, before) == {"cost_critic", "cost_critic_target"}
    assert expected_cost(model) == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize(("name", "value"), [("gradient_steps", 0), ("imagined_coef", -1.0), ("replay_lambda", 1.5)])
def test_fitting_needs_arguments_in_their_range(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=f"{name} is {value}; choose"):
        make_model().fit_cost_critic(**{"gradient_steps": 1, name: value})


def test_cost_critics_that_have_never_learned_make_room_for_several_costs() -> None:
    model = make_model(cost_gamma=0.5).learn(19)
    model.learning_starts = 10
    model.fit_cost_critic(1)
    assert model._n_updates == 0 and model.policy.cost_critic_target.bound.item() == 2.0


def test_cost_critics_need_something_to_learn_from() -> None:
    with pytest.raises(ValueError, match=r"replay_buffer.size\(\) is 0; choose 20 steps or more to learn from"):
        make_model().fit_cost_critic(1)


def test_critics_do_not_learn_through_the_dream() -> None:
    model = make_model().learn(24)
    samples, filtered, imagined = imagine(model)
    given: list[th.Tensor] = []
    critic: Any = model.policy.critic
    loss = critic.loss
    critic.loss = lambda *args: given.extend(args) or loss(*args)
    model._update_behavior(samples, filtered, imagined)
    assert any(field.requires_grad for field in (imagined.grids, imagined.actions, *imagined.predictions))
    assert given and not any(argument.requires_grad for argument in given)


def test_a_network_that_has_just_learned_is_seen_as_it_is() -> None:
    """Autocast keeps copies of the weights, which the next network would be improved by."""
    layer: Any = th.nn.Linear(4, 4)
    layer.optimizer = MuonWithAdam(layer.parameters(), lr=0.5)
    model = make_model()
    model.policy.actor, model.policy.actor_target = layer, make_target(layer)
    with autocast(th.device("cpu")):
        before = layer(th.ones(1, 4))
        model._step("actor", before.sum())
        assert not th.equal(layer(th.ones(1, 4)), before)


def test_predictions_are_those_of_the_averages() -> None:
    model = make_model(tau=0.25).learn(24)
    network, target = model.policy.world_model, model.policy.world_model_target
    before = [parameter.clone() for parameter in target.parameters()]
    model._update_world_model(model._sample(4))
    for old, average, learned in zip(before, target.parameters(), network.parameters(), strict=True):
        th.testing.assert_close(average, 0.75 * old + 0.25 * learned)
    observation = np.array(model.observation_space.sample())
    expected, _ = model.predict(observation, deterministic=True)
    for learner in (network, model.policy.actor):
        for parameter in learner.parameters():
            th.nn.init.constant_(parameter, th.nan)
    np.testing.assert_array_equal(model.predict(observation, deterministic=True)[0], expected)


def test_only_what_learns_is_in_training_mode() -> None:
    policy = make_model().policy
    policy.set_training_mode(True)
    for name in ("world_model", "actor", "critic", "cost_critic"):
        assert getattr(policy, name).training and not getattr(policy, f"{name}_target").training


def test_the_rate_is_the_third_argument_as_everywhere_in_sb3() -> None:
    settings = {name: value for name, value in TINY.items() if name != "learning_rate"}
    model = ESADLEND("MlpPolicy", CountingEnv(), 0.5, **settings)
    assert model.policy.actor.optimizer.param_groups[0]["lr"] == 0.5 and model.cost_limit == 0.05


def test_the_rate_is_held_and_falls_to_zero() -> None:
    assert [FALLING_RATE(progress) for progress in (1.0, 0.5, 0.25, 0.0, -0.1)] == pytest.approx([0.006, 0.006, 0.003, 0, 0])
    model = make_model(learning_rate=FALLING_RATE, min_cost_critic_rate=0.0)
    assert inspect.signature(ESADLEND.__mro__[1]).parameters["learning_rate"].default is FALLING_RATE
    assert {group["lr"] for each in model._optimizers().values() for group in each.param_groups} == {0.006}
    model.learn(40)
    model.train(1, 4)
    assert max(group["lr"] for each in model._optimizers().values() for group in each.param_groups) == pytest.approx(
        0, abs=1e-9
    )


@pytest.mark.parametrize("uniform", [0.0, 1.0])
def test_a_random_first_action_owes_nothing_to_the_actor(uniform: float) -> None:
    model = make_model(uniform_action_prob=uniform)
    model._first_actions(model.policy.initial_state(5)).sum().backward()
    gradients = [parameter.grad for parameter in model.policy.actor.parameters() if parameter.grad is not None]
    assert any(gradient.any() for gradient in gradients) == (uniform == 0.0)


def test_targets_follow_slowly() -> None:
    model = make_model(tau=0.25).learn(24)
    policy = model.policy
    pairs = [(policy.critic, policy.critic_target), (policy.cost_critic, policy.cost_critic_target)]
    old = [[parameter.clone() for parameter in target.parameters()] for _, target in pairs]
    model._update_behavior(*imagine(model))
    for (network, target), parameters in zip(pairs, old, strict=True):
        for new, moved, before in zip(network.parameters(), target.parameters(), parameters, strict=True):
            th.testing.assert_close(moved, 0.75 * before + 0.25 * new)


def test_critics_do_not_learn_through_their_own_targets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise they would move what is to come towards what they expect now."""
    model = make_model().learn(24)
    learned: list[bool] = []
    for critic in (model.policy.critic, model.policy.cost_critic):

        def spy(grid: th.Tensor, action: th.Tensor, *targets: th.Tensor, loss: Any = critic.loss) -> Any:
            learned.extend(target.requires_grad for target in targets)
            return loss(grid, action, *targets)

        monkeypatch.setattr(critic, "loss", spy)
    model._update_behavior(*imagine(model))
    assert learned == [False] * 6


def test_critics_bootstrap_from_their_averages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the networks that learn expect of what is to come, their targets do not depend on it."""
    model = make_model().learn(24)
    samples, filtered, imagined = imagine(model)
    critics = (model.policy.critic, model.policy.cost_critic)
    targets: list[th.Tensor] = []
    for critic in critics:

        def spy(grid: th.Tensor, action: th.Tensor, *given: th.Tensor, loss: Any = critic.loss) -> Any:
            targets.extend(given)
            return loss(grid, action, *given)

        monkeypatch.setattr(critic, "loss", spy)
    monkeypatch.setattr(model, "_step", lambda name, loss: 0.0)
    for offset in (0.0, 5.0):
        with th.no_grad():
            for parameter in [each for critic in critics for each in critic.parameters()]:
                parameter += offset
        th.manual_seed(0)
        model._update_behavior(samples, filtered, imagined)
    for before, after in zip(targets[:6], targets[6:], strict=True):
        th.testing.assert_close(before, after)


class KnownCritic(th.nn.Module):
    """More is better: Q = a."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = th.tensor(1.0)

    def forward(self, grids: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return actions[:, 0].expand(2, -1)


class KnownCostCritic(th.nn.Module):
    """More is riskier: the mean of the cost is a^2, its deviation a / 2; the second critic sees less danger."""

    def __init__(self) -> None:
        super().__init__()
        self.bound = th.tensor(100.0)

    def forward(self, grids: th.Tensor, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        mean = actions[:, 0].square()
        return th.stack([mean, 0.5 * mean]), 0.25 * mean + 1e-8


def predict_nothing(model: ESADLEND) -> None:
    """No reward, no cost, no end."""

    def predict(grids: th.Tensor) -> Predictions:
        zeros = th.zeros(grids.shape[:2])
        return Predictions(zeros, zeros, zeros + 1.0)

    cast(Any, model.policy.world_model).predict = predict


@pytest.mark.parametrize(
    ("settings", "best"),
    [
        ({"cost_limit": None}, 1.0),
        ({"cost_limit": 0.1, "risk_level": 1.0}, 0.25),  # a - 2 a^2
        ({"cost_limit": 0.1, "risk_level": 0.5}, 0.125),  # a - 2 a^2 / 0.5, for CVaR is at most E / alpha
        ({"cost_limit": 0.1, "risk_level": 0.9}, 0.225),  # a - 2 a^2 / 0.9
    ],
)
def test_actor_finds_the_best_of_known_values(settings: dict[str, Any], best: float) -> None:
    """A multiplier of 2 weighs the risk against the value; entropy and what is predicted have no part in it."""
    fixed = {"lagrangian_multiplier_init": 2.0, "penalty_coef": 0.0, "ent_coef": 0.0, "learning_rate": 0.02, "gamma": 0.99}
    model = make_model(**{**fixed, **settings, "lambda_return": 0.0}).learn(24)
    model.policy.critic, model.policy.cost_critic = cast(Any, KnownCritic()), cast(Any, KnownCostCritic())
    predict_nothing(model)
    for _ in range(150):
        _, _, imagined = imagine(model)
        model._update_actor(imagined)
    actions = model.policy.actor(imagined.grids[0], deterministic=True)
    # The rest is due to the spread of the policy, which cannot vanish
    assert actions.mean().item() == pytest.approx(best, abs=0.05)


def actor_gradient(model: ESADLEND) -> tuple[float, th.Tensor]:
    """Loss of the actor and its gradient, always on the same dreams of the same noise; the policy stays as it is."""
    networks = (model.policy.actor, model.policy.world_model)
    saved = [deepcopy(network.state_dict()) for network in networks]
    np.random.seed(0)
    th.manual_seed(0)
    _, _, imagined = imagine(model)
    loss = model._update_actor(imagined)["actor_loss"]
    for network, state in zip(networks, saved, strict=True):
        network.load_state_dict(state)
    gradients = [parameter.grad for parameter in model.policy.actor.parameters()]
    return loss, th.cat([gradient.flatten() for gradient in gradients if gradient is not None])


@pytest.mark.parametrize("cost_limit", [None, 0.05])
def test_without_a_limit_costs_do_not_reach_the_actor(cost_limit: float | None) -> None:
    model = make_model(cost_limit=cost_limit, ent_coef=0.1).learn(24)
    _, before = actor_gradient(model)
    for parameter in model.policy.cost_critic.parameters():
        th.nn.init.uniform_(parameter, -1.0, 1.0)
    _, scrambled = actor_gradient(model)
    assert th.equal(before, scrambled) == (cost_limit is None)
    for parameter in model.policy.cost_critic.parameters():
        th.nn.init.constant_(parameter, th.nan)
    _, broken = actor_gradient(model)
    assert broken.isfinite().all() == (cost_limit is None)


@pytest.mark.parametrize("cost_limit", [None, 0.05])
def test_the_actor_is_told_what_its_actions_do_to_the_steps_that_follow(
    cost_limit: float | None,
) -> None:
    """Its gradient is the slope of its loss, found by moving it a little along the gradient and imagining again."""
    fixed: dict[str, Any] = {"penalty_coef": 0.0, "ent_coef": 0.0, "max_grad_norm": 1e9, "uniform_action_prob": 0.0}
    model = make_model(cost_limit=cost_limit, **fixed).learn(24)
    world_model: Any = model.policy.world_model
    predict = world_model.predict
    # Of the probability to go on, the weights of the steps would be a part that has no gradient on purpose
    world_model.predict = lambda grids: (lambda p: p._replace(continues=th.full_like(p.continues, 0.9)))(predict(grids))
    for network in (world_model.predictions.reward, *model.policy.critic.q_networks):
        th.nn.init.normal_(cast(Any, network)[-1].weight, std=0.3)
    _, gradient = actor_gradient(model)
    parameters, step = list(model.policy.actor.parameters()), 1e-2 * gradient / gradient.norm()
    middle = th.nn.utils.parameters_to_vector(parameters).detach()
    losses = []
    for sign in (1.0, -1.0):
        th.nn.utils.vector_to_parameters(middle + sign * step, parameters)
        losses.append(actor_gradient(model)[0])
    slope = (losses[0] - losses[1]) / (2 * step.norm())
    assert slope.item() == pytest.approx(gradient.norm().item(), rel=0.03)


def test_limits_choose_their_penalty() -> None:
    assert isinstance(make_model(cost_limit=None).penalty, NoPenalty)
    strict = make_model(cost_limit=0.0).penalty
    assert isinstance(strict, AugmentedLagrangian) and strict.budget == 0.0
    usual = make_model(cost_limit=0.05, cost_gamma=0.9).penalty
    assert isinstance(usual, AugmentedLagrangian)
    assert usual.budget == pytest.approx(discounted_budget(0.05, 0.9, 1000))
    assert make_model(gamma=0.8).penalty.cost_gamma == 0.8


def test_budget_knows_the_time_limit() -> None:
    model = make_model(TimeLimit(CountingEnv(), 40), cost_limit=0.05, cost_gamma=0.95)
    assert model.penalty.budget == pytest.approx(0.0218, abs=1e-4)


class CountCalls(BaseCallback):
    """A callback of the user's."""

    def _on_step(self) -> bool:
        return True


def test_penalty_takes_part_whatever_callback_the_user_has() -> None:
    calls: list[int] = []

    def function(locals_: dict[str, Any], globals_: dict[str, Any]) -> bool:
        calls.append(1)
        return True

    mine = CountCalls()
    choices: list[MaybeCallback] = [None, mine, [CountCalls(), CountCalls()], function]
    for callback in choices:
        model = make_model().learn(40, callback=callback)
        assert isinstance(model.penalty, AugmentedLagrangian)
        assert model.penalty.n_updates.item() == model._n_updates - 1, "the last update is followed by no rollout"
        assert "train/lagrangian_multiplier" in model.logger.name_to_value
    assert mine.n_calls == len(calls) == 40


def test_a_violation_is_taken_once() -> None:
    model = make_model(learning_starts=10).learn(12)
    assert model._n_updates == 1
    assert model.take_violation() == (None, 1), "the critics knew nothing when these steps were made"
    for _ in range(2):
        model._sample_action(0)
    violation, n_updates = model.take_violation()
    assert violation is not None and violation.isfinite() and n_updates == 0
    assert model.take_violation() == (None, 0)


def test_short_pieces_move_the_multiplier_as_one_long_one() -> None:
    whole, pieces = make_model(penalty_warmup=0).learn(80), make_model(penalty_warmup=0)
    for piece in range(20):
        pieces.learn(4, reset_num_timesteps=piece == 0)
    for model in (whole, pieces):
        assert isinstance(model.penalty, AugmentedLagrangian)
        assert model.penalty.n_updates.item() == model._n_updates - 1


def test_random_steps_of_a_second_training_are_not_predicted() -> None:
    model = make_model().learn(40)
    assert isinstance(model.penalty, AugmentedLagrangian)
    before = model.penalty.episodes.recent["predictions"]
    model.learn(20)  # as many as learning_starts
    assert model.penalty.episodes.recent["predictions"] == before > 0


def test_no_updates_leave_everything_as_it_was() -> None:
    model = make_model().learn(24)
    n_updates, before = model._n_updates, th.nn.utils.parameters_to_vector(model.policy.parameters())
    model.train(0)
    after = th.nn.utils.parameters_to_vector(model.policy.parameters())
    assert model._n_updates == n_updates and th.equal(before, after)


def test_as_many_updates_as_steps() -> None:
    env = make_vec_env(CountingEnv, n_envs=2)
    model = make_model(env, learning_starts=0, train_freq=3, gradient_steps=-1)
    model.learn(total_timesteps=3 * env.num_envs)
    assert model.logger.name_to_value["train/n_updates"] == 3 * env.num_envs


def test_pretraining_comes_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(pretrain_steps=5, learning_starts=8)
    updates: list[int] = []
    fit = model._update_world_model

    def spy(samples: SequenceSamples) -> Any:
        updates.append(model._n_updates)
        return fit(samples)

    monkeypatch.setattr(model, "_update_world_model", spy)
    model.learn(20)
    assert updates == [0] * 6 + [1, 2]


def test_additional_updates_come_once() -> None:
    assert make_model(pretrain_gradient_steps=4, learning_starts=8).learn(20)._n_updates == 4 + 3


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("noisy", [False, True])
def test_executed_actions_are_remembered(n_envs: int, noisy: bool) -> None:
    """In the environment, in the replay buffer and in the memory: the same action, after noise and clipping."""
    noise = NormalActionNoise(np.zeros(2), np.full(2, 2.0)) if noisy else None
    env = DummyVecEnv([lambda: RecordingEnv(episode_length=6)] * n_envs)
    model = make_model(env, learning_starts=10, action_noise=noise)
    memories: list[np.ndarray] = []

    def remember(locals_: dict[str, Any], _: dict[str, Any]) -> bool:
        assert model._last_latent is not None
        memories.append(model._last_latent.action.numpy().copy())
        return True

    model.learn(20 * n_envs, callback=remember)
    executed = np.stack([each.actions for each in env.envs], axis=1)  # type: ignore[attr-defined]
    stored = model.replay_buffer.actions[:20]
    np.testing.assert_array_equal(stored, np.stack(memories))
    np.testing.assert_allclose(executed, model.policy.unscale_action(stored), atol=1e-6)
    assert np.abs(stored).max() <= 1.0 and executed.dtype == np.float32
    assert np.isin(np.abs(stored), 1.0).any() == noisy


@pytest.mark.parametrize("n_envs", [1, 2])
def test_random_actions_are_held(n_envs: int) -> None:
    model = make_model(DummyVecEnv([CountingEnv] * n_envs), learning_starts=100, random_hold=4)
    model.learn(24 * n_envs)
    held = model.replay_buffer.actions[:24].reshape(6, 4, n_envs)
    assert (held == held[:, :1]).all()
    assert len(np.unique(held)) == 6 * n_envs
    assert held.min() < -0.3 and held.max() > 0.3


def test_memory_starts_afresh_with_each_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    env = DummyVecEnv([lambda: CountingEnv(episode_length=5), lambda: CountingEnv(time_limit=3)])
    model = make_model(env)
    starts: list[list[bool]] = []
    observe = LatentAgent.observe

    def spy(agent: LatentAgent, obs: Any, state: LatentState, episode_start: th.Tensor, deterministic: bool) -> Belief:
        starts.append(episode_start.tolist())
        return observe(agent, obs, state, episode_start, deterministic)

    monkeypatch.setattr(LatentAgent, "observe", spy)
    model.learn(24)
    assert [first for first, _ in starts] == [step % 5 == 0 for step in range(12)]
    assert [second for _, second in starts] == [step % 3 == 0 for step in range(12)]
    starts.clear()
    model.learn(8, reset_num_timesteps=False)
    assert starts == [[False, True], [False, False], [False, False], [True, True]]
    model.learn(8)
    assert starts[4:6] == [[True, True], [False, False]]


def test_critics_are_asked_about_every_state_of_the_policy(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_model(DummyVecEnv([lambda: CountingEnv(episode_length=5)] * 2))
    model.learn(40)
    noted: list[int] = []
    monkeypatch.setattr(model.penalty, "note_prediction", lambda values: noted.append(len(values)))
    model.learn(24, reset_num_timesteps=False)
    assert noted == [2] * 12


def test_costs_of_episodes_are_logged() -> None:
    model = make_model().learn(28)
    assert model.ep_info_buffer is not None
    assert [(info["l"], info["c"]) for info in model.ep_info_buffer] == [(7, 2.0)] * 4
    logged: dict[str, Any] = {}
    model.logger.dump = lambda step=0: logged.update(model.logger.name_to_value)  # type: ignore[method-assign]
    model.dump_logs()
    assert logged["rollout/ep_cost_mean"] == 2.0
    assert logged["rollout/total_cost"] == 8.0
    assert logged["rollout/cost_rate"] == pytest.approx(8 / 28)


def test_a_line_of_the_log_is_the_mean_of_all_updates_since_the_last_one() -> None:
    model = make_model().learn(24)
    model.logger.dump(0)
    for losses in ([1.0, 3.0], [8.0, 8.0]):
        model._record({"critic_loss": list(th.tensor(losses))})
    assert model.logger.name_to_value["train/critic_loss"] == 5.0


def test_the_networks_have_the_names_that_sac_gives_them(tmp_path: Path) -> None:
    model = make_model()
    model.save(tmp_path / "model")
    for each in (model, ESADLEND.load(tmp_path / "model")):
        assert each.actor is each.policy.actor
        assert each.critic is each.policy.critic and each.critic_target is each.policy.critic_target


def test_the_policy_has_as_many_critics_as_it_is_told_to(tmp_path: Path) -> None:
    model = make_model(policy_kwargs={**TINY["policy_kwargs"], "n_critics": 3}).learn(24)
    model.save(tmp_path / "model")
    for policy in (model.policy, ESADLEND.load(tmp_path / "model").policy):
        assert len(policy.critic.q_networks) == len(policy.cost_critic.means) == 3
    with pytest.raises(ValueError, match="n_critics is 0; choose a number >= 1"):
        make_model(policy_kwargs={**TINY["policy_kwargs"], "n_critics": 0})


def test_a_frozen_features_extractor_is_left_as_it_is() -> None:
    model = make_model()
    extractor = model.policy.world_model.features_extractor.requires_grad_(False)
    before, others = [th.nn.utils.parameters_to_vector(part.parameters()) for part in (extractor, model.policy.world_model)]
    model.learn(28)
    after, changed = [th.nn.utils.parameters_to_vector(part.parameters()) for part in (extractor, model.policy.world_model)]
    assert th.equal(before, after) and not th.equal(others, changed)


def test_a_reset_from_outside_leaves_no_costs_behind() -> None:
    """Learning anew resets the environment in the midst of an episode, whose costs must not be added to the next."""
    model = make_model(learning_starts=0).learn(12)
    model.learn(16)
    assert model.ep_info_buffer is not None
    assert [info["c"] for info in model.ep_info_buffer] == [2.0, 2.0]
    assert model.total_cost == 4.0
    assert isinstance(model.penalty, AugmentedLagrangian)
    assert model.penalty.episodes.costs[: model.penalty.episodes.size].tolist() == [2.0] * 3


def test_learning_goes_on() -> None:
    model = make_model().learn(28)
    model.learn(28, reset_num_timesteps=False)
    assert model.num_timesteps == model.replay_buffer.size() == 56
    assert model._n_updates == 9 and model.total_cost == 16.0


def test_learn_has_a_default_number_of_steps() -> None:
    assert inspect.signature(ESADLEND.learn).parameters["total_timesteps"].default == 100_000
    model = make_model()
    model.learn(callback=lambda locals_, _: model.num_timesteps < 5)
    assert model.num_timesteps == 5 and model._total_timesteps == 100_000


def test_learning_rate_schedule_reaches_every_optimiser() -> None:
    model = make_model(learning_rate=lambda remaining: 1e-3 * (0.1 + remaining), ent_coef="auto").learn(40)
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in model._optimizers().items()}
    assert set(rates) == {*(f"policy.{name}.optimizer" for name in NETWORKS), "entropy.optimizer"}
    # What judges the policy goes on where the policy stops
    assert rates.pop("policy.cost_critic.optimizer") == pytest.approx(1.1e-3 / 3)
    assert list(rates.values()) == pytest.approx([1e-4] * 4)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_share_of_the_rate_that_the_cost_critics_keep(share: float) -> None:
    model = make_model(learning_rate=lambda remaining: 1e-3 * (0.1 + remaining), min_cost_critic_rate=share).learn(40)
    (group,) = model.policy.cost_critic.optimizer.param_groups
    assert group["lr"] == pytest.approx(max(1e-4, share * 1.1e-3))


@pytest.mark.parametrize(("ent_coef", "initial"), [("auto", 1.0), ("auto_0.01", 0.01), (0.3, 0.3)])
def test_entropy_coefficient(ent_coef: str | float, initial: float) -> None:
    model = make_model(ent_coef=ent_coef)
    assert model.entropy().item() == pytest.approx(initial)
    model.learn(40)
    assert (model.entropy().item() == pytest.approx(initial)) == isinstance(ent_coef, float)


def test_bound_of_the_cost_grows_where_costs_do_not_end_episodes() -> None:
    model = make_model(cost_gamma=0.9).learn(30)
    bounds = (model.policy.cost_critic.bound.item(), model.policy.cost_critic_target.bound.item())
    assert bounds == pytest.approx((10.0, 10.0))
    ending = make_model(DummyVecEnv([lambda: CountingEnv(episode_length=3)])).learn(30)
    assert ending.policy.cost_critic.bound.item() == 1.0


def test_barrier_looks_some_steps_ahead() -> None:
    model = make_model(barrier_steps=2, barrier_decay=0.3, cost_limit=0.5)
    risk = th.rand(5, 4)
    barrier = model._barrier(risk)
    th.testing.assert_close(barrier[:3], barrier_residual(risk[2:], risk[:3], model.penalty.budget, 0.3))
    assert (barrier[3:] == 0).all()
    assert (model._barrier(risk[:1]) == 0).all()


def test_a_violated_barrier_weighs_as_much_as_it_was_told_to() -> None:
    model = make_model(barrier_coef=3.0, barrier_steps=2)
    objective, risk = th.zeros(4), th.ones(4)
    violated, scale = th.tensor([0.0, 0.0, 0.0, 0.02]), model.penalty.budget_scale
    weight = model.penalty.base_weight + 3.0 * violated / scale
    th.testing.assert_close(model.penalty.combine(objective, risk, violated), weight / (1 + weight.mean()))


@pytest.mark.parametrize("probability", [0.0, 1.0])
def test_imagination_also_starts_with_random_actions(probability: float) -> None:
    model = make_model(uniform_action_prob=probability)
    start = model.policy.initial_state(2000)
    th.manual_seed(1)
    actions = model._first_actions(start)
    assert actions.abs().max() <= 1.0
    uniform = actions.abs().mean().item() == pytest.approx(0.5, abs=0.02)
    th.manual_seed(1)
    assert th.equal(actions, model.policy.actor(start.grid)) == (probability == 0.0)
    assert uniform or probability == 0.0


def test_recorded_transitions_lead_from_before_to_after() -> None:
    """
    Two windows of three steps; a state is named after its window and step, the one that it leads to by 0.5 more.

    In the second window an episode begins with the second step.
    """
    names = (10.0 * th.arange(2) + th.arange(3.0)[:, None])[..., None, None, None]
    before, after = (LatentState(each, each, each[..., 0, 0]) for each in (names, names + 0.5))
    gaussian = Gaussian(names, names)
    is_first = th.tensor([[True, True], [False, True], [False, False]])
    filtered = Filtered(after, before, gaussian, gaussian, names, is_first, th.zeros(3, 2) > 0)
    batch_major = names[..., 0, 0, 0].T
    samples = SimpleNamespace(
        rewards=batch_major, costs=batch_major / 100, continues=batch_major / 10, event_weights=th.tensor([1.0, 2.0])
    )
    policy = SimpleNamespace(
        world_model=SimpleNamespace(features=lambda state: state.grid), actor=lambda grid: 3 * grid[:, :1, 0, 0]
    )
    recorded = recorded_transitions(cast(LatentPolicy, policy), cast(SequenceSamples, samples), filtered)
    now = recorded.grids[:, 0, 0, 0]
    assert sorted(now.tolist()) == [0, 1, 2, 10, 11, 12]
    th.testing.assert_close(recorded.actions[:, 0], now)
    th.testing.assert_close(recorded.next_grids[:, 0, 0, 0], now + 0.5)
    th.testing.assert_close(recorded.next_actions[:, 0], 3 * (now + 0.5))
    th.testing.assert_close(recorded.outcomes.rewards, now)
    th.testing.assert_close(recorded.outcomes.costs, now / 100)
    th.testing.assert_close(recorded.outcomes.continues, now / 10)
    th.testing.assert_close(recorded.event_weights, th.where(now < 10, 1.0, 2.0))
    assert recorded.followed.tolist() == [[True, False], [True, True], [False, False]]


def test_without_costs_the_multiplier_falls_and_with_them_it_rises() -> None:
    multipliers = []
    for env in (FreeEnv(), CountingEnv()):
        model = make_model(env, cost_limit=0.5, penalty_warmup=0, lambda_lr=0.1, learning_starts=8)
        assert isinstance(model.penalty, AugmentedLagrangian)
        model.penalty.episodes.road_steps = 20
        model.learn(100)
        multipliers.append(model.penalty.multiplier.item())
    assert multipliers[0] < 0.9 < 1.1 < multipliers[1]
