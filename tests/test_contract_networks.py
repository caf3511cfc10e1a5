"""SB3's contract: spaces, pictures, dictionaries, normalisation and networks of every algorithm."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from tests.conftest import PICTURE, VECTOR, CountingEnv, RandomEnv
from tests.contract import Algorithm, every_algorithm, imagines, make

SEVERAL = spaces.Dict({"camera": PICTURE, "gear": spaces.Discrete(4), "speed": VECTOR})


def check(model: Any) -> None:
    """It has learned, is finite, and acts within its space."""
    assert model._n_updates > 0
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    action, _ = model.predict(model.observation_space.sample())
    assert model.action_space.contains(action)


@every_algorithm
@pytest.mark.parametrize(("channels", "first"), [(1, False), (3, True)])
def test_images(algorithm: Algorithm, channels: int, first: bool, tmp_path: Path) -> None:
    """Channels last are put first; a loaded model takes what the environment shows, too."""
    env = FakeImageEnv(2, 40, 40, channels, discrete=False, channel_first=first)
    model = make(algorithm, "CnnPolicy", env, buffer_size=100).learn(24)
    assert isinstance(model.get_env(), VecTransposeImage) != first
    assert model.observation_space.shape == (channels, 40, 40)
    check(model)
    shown, _ = env.reset()
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=env)
    actions = [each.predict(shown, deterministic=True)[0] for each in (model, loaded)]
    np.testing.assert_array_equal(*actions)


@every_algorithm
def test_images_that_are_normalised_already(algorithm: Algorithm) -> None:
    """Floats are no bytes: without ``normalize_images=False`` they are refused."""

    def env() -> VecEnv:
        return VecNormalize(DummyVecEnv([lambda: FakeImageEnv(2, 36, 36, 1, discrete=False, channel_first=True)]))

    check(make(algorithm, "CnnPolicy", env(), buffer_size=100, policy_kwargs={"normalize_images": False}).learn(24))
    with pytest.raises((AssertionError, ValueError), match="normalize_images"):
        make(algorithm, "CnnPolicy", env(), buffer_size=100)


@every_algorithm
def test_dictionaries(algorithm: Algorithm) -> None:
    """Pictures, numbers and vectors, of two environments; what was learned is evaluated."""
    env = DummyVecEnv([lambda: RandomEnv(SEVERAL)] * 2)
    model = make(algorithm, "MultiInputPolicy", env, buffer_size=100).learn(24)
    check(model)
    lengths = evaluate_policy(model, RandomEnv(SEVERAL), n_eval_episodes=2, warn=False, return_episode_rewards=True)[1]
    assert lengths == [9, 9]


@every_algorithm
def test_dictionaries_of_stacked_frames(algorithm: Algorithm) -> None:
    """Pictures are stacked along their channels, which are put first then, and vectors along their length."""
    single = DummyVecEnv([lambda: SimpleMultiObsEnv(discrete_actions=False, channel_last=True)])
    env = VecFrameStack(single, 3, channels_order={"vec": None, "img": "last"})
    model = make(algorithm, "MultiInputPolicy", env, buffer_size=60).learn(24)
    assert model.observation_space["img"].shape == (3, 64, 64) and model.observation_space["vec"].shape == (15,)
    check(model)


@every_algorithm
def test_dictionaries_normalised_in_part(algorithm: Algorithm) -> None:
    env = VecNormalize(VecTransposeImage(DummyVecEnv([lambda: RandomEnv(SEVERAL)])), norm_obs_keys=["speed"])
    model = make(algorithm, "MultiInputPolicy", env, buffer_size=100).learn(24)
    check(model)
    samples = model.replay_buffer.sample(50, env=model.get_vec_normalize_env())
    assert np.abs(model.replay_buffer.observations["speed"]).max() <= 1 < samples.observations["speed"].abs().max()
    assert samples.observations["camera"].max() > 100, "bytes as they are"


@every_algorithm
@pytest.mark.parametrize("several", [False, True])
def test_images_normalised_before_their_channels_are_first(algorithm: Algorithm, several: bool) -> None:
    """SB3 would store them with their axes as they are, and fail at the first of them or at the end of the episode."""
    policy, space, kwargs = (
        ("MultiInputPolicy", SEVERAL, {"norm_obs_keys": ["speed"]}) if several else ("CnnPolicy", PICTURE, {})
    )
    env = VecNormalize(DummyVecEnv([lambda: RandomEnv(space)]), norm_obs=several, **kwargs)
    sentence = (
        r"of shape \(36, 40, 3\), but the model is shown \(3, 36, 40\): .*, by VecNormalize\(VecTransposeImage\(env\)\)\."
    )
    with pytest.raises(ValueError, match=sentence):
        make(algorithm, policy, env, buffer_size=100).learn(24)


@every_algorithm
@pytest.mark.parametrize(
    "seen",
    [spaces.MultiDiscrete([4, 3]), spaces.MultiBinary((3, 2)), spaces.Box(-1.0, 1.0, (2,), np.float64)],
    ids=["MultiDiscrete", "MultiBinary", "float64"],
)
def test_spaces(algorithm: Algorithm, seen: spaces.Space) -> None:
    """Actions may have two dimensions, and 64 bits."""
    done = spaces.Box(-1.0, 1.0, (2, 2), np.float64 if seen.dtype == np.float64 else np.float32)
    model = make(algorithm, env=RandomEnv(seen, done)).learn(24)
    check(model)
    assert model.predict(seen.sample())[0].dtype == done.dtype


@every_algorithm
def test_normalised_environments_follow_one_another(algorithm: Algorithm) -> None:
    """The model knows which one is its own, an evaluation takes over its statistics, and costs stay what they are."""
    env, other = (VecNormalize(DummyVecEnv([CountingEnv] * 2)) for _ in range(2))
    judged = VecNormalize(DummyVecEnv([CountingEnv] * 3), training=False, norm_reward=False)
    model = make(algorithm, env=env)
    assert model.get_vec_normalize_env() is env
    model.set_env(other)
    assert model.get_vec_normalize_env() is other
    model.learn(32, callback=EvalCallback(judged, eval_freq=16, n_eval_episodes=3, warn=False, verbose=0))
    assert judged.obs_rms.mean == other.obs_rms.mean != env.obs_rms.mean and judged.obs_rms.count == other.obs_rms.count
    assert model.replay_buffer.observations.max() == 6
    samples = model.replay_buffer.sample(50, env=other)
    assert samples.observations.abs().max() < 6 and set(samples.costs.unique().tolist()) == {0.0, 1.0}


class Forgetful(BaseFeaturesExtractor):
    """
    Batch normalisation and dropout, which do another thing while a network learns.

    :param observation_space: of vectors
    """

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(observation_space, get_flattened_obs_dim(observation_space))
        self.layers = th.nn.Sequential(th.nn.Flatten(), th.nn.BatchNorm1d(self.features_dim), th.nn.Dropout(0.5))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return self.layers(observations)


def running_means(model: Any) -> dict[str, th.Tensor]:
    return {name: value.clone() for name, value in model.policy.state_dict().items() if name.endswith("running_mean")}


def forgetful(algorithm: Algorithm, **kwargs: Any) -> Any:
    """A model whose environment shows nothing that has the mean 0."""
    env = RandomEnv(spaces.Box(0.5, 1.0, (3,), np.float32))
    return make(algorithm, env=env, policy_kwargs={"features_extractor_class": Forgetful}, **kwargs)


@every_algorithm
def test_to_act_is_not_to_learn(algorithm: Algorithm) -> None:
    """Neither collecting steps nor predicting moves a running mean, and no feature is dropped."""
    model = forgetful(algorithm, learning_starts=4, gradient_steps=0).learn(24)
    model.policy.set_training_mode(True)
    observation = model.observation_space.sample()
    actions = [model.predict(observation, deterministic=True)[0] for _ in range(5)]
    assert len({action.tobytes() for action in actions}) == 1
    means = running_means(model)
    assert len(means) > 1 and not any(mean.any() for mean in means.values())


@every_algorithm
def test_targets_have_the_statistics_of_their_networks(algorithm: Algorithm) -> None:
    """All of them, however slowly their parameters follow."""
    model = forgetful(algorithm)
    model.tau = 0.0
    before = {name: value.clone() for name, value in model.policy.named_parameters() if name.startswith("critic_target")}
    means = running_means(model.learn(24))
    targets = {name for name in means if "_target" in name}
    assert len(before) > 0 and len(targets) > 0 and all(mean.all() for mean in means.values())
    for name in targets:
        assert th.equal(means[name], means[name.replace("_target", "")])
    after = dict(model.policy.named_parameters())
    assert all(th.equal(value, after[name]) for name, value in before.items())


def networks_and_targets(model: Any) -> Iterator[tuple[th.nn.Module, th.nn.Module]]:
    for name, target in model.policy.named_children():
        if name.endswith("_target"):
            yield getattr(model.policy, name.removesuffix("_target")), target


@every_algorithm
def test_targets_follow(algorithm: Algorithm) -> None:
    """From the same start, by ``tau`` at each update; a rate of 0 holds the networks, and the targets come nearer."""
    model = make(algorithm)
    pairs = list(networks_and_targets(model))
    assert {"critic", "cost_critic"} <= {name for name, child in model.policy.named_children() if child in dict(pairs)}

    def vectors() -> list[th.Tensor]:
        return [th.nn.utils.parameters_to_vector(network.parameters()).clone() for pair in pairs for network in pair]

    start = vectors()
    assert all(th.equal(*pair) for pair in zip(start[::2], start[1::2], strict=True))
    model.learn(24)
    learned = vectors()
    assert not any(th.equal(*pair) for pair in zip(learned[::2], learned[1::2], strict=True))
    model.lr_schedule, model.tau = (lambda _: 0.0), 0.25
    model.train(gradient_steps=1, batch_size=4)
    for network, target, held, moved in zip(learned[::2], learned[1::2], vectors()[::2], vectors()[1::2], strict=True):
        assert th.equal(held, network)
        th.testing.assert_close(moved, target + 0.25 * (network - target))


@every_algorithm
@pytest.mark.parametrize("net_arch", [[4], {"qf": [8], "pi": [8, 4]}], ids=str)
def test_networks_of_ones_own(algorithm: Algorithm, net_arch: Any) -> None:
    """And an optimiser, with its arguments."""
    settings = {"net_arch": net_arch, "optimizer_class": th.optim.AdamW, "optimizer_kwargs": {"weight_decay": 0.5}}
    model = make(algorithm, policy_kwargs=settings).learn(24)
    check(model)
    for network in (model.policy.actor, model.policy.critic, model.policy.cost_critic):
        assert type(network.optimizer) is th.optim.AdamW and network.optimizer.defaults["weight_decay"] == 0.5
    n_actor = 2 if imagines(algorithm) else len(net_arch["pi"] if isinstance(net_arch, dict) else net_arch)
    assert sum(isinstance(layer, th.nn.Linear) for layer in model.policy.actor.modules()) >= n_actor


@every_algorithm
def test_networks_without_layers(algorithm: Algorithm) -> None:
    with pytest.raises(ValueError, match=r"net_arch is \[\]; choose at least one hidden layer"):
        make(algorithm, policy_kwargs={"net_arch": []})


@every_algorithm
@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_the_policy_of_another_space(algorithm: Algorithm, policy: str) -> None:
    env: gym.Env = RandomEnv(SEVERAL)
    with pytest.raises(ValueError, match="You must use `MultiInputPolicy`"):
        make(algorithm, policy, env)
