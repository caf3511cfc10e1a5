"""It runs: all policies, spaces and vectorised environments, and the wrappers, callbacks and options of SB3."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.wrappers import TransformReward
from stable_baselines3.common.callbacks import CheckpointCallback, EvalCallback, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnvBox, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv, VecFrameStack, VecNormalize

from sb3_esad import ESADLEND
from sb3_esad.common.agent import LatentAgent
from tests.conftest import PICTURE, SPACES, TINY, VECTOR, VIEWS, CountingEnv, RandomEnv


def learn(policy: str, env: gym.Env | VecEnv, steps: int = 32, **kwargs: Any) -> ESADLEND:
    """Learn for some steps, a few of them with updates; nothing may have become infinite."""
    model = ESADLEND(policy, env, **{**TINY, **kwargs}).learn(steps)
    assert model._n_updates > 0
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    return model


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("policy", SPACES)
def test_policies(policy: str, n_envs: int) -> None:
    env = DummyVecEnv([lambda: RandomEnv(SPACES[policy])] * n_envs)
    model = learn(policy, env, steps=40)
    assert model.num_timesteps == 40
    model.learn(16)


@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_processes(policy: str) -> None:
    env = make_vec_env(RandomEnv, 2, env_kwargs={"observation_space": SPACES[policy]}, vec_env_cls=SubprocVecEnv)
    model = learn(policy, env, steps=40)
    costs = model.replay_buffer.costs[: model.replay_buffer.size()]
    assert 0 < costs.mean() < 0.5
    env.close()


def test_processes_whose_environments_cannot_be_described() -> None:
    """The spec of such an environment does not go through a pipe, and its process would die of the attempt."""

    def make_env() -> gym.Env:
        env = gym.make("Pendulum-v1", max_episode_steps=40)
        return TransformReward(env, lambda reward: 0.1 * reward)

    env = SubprocVecEnv([make_env] * 2)
    assert ESADLEND("MlpPolicy", env, **TINY)._episode_length() == 40
    env.close()


MAKERS: list[tuple[str, Callable[[], gym.Env]]] = [
    ("MlpPolicy", lambda: IdentityEnvBox(-10, 10)),
    ("CnnPolicy", lambda: FakeImageEnv(2, 40, 40, 1, discrete=False)),
    ("CnnPolicy", lambda: FakeImageEnv(2, 40, 40, 3, discrete=False, channel_first=True)),
    ("MlpPolicy", lambda: FakeImageEnv(2, 36, 36, 1, discrete=False)),
    ("MultiInputPolicy", lambda: SimpleMultiObsEnv(discrete_actions=False)),
]


@pytest.mark.parametrize(("policy", "make_env"), MAKERS)
def test_environments_of_sb3(policy: str, make_env: Callable[[], gym.Env]) -> None:
    learn(policy, make_env())


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(5),
        spaces.MultiDiscrete([3, 2, 4]),
        spaces.MultiBinary(3),
        spaces.Box(-np.inf, np.inf, (2, 3), np.float64),
        spaces.Box(-1.0, 1.0, (2, 4, 4), np.float32),
        spaces.Dict({"gear": spaces.Discrete(3), "speed": VECTOR}),
        spaces.Dict({"front": VIEWS["front"]}),
    ],
    ids=str,
)
def test_observation_spaces(space: spaces.Space) -> None:
    learn("MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy", RandomEnv(space))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-2.0, 3.0, (2, 2), np.float32),
        spaces.Box(np.array([0.0, -7.0], np.float32), np.array([0.1, -5.0], np.float32)),
        spaces.Box(-1.0, 1.0, (3,), np.float64),
    ],
    ids=str,
)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_spaces(space: spaces.Box, n_envs: int) -> None:
    """The environment itself refuses what does not lie in its space."""
    noise = NormalActionNoise(np.zeros(space.shape), np.ones(space.shape))
    model = learn("MlpPolicy", DummyVecEnv([lambda: RandomEnv(VECTOR, space)] * n_envs), action_noise=noise)
    action, _ = model.predict(VECTOR.sample())
    assert space.contains(action)


@pytest.mark.parametrize(
    "settings",
    [
        {"train_freq": (1, "episode")},
        {"train_freq": (3, "step"), "gradient_steps": -1},
        {"gradient_steps": 3},
        {"ent_coef": "auto", "target_entropy": -0.5},
        {"cost_limit": None},
        {"cost_limit": 0.0, "risk_level": 0.1, "barrier_coef": 1.0, "penalty_warmup": 0},
        {"learning_rate": lambda remaining: 1e-3 * remaining},
        {"buffer_size": 12},
        {"sequence_length": 1},
        {"imagination_horizon": 1},
        {"pretrain_steps": 0},
        {"batch_size": 1},
        {"replay_buffer_kwargs": {"event_fraction": 0.0}},
        {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))},
    ],
    ids=lambda settings: "-".join(settings),  # not their values: a function's address differs between the workers
)
def test_settings(settings: dict[str, Any]) -> None:
    learn("MlpPolicy", CountingEnv(), **settings)


@pytest.mark.parametrize(
    "policy_kwargs",
    [
        {"net_arch": [4]},
        {"net_arch": {"pi": [8], "qf": [16, 4]}},
        {"optimizer_class": th.optim.RMSprop},
        {"optimizer_class": th.optim.Adam, "optimizer_kwargs": {"eps": 1e-3}},
        {"features_extractor_kwargs": {"features_dim": 9}},
        {"head_kwargs": {"free_nats": 3.0}},
        {"world_model_kwargs": {"units": 5, "open_loop_length": 2}},
    ],
    ids=str,
)
def test_policy_settings(policy_kwargs: dict[str, Any]) -> None:
    learn("MlpPolicy", CountingEnv(), policy_kwargs={**TINY["policy_kwargs"], **policy_kwargs})


def test_architecture_of_actor_and_critics() -> None:
    model = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "policy_kwargs": {"net_arch": {"pi": [8], "qf": [16, 4]}}})
    assert model.policy.actor.readout.features_dim == 8
    layers = model.policy.critic.q_networks[0].modules()
    widths = [layer.out_features for layer in layers if isinstance(layer, th.nn.Linear)]
    assert model.policy.critic.features.readout.features_dim == 16 and widths == [16, 4, 101]


def test_normalised_environment() -> None:
    env = VecNormalize(DummyVecEnv([lambda: CountingEnv()] * 2))
    model = learn("MlpPolicy", env)
    stored = model.replay_buffer
    assert np.max(stored.observations) == 6  # type: ignore[arg-type]
    assert set(np.unique(stored.rewards[: stored.size()])) == {1, 2, 3, 4, 5, 6, 7}
    samples = model._sample(4)
    assert samples.observations.abs().max() < 6  # type: ignore[union-attr]
    assert set(samples.costs.unique().tolist()) == {0.0, 1.0}
    assert samples.rewards.max() < 7


def test_stacked_frames() -> None:
    env = VecFrameStack(DummyVecEnv([lambda: FakeImageEnv(2, 36, 36, 1, discrete=False)]), n_stack=4)
    assert learn("CnnPolicy", env).policy.observation_space.shape == (4, 36, 36)


def test_float_images() -> None:
    env = RandomEnv(spaces.Box(0.0, 1.0, (3, 24, 24), np.float32))
    policy_kwargs = {**TINY["policy_kwargs"], "normalize_images": False}
    model = learn("CnnPolicy", env, policy_kwargs=policy_kwargs)
    assert model.policy.world_model.rssm.memory_shape == (8, 3, 3)


def test_a_mixture_of_full_parameters_gives_numbers() -> None:
    """As SB3's tests fill all parameters and buffers, with numbers from 0 to 1."""
    model = ESADLEND("CnnPolicy", RandomEnv(PICTURE), **TINY)
    model.policy.load_state_dict({name: th.rand_like(value) for name, value in model.policy.state_dict().items()})
    for deterministic in (True, False):
        action, state = model.predict(PICTURE.sample(), deterministic=deterministic)
        assert np.isfinite(action).all() and all(np.isfinite(array).all() for array in state or ())
    model.learn(32)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


