"""``predict``: the memory is the caller's, environments do not disturb each other, and wrong input is refused."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnvBox
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_esad import ESADLEND
from sb3_esad.common.target_networks import update_target
from tests.conftest import SPACES, TINY, VECTOR, CountingEnv, RandomEnv

Observation = Any


def make_model(policy: str, **kwargs: Any) -> ESADLEND:
    model = ESADLEND(policy, RandomEnv(SPACES[policy]), **{**TINY, **kwargs})
    excite(model)
    return model


def excite(model: ESADLEND) -> None:
    """Untrained actors do the same whatever they see; let this one act by what it sees."""
    *_, output_weight, _ = model.policy.actor.parameters()
    th.nn.init.normal_(output_weight)
    update_target(model.policy.actor, model.policy.actor_target, tau=1.0)


def observe(model: ESADLEND, n_envs: int, steps: int) -> list[Observation]:
    """What ``n_envs`` environments show during some steps."""
    env = DummyVecEnv([lambda: RandomEnv(model.observation_space)] * n_envs)
    model.observation_space.seed(0)
    return [env.reset() for _ in range(steps)]


def pick(observation: Observation, index: Any) -> Observation:
    return {key: part[index] for key, part in observation.items()} if isinstance(observation, dict) else observation[index]


@pytest.mark.parametrize("policy", SPACES)
def test_together_is_one_by_one(policy: str) -> None:
    """Whatever the others see, and whenever their episodes start."""
    model = make_model(policy)
    observations = observe(model, n_envs=3, steps=4)
    starts = np.array([[True, True, True], [False, True, False], [False, False, True], [False, False, False]])
    state: Any = None
    alone: list[Any] = [None] * 3
    for observation, start in zip(observations, starts, strict=True):
        actions, state = model.predict(observation, state, start, deterministic=True)
        for env in range(3):
            one = slice(env, env + 1)
            action, alone[env] = model.predict(pick(observation, one), alone[env], start[one], deterministic=True)
            np.testing.assert_allclose(action[0], actions[env], atol=1e-5)
            for single, joint in zip(alone[env], state, strict=True):
                np.testing.assert_allclose(single[:, 0], joint[:, env], atol=1e-5)


@pytest.mark.parametrize("policy", SPACES)
def test_a_single_observation_needs_no_batch(policy: str) -> None:
    model = make_model(policy)
    (observation,) = observe(model, n_envs=1, steps=1)
    batch, batch_state = model.predict(observation, deterministic=True)
    action, state = model.predict(pick(observation, 0), deterministic=True)
    assert batch.shape == (1, 1) and action.shape == (1,) and model.action_space.contains(action)
    np.testing.assert_array_equal(batch[0], action)
    for one, other in zip(state, batch_state, strict=True):  # type: ignore[arg-type]
        np.testing.assert_array_equal(one, other)
    again, _ = model.predict(pick(observation, 0), state, deterministic=True)
    assert again.shape == (1,)


@pytest.mark.parametrize("policy", SPACES)
def test_no_state_is_an_episode_start(policy: str) -> None:
    model = make_model(policy)
    first, second = observe(model, n_envs=2, steps=2)
    fresh, _ = model.predict(second, deterministic=True)
    _, state = model.predict(first, deterministic=True)
    started, _ = model.predict(second, state, np.ones(2, dtype=bool), deterministic=True)
    forgotten, _ = model.predict(second, None, np.zeros(2, dtype=bool), deterministic=True)
    goes_on, _ = model.predict(second, state, np.zeros(2, dtype=bool), deterministic=True)
    continued, _ = model.predict(second, state, deterministic=True)
    np.testing.assert_array_equal(fresh, started)
    np.testing.assert_array_equal(fresh, forgotten)
    np.testing.assert_array_equal(goes_on, continued)
    assert not np.array_equal(fresh, continued)


def test_memory_holds_the_action() -> None:
    """Two histories that differ in the action only lead to different states."""
    model = make_model("MlpPolicy")
    first, second = observe(model, n_envs=1, steps=2)
    action, (memory, latent, remembered) = model.predict(first, deterministic=True)  # type: ignore[misc]
    np.testing.assert_allclose(remembered[0], action, rtol=1e-6)
    assert memory.shape == (1, 1, 8) and latent.shape == (1, 1, 4)
    assert all(array.dtype == np.float32 for array in (memory, latent, remembered))
    one, _ = model.predict(second, (memory, latent, remembered), deterministic=True)
    other, _ = model.predict(second, (memory, latent, -remembered), deterministic=True)
    assert not np.allclose(one, other)


def test_a_broken_memory_is_forgotten_at_the_start_of_an_episode() -> None:
    model = make_model("MlpPolicy")
    (observation,) = observe(model, n_envs=1, steps=1)
    _, state = model.predict(observation)
    broken = tuple(np.full_like(array, np.nan) for array in state or ())
    action, _ = model.predict(observation, broken, np.ones(1, dtype=bool), deterministic=True)
    np.testing.assert_array_equal(action, model.predict(observation, deterministic=True)[0])


def test_a_memory_that_went_through_plain_numbers_is_taken() -> None:
    """Lists, as JSON has them, come back as doubles."""
    model = make_model("MlpPolicy")
    first, second = observe(model, n_envs=1, steps=2)
    _, state = model.predict(first, deterministic=True)
    doubles = tuple(np.array(array.tolist()) for array in state or ())
    assert doubles[0].dtype == np.float64
    expected, _ = model.predict(second, state, deterministic=True)
    np.testing.assert_array_equal(model.predict(second, doubles, deterministic=True)[0], expected)


def test_deterministic_means_the_same_each_time() -> None:
    model = make_model("MlpPolicy")
    (observation,) = observe(model, n_envs=4, steps=1)
    fixed = [model.predict(observation, deterministic=True)[0] for _ in range(3)]
    drawn = [model.predict(observation, deterministic=False)[0] for _ in range(3)]
    assert (fixed[0] == fixed[1]).all() and (fixed[1] == fixed[2]).all()
    assert not np.allclose(drawn[0], drawn[1]) and not np.allclose(drawn[1], drawn[2])


def test_predicting_is_acting() -> None:
    """``predict`` and what collects experience give the same actions from the same random numbers."""
    actions = []
    for through_predict in (True, False):
        env = DummyVecEnv([CountingEnv])
        model = ESADLEND("MlpPolicy", env, **{**TINY, "learning_starts": 0, "train_freq": 100})
        excite(model)
        th.manual_seed(3)
        if through_predict:
            observation: Any = env.reset()
            state, start, done = None, np.ones(1, dtype=bool), []
            for _ in range(20):
                action, state = model.predict(observation, state, start)
                observation, _, start, _ = env.step(action)
                done.append(action[0])
        else:
            model.learn(100)
            done = list(model.replay_buffer.actions[:20, 0])
        actions.append(np.stack(done))
    np.testing.assert_allclose(actions[0], actions[1], atol=1e-6)


@pytest.mark.parametrize("policy", SPACES)
def test_state_for_another_number_of_environments_is_refused(policy: str) -> None:
    model = make_model(policy)
    (many,), (one,) = observe(model, n_envs=3, steps=1), observe(model, n_envs=1, steps=1)
    _, state_of_many = model.predict(many)
    _, state_of_one = model.predict(one)
    for observation, state in ((one, state_of_many), (many, state_of_one)):
        with pytest.raises(ValueError, match=r"given \d observation\(s\) with a state of shapes .*or None to start afresh"):
            model.predict(observation, state)


@pytest.mark.parametrize(
    "state", [(), (np.zeros((1, 1, 8)),), (np.zeros((1, 1, 9)), np.zeros((1, 1, 4)), np.zeros((1, 1, 1)))]
)
def test_foreign_states_are_refused(state: Any) -> None:
    model = make_model("MlpPolicy")
    with pytest.raises(ValueError, match="pass what the last call returned"):
        model.predict(VECTOR.sample(), state)


def test_what_reset_returns_is_no_observation() -> None:
    model = make_model("MlpPolicy")
    with pytest.raises(ValueError, match="mixing Gym API"):
        model.predict(RandomEnv(VECTOR).reset())  # type: ignore[arg-type]


def test_wrong_shape_is_refused() -> None:
    model = make_model("MlpPolicy")
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        model.predict(np.zeros(5, dtype=np.float32))


@pytest.mark.parametrize("channel_first", [True, False])
def test_images_as_the_environment_shows_them(channel_first: bool) -> None:
    """Environments put the channels last, SB3 puts them first; either is understood."""
    env = FakeImageEnv(2, 40, 36, 3, discrete=False, channel_first=channel_first)
    model = ESADLEND("CnnPolicy", env, **TINY)
    excite(model)
    assert model.observation_space.shape == (3, 40, 36)
    shown, _ = env.reset()
    transposed = shown if channel_first else shown.transpose(2, 0, 1)
    one, other = (model.predict(image, deterministic=True)[0] for image in (shown, transposed))
    np.testing.assert_array_equal(one, other)


def test_episode_starts_of_another_number_of_environments_are_refused() -> None:
    model = make_model("MlpPolicy")
    (observation,) = observe(model, n_envs=3, steps=1)
    with pytest.raises(ValueError, match=r"3 observation\(s\) with 1 values of episode_start: give one for each"):
        model.predict(observation, None, np.ones(1, dtype=bool))


def test_actions_are_in_the_units_of_the_environment() -> None:
    low, high = np.array([[-3, 0], [10, -1]], np.float32), np.array([[5, 0.1], [20, 1]], np.float32)
    space = spaces.Box(low, high)
    model = ESADLEND("MlpPolicy", RandomEnv(VECTOR, space), **TINY)
    *_, output_bias = model.policy.actor_target.parameters()
    output_bias.data[:4] = th.tensor([9.0, -9.0, 0.0, 9.0])
    action, _ = model.predict(VECTOR.sample(), deterministic=True)
    np.testing.assert_allclose(action, [[5.0, 0.0], [15.0, 1.0]], atol=1e-4)
    assert action.dtype == np.float32


def test_subclassed_environment_of_sb3() -> None:
    env = IdentityEnvBox(-10, 10)
    model = ESADLEND("MlpPolicy", env, **TINY)
    actions, state = model.predict(np.zeros((5, 1), dtype=np.float32))
    assert actions.shape == (5, 1) and state is not None and {array.shape[1] for array in state} == {5}