def test_evaluation_beside_training() -> None:
    """An evaluation with another number of environments leaves the memory of the training alone."""
    memories: list[list[th.Tensor]] = []
    for evaluations in (0, 2):
        model = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "learning_starts": 100})
        eval_env = make_vec_env(CountingEnv, 3)
        callback = EvalCallback(eval_env, eval_freq=10 if evaluations else 0, n_eval_episodes=3, verbose=0)
        model.learn(20, callback=callback)
        assert len(callback.evaluations_results) == 0 and (callback.last_mean_reward == 28.0) == (evaluations > 0)
        assert model._last_latent is not None and len(model._last_latent.memory) == 1
        memories.append([model._last_latent.action, th.as_tensor(model._last_obs)])
    for one, other in zip(*memories, strict=True):
        th.testing.assert_close(one, other)


def test_evaluate_policy_of_sb3() -> None:
    model = ESADLEND("MlpPolicy", CountingEnv(), **TINY)
    assert evaluate_policy(model, Monitor(CountingEnv()), n_eval_episodes=3) == (28.0, 0.0)
    env = DummyVecEnv([lambda: Monitor(CountingEnv(episode_length=3)), lambda: Monitor(CountingEnv())])
    assert evaluate_policy(model, env, n_eval_episodes=4) == (17.0, 11.0), "as many episodes of either length"


def test_callbacks_can_stop() -> None:
    model = ESADLEND("MlpPolicy", CountingEnv(), **TINY)
    model.learn(40, callback=lambda locals_, globals_: False)
    assert model.num_timesteps == 1
    model.learn(40, reset_num_timesteps=False)
    assert model.num_timesteps == 41


def test_to_go_on_after_a_callback_has_stopped_opens_an_episode() -> None:
    """SB3 does not store the step at which a callback stops, here the last of an episode."""
    model = ESADLEND("MlpPolicy", CountingEnv(), **TINY)
    model.learn(40, callback=StopTrainingOnMaxEpisodes(1))
    model.learn(5, reset_num_timesteps=False)
    assert model.replay_buffer.observations[:11, 0, 0].tolist() == [*range(6), *range(5)]
    assert np.flatnonzero(model.replay_buffer.episode_starts[:11, 0]).tolist() == [0, 6]


def test_checkpoints_keep_the_replay_buffer(tmp_path: Any) -> None:
    callback = CheckpointCallback(16, str(tmp_path), save_replay_buffer=True)
    model = ESADLEND("MlpPolicy", CountingEnv(), **TINY)
    model.learn(16, callback=callback)
    other = ESADLEND.load(tmp_path / "rl_model_16_steps", env=CountingEnv())
    other.load_replay_buffer(tmp_path / "rl_model_replay_buffer_16_steps.pkl")
    np.testing.assert_array_equal(other.replay_buffer.costs, model.replay_buffer.costs)


@pytest.mark.parametrize("log_interval", [1, 2])
def test_log(log_interval: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Long names are cut in the table, and no two of them may become the same."""
    model = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "verbose": 1, "ent_coef": "auto", "penalty_warmup": 0})
    model.learn(42, log_interval=log_interval)
    printed = capsys.readouterr().out
    assert printed.count("ep_cost_mean") == 6 // log_interval
    for name in ("lagrangian_multiplier", "n_updates", "cvar", "cost_critic_loss", "actor_loss", "ep_rew_mean"):
        assert name in printed


def test_training_and_evaluation_mode(monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers such as dropout must know whether the model learns or acts."""
    model = ESADLEND("MlpPolicy", CountingEnv(), **TINY)
    modes: dict[str, set[bool]] = {"act": set(), "_update": set()}
    act, update = LatentAgent.act, model._update_world_model

    def spy_act(*args: Any) -> th.Tensor:
        modes["act"].add(model.policy.training)
        return act(*args)

    def spy_update(*args: Any) -> Any:
        modes["_update"].add(model.policy.training)
        return update(*args)

    monkeypatch.setattr(LatentAgent, "act", spy_act)
    monkeypatch.setattr(model, "_update_world_model", spy_update)
    model.learn(32)
    model.policy.set_training_mode(True)
    model.predict(np.zeros(1, dtype=np.float32))
    assert modes == {"act": {False}, "_update": {True}}
