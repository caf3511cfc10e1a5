"""WCSAC and SAC-Lag: SAC without a limit, and the known optimum of small tasks with one."""

import io
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.envs import FakeImageEnv, IdentityEnv
from stable_baselines3.common.torch_layers import NatureCNN
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack, VecNormalize
from stable_baselines3.her import HerReplayBuffer

from sb3_esad import ESADLEND, WCSAC, SACLag
from sb3_esad.common import functional
from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.evaluation import evaluate_policy
from sb3_esad.common.extractors import SpatialCnn
from sb3_esad.wcsac import CnnPolicy, MlpPolicy, MultiInputPolicy
from tests.conftest import PICTURE, VECTOR, CountingEnv, RandomEnv
from tests.conftest import TINY as TINY_LATENT

TINY: dict[str, Any] = {
    "policy_kwargs": {"net_arch": [8]},
    "learning_starts": 10,
    "buffer_size": 200,
    "batch_size": 8,
    "device": "cpu",
    "seed": 0,
}
SPACES: dict[str, spaces.Space] = {
    "MlpPolicy": VECTOR,
    "CnnPolicy": PICTURE,
    "MultiInputPolicy": spaces.Dict({"camera": PICTURE, "gear": spaces.Discrete(3), "speed": VECTOR}),
}


def make_env(policy: str = "MlpPolicy", n_envs: int = 1) -> DummyVecEnv:
    """Random environments whose luck is the same each time."""
    env = DummyVecEnv([lambda: RandomEnv(SPACES[policy])] * n_envs)
    env.seed(0)
    return env


def make_model(policy: str = "MlpPolicy", env: gym.Env | VecEnv | None = None, **kwargs: Any) -> WCSAC:
    return WCSAC(policy, env or make_env(policy), **{**TINY, **kwargs})


def assert_same_networks(one: SAC, other: SAC) -> None:
    for name in ("actor", "critic", "critic_target"):
        for mine, theirs in zip(getattr(one, name).parameters(), getattr(other, name).parameters(), strict=True):
            assert th.equal(mine, theirs), name


@pytest.mark.parametrize(
    ("policy", "n_envs", "settings"),
    [
        *((policy, n_envs, {}) for policy in SPACES for n_envs in (1, 2)),
        ("MlpPolicy", 1, {"ent_coef": 0.3, "gradient_steps": 3, "target_update_interval": 2}),
        ("MlpPolicy", 2, {"use_sde": True, "gradient_steps": -1, "learning_rate": lambda remaining: 1e-3 * remaining}),
        ("CnnPolicy", 1, {"policy_kwargs": {"net_arch": [8], "share_features_extractor": True}}),
    ],
)
def test_without_a_limit_it_is_sac(policy: str, n_envs: int, settings: dict[str, Any]) -> None:
    """The same seed gives the same steps and the same networks, bit by bit, whatever the cost critics learn."""
    model, sac = (
        algorithm(policy, make_env(policy, n_envs), **{**TINY, "train_freq": 4, **settings, **extra}).learn(40)
        for algorithm, extra in ((WCSAC, {"cost_limit": None}), (SAC, {}))
    )
    np.testing.assert_array_equal(model.replay_buffer.actions, sac.replay_buffer.actions)  # type: ignore[union-attr]
    assert model._n_updates == sac._n_updates > 2
    assert_same_networks(model, sac)
    if sac.log_ent_coef is not None:
        assert th.equal(model.log_ent_coef, sac.log_ent_coef)  # type: ignore[arg-type]


def test_without_a_limit_cost_critics_cannot_do_harm() -> None:
    model = make_model(cost_limit=None)
    for parameter in model.policy.cost_critic.parameters():
        parameter.data.fill_(float("nan"))
    model.learn(40)
    assert all(parameter.isfinite().all() for parameter in model.actor.parameters())


class Gamble(gym.Env):
    """
    An episode is a single step: x from 0 to 1 is earned, and costs 1 with the chance x^2.

    Of the policies whose mean cost is at most D the best one plays x = sqrt(D), with the multiplier 1 / (2 x). For so rare a
    cost the worst fraction alpha of outcomes has a mean of x^2 / alpha: x = sqrt(alpha D), with the multiplier alpha / (2 x).
    """

    observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        x = (float(action[0]) + 1) / 2
        return np.zeros(1, dtype=np.float32), x, True, False, {"cost": float(self.np_random.random() < x * x)}


@pytest.mark.parametrize(("seed", "initial"), [(0, 0.5), (1, 2.0)])
@pytest.mark.parametrize(("algorithm", "alpha"), [(SACLag, 1.0), (WCSAC, 0.5)])
def test_the_optimum_within_the_limit_is_found(algorithm: type[WCSAC], alpha: float, seed: int, initial: float) -> None:
    """Whether the multiplier has to rise or to fall, the actions and it come to what is known."""
    limit, n_envs, warmup, steps, last = 0.2, 16, 10, 500, 200
    env = DummyVecEnv([Gamble] * n_envs)
    env.seed(seed)
    multipliers: list[float] = []

    def note(locals_: dict[str, Any], globals_: dict[str, Any]) -> bool:
        multipliers.append(locals_["self"].penalty.multiplier.item())
        return True

    model = algorithm(
        "MlpPolicy",
        env,
        cost_limit=limit,
        learning_rate=3e-3,
        learning_starts=warmup * n_envs,
        batch_size=128,
        tau=0.05,
        ent_coef=0.02,
        lagrangian_multiplier_init=initial,
        lambda_lr=0.03,
        penalty_warmup=30,
        buffer_size=20_000,
        policy_kwargs={"net_arch": [32]},
        seed=seed,
        device="cpu",
    ).learn((warmup + steps) * n_envs, callback=note)
    assert model.risk_level == alpha
    lately = slice(warmup + steps - last, warmup + steps)
    x = (model.replay_buffer.actions[lately] + 1) / 2
    assert np.mean(x**2) == pytest.approx(alpha * limit, rel=0.15)
    assert np.mean(x) == pytest.approx(np.sqrt(alpha * limit), rel=0.1)
    assert np.mean(multipliers[lately]) == pytest.approx(alpha / (2 * np.sqrt(alpha * limit)), rel=0.4)


class Hazard(gym.Env):
    """
    Every step costs 1 with the same chance, whatever is done.

    :param chance: of the cost
    :param ends: whether a cost ends the episode
    """

    observation_space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, chance: float, ends: bool) -> None:
        self.chance, self.ends = chance, ends
        self.steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        cost = self.np_random.random() < self.chance
        return np.zeros(1, dtype=np.float32), 0.0, bool(cost and self.ends), self.steps == 30, {"cost": float(cost)}


@pytest.mark.parametrize("ends", [True, False])
def test_cost_critics_tell_the_truth(ends: bool) -> None:
    """Mean and deviation of a discounted cost that is known, however much the entropy is worth; a time limit ends nothing."""
    gamma = 0.8
    env = DummyVecEnv([lambda: Hazard(0.1, ends)] * 16)
    env.seed(0)
    settings = {"learning_starts": 4800, "buffer_size": 6000, "tau": 0.1, "learning_rate": 0.01, "ent_coef": 1.0}
    model = make_model(env=env, cost_gamma=gamma, **settings).learn(4800)
    model.train(gradient_steps=250, batch_size=256)
    chance = model.replay_buffer.costs[:300].mean()  # in this record
    goes_on = 1 - chance if ends else 1.0
    mean = chance / (1 - gamma * goes_on)
    variance = chance / (1 - gamma**2 * goes_on) - mean**2 if ends else chance * (1 - chance) / (1 - gamma**2)
    means, variances = model.policy.cost_critic_target(th.zeros(64, 1), 2 * th.rand(64, 1) - 1)
    assert means.mean().item() == pytest.approx(mean, rel=0.1)
    assert variances.sqrt().mean().item() == pytest.approx(variance**0.5, rel=0.1)


class FixedCost(CountingEnv):
    """Every step costs the same."""

    def __init__(self, cost: float) -> None:
        super().__init__(episode_length=5)
        self.cost = cost

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, _ = super().step(action)
        return obs, reward, terminated, truncated, {"cost": self.cost}


@pytest.mark.parametrize(("cost", "direction"), [(0.0, -1), (1.0, 1)])
def test_the_multiplier_falls_when_slack_and_rises_when_violated(cost: float, direction: int) -> None:
    env = DummyVecEnv([lambda: FixedCost(cost)] * 8)
    model = make_model(env=env, penalty_warmup=0, lambda_lr=0.1, train_freq=4).learn(640)
    assert np.sign(model.penalty.multiplier.item() - 2.0) == direction  # type: ignore[union-attr,operator]


def test_decisions_fear_the_larger_estimate() -> None:
    """Twin critics that expect .1 and .3 and a variance of .04: what is feared is the worst half by the second."""
    model = make_model()
    critic = model.policy.cost_critic_target
    for network, chance in zip(critic.means, (0.1, 0.3), strict=True):
        *_, weight, bias = network.parameters()
        weight.data.zero_()
        bias.data.fill_(np.log(chance / (1 - chance)))
    *_, weight, bias = critic.variance.parameters()
    weight.data.zero_()
    bias.data.fill_(np.log(np.expm1(0.04 - 1e-4)))
    risk = model.risk(th.zeros(2, 3), th.zeros(2, 1))
    expected = functional.gaussian_cvar(th.tensor(0.3), th.tensor(0.04), 0.5)
    th.testing.assert_close(risk, expected.expand(2), rtol=1e-4, atol=0)


def test_an_actor_learns_from_its_critics_but_leaves_them_alone() -> None:
    model = make_model(learning_starts=40).learn(40)
    samples: Any = model.replay_buffer.sample(8)
    for network in (model.critic, model.policy.cost_critic):
        network.zero_grad()
    actions, log_prob = model.actor.action_log_prob(samples.observations)
    model._update_actor(samples.observations, actions, 0.1 * log_prob[:, None])
    frozen = (*model.critic.parameters(), *model.policy.cost_critic.parameters())
    assert all(parameter.grad is None for parameter in frozen)
    assert all(parameter.grad is not None for parameter in model.actor.parameters())


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("policy", SPACES)
def test_policies(policy: str, n_envs: int) -> None:
    model = make_model(policy, make_env(policy, n_envs), train_freq=4, penalty_warmup=0).learn(40)
    assert model._n_updates > 0 and model.num_timesteps == 40
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())
    model.learn(8)
    action, _ = model.predict(SPACES[policy].sample(), deterministic=True)
    assert model.action_space.contains(action)


def test_any_features_extractor() -> None:
    """Those of SB3 by default; each network has its own."""
    model = make_model("CnnPolicy")
    extractors = [each.features_extractor for each in (model.actor, model.critic, model.policy.cost_critic.features.readout)]
    assert {type(each) for each in extractors} == {NatureCNN} and len(set(map(id, extractors))) == 3
    policy_kwargs = {"net_arch": [8], "features_extractor_class": SpatialCnn, "features_extractor_kwargs": {"channels": 4}}
    model = make_model("CnnPolicy", train_freq=4, policy_kwargs=policy_kwargs).learn(16)
    assert isinstance(model.policy.cost_critic.features.readout.features_extractor, SpatialCnn)


def test_stacked_frames() -> None:
    """As SB3 stacks them, each stack is stored once."""
    env = VecFrameStack(DummyVecEnv([lambda: FakeImageEnv(2, 36, 36, 1, discrete=False)]), n_stack=4)
    with pytest.warns(UserWarning, match="No cost"):
        model = make_model("CnnPolicy", env, train_freq=4).learn(24)
    assert model.policy.observation_space.shape == (4, 36, 36)
    assert model.replay_buffer.observations.shape == (200, 1, 4, 36, 36)  # type: ignore[union-attr]


def test_normalised_environment() -> None:
    model = make_model(env=VecNormalize(DummyVecEnv([CountingEnv] * 2))).learn(60)
    stored, samples = model.replay_buffer, model.replay_buffer.sample(64, env=model.get_vec_normalize_env())
    assert np.max(stored.observations) == 6  # type: ignore[arg-type]
    assert samples.observations.abs().max() < 6 and samples.rewards.max() < 7  # type: ignore[union-attr]
    assert set(samples.costs.unique().tolist()) == {0.0, 1.0}  # type: ignore[attr-defined]


def test_to_go_on_after_a_callback_has_stopped_opens_an_episode() -> None:
    """SB3 does not store the step at which a callback stops, here the last of an episode."""
    model = make_model(env=CountingEnv())
    model.learn(40, callback=StopTrainingOnMaxEpisodes(1))
    model.learn(5, reset_num_timesteps=False)
    assert np.flatnonzero(model.replay_buffer.episode_starts[:11, 0]).tolist() == [0, 6]


def test_log(capsys: pytest.CaptureFixture[str]) -> None:
    make_model(env=CountingEnv(), verbose=1).learn(42, log_interval=1)
    printed = capsys.readouterr().out
    assert printed.count("ep_cost_mean") == 6
    for name in ("lagrangian_multiplier", "n_updates", "cvar", "cost_critic_loss", "actor_loss", "ent_coef_loss"):
        assert name in printed


def test_evaluation_counts_costs() -> None:
    model = make_model(env=CountingEnv())
    env = DummyVecEnv([CountingEnv])
    assert evaluate_policy(model, env, n_eval_episodes=2, warn=False) == (28.0, 0.0, 2.0)


def test_training_and_evaluation_mode() -> None:
    """Layers such as dropout must know whether the model learns or acts; targets never learn."""
    model = make_model()
    for mode in (True, False):
        model.policy.set_training_mode(mode)
        assert model.policy.cost_critic.training == model.actor.training == mode
        assert not model.policy.cost_critic_target.training


@pytest.mark.parametrize("policy", SPACES)
@pytest.mark.parametrize("ent_coef", ["auto_0.5", 0.1])
def test_everything_comes_back(policy: str, ent_coef: str | float, tmp_path: Path) -> None:
    """Networks, averages, optimisers, entropy coefficient and multiplier, in another number of environments, too."""
    model = make_model(policy, train_freq=4, cost_limit=0.3, cost_key="cost", ent_coef=ent_coef).learn(24)
    model.penalty.multiplier.fill_(7.0)  # type: ignore[operator,union-attr]
    model.save(tmp_path / "model")
    loaded = WCSAC.load(tmp_path / "model", env=make_env(policy, 2))
    saved, restored = model.get_parameters(), loaded.get_parameters()
    assert {"policy", "penalty", "policy.cost_critic.optimizer"} <= saved.keys() == restored.keys()
    for name, value in saved["policy"].items():
        assert th.equal(value, restored["policy"][name])
    assert loaded.penalty.multiplier.item() == 7.0 and loaded.cost_limit == 0.3  # type: ignore[operator,union-attr]
    moments = restored["policy.cost_critic.optimizer"]["state"]
    assert len(moments) > 0 and th.equal(moments[0]["exp_avg"], saved["policy.cost_critic.optimizer"]["state"][0]["exp_avg"])
    observation = SPACES[policy].sample()
    actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
    np.testing.assert_array_equal(*actions)
    loaded.learn(24, reset_num_timesteps=False)
    assert loaded.num_timesteps == 48 and loaded._n_updates > model._n_updates


def test_a_policy_alone_comes_back(tmp_path: Path) -> None:
    for policy, policy_class in (("MlpPolicy", MlpPolicy), ("CnnPolicy", CnnPolicy), ("MultiInputPolicy", MultiInputPolicy)):
        model = make_model(policy)
        assert type(model.policy) is policy_class
        model.policy.save(str(tmp_path / "policy.pt"))
        loaded = policy_class.load(str(tmp_path / "policy.pt"), device="cpu")
        observation = SPACES[policy].sample()
        actions = [each.predict(observation, deterministic=True)[0] for each in (model, loaded)]
        np.testing.assert_array_equal(*actions)


@pytest.mark.parametrize("limit", [None, 0.0])
def test_limits_that_are_false_survive(limit: float | None, tmp_path: Path) -> None:
    SACLag("MlpPolicy", make_env(), **TINY, cost_limit=limit).save(tmp_path / "model")
    loaded = SACLag.load(tmp_path / "model")
    assert loaded.cost_limit == limit and loaded.risk_level == 1.0
    assert type(loaded.penalty).__name__ == ("NoPenalty" if limit is None else "AugmentedLagrangian")


def test_models_of_other_algorithms_are_refused() -> None:
    others = (SAC("MlpPolicy", make_env(), **TINY), ESADLEND("MlpPolicy", make_env(), **TINY_LATENT))
    for other in others:
        file = io.BytesIO()
        other.save(file)
        with pytest.raises(ValueError, match="holds no WCSAC but a model with a policy of"):
            WCSAC.load(file)


def test_replay_buffer(tmp_path: Path) -> None:
    model = make_model().learn(24)
    model.save_replay_buffer(tmp_path / "buffer")
    other = make_model(cost_key="crashed")
    other.load_replay_buffer(tmp_path / "buffer")
    np.testing.assert_array_equal(other.replay_buffer.costs, model.replay_buffer.costs)
    assert other.replay_buffer.read_costs.cost_key == "crashed"
    ESADLEND("MlpPolicy", make_env(), **TINY_LATENT).save_replay_buffer(tmp_path / "windows")
    with pytest.raises(ValueError, match=r"is a SequenceReplayBuffer of 1 .*but the model needs a CostReplayBuffer"):
        other.load_replay_buffer(tmp_path / "windows")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_steps": 3}, "n_steps is 3; choose 1"),
        ({"cost_limit": -1.0}, "cost_limit is -1.0; choose"),
        ({"risk_level": 0.0}, "risk_level is 0.0; choose"),
        ({"gamma": 1.0}, r"cost_gamma is 1.0; choose a discount in \[0, 1\), also where it is gamma"),
        ({"tau": 0.0}, "tau is 0.0; choose"),
        ({"replay_buffer_class": HerReplayBuffer}, "replay_buffer_class is 'HerReplayBuffer'; choose a CostReplayBuffer"),
        ({"replay_buffer_class": SequenceReplayBuffer}, "choose a CostReplayBuffer"),
        ({"replay_buffer_kwargs": {"cost_key": "crashed"}}, "choose it as the argument cost_key"),
        ({"optimize_memory_usage": True}, "optimize_memory_usage=True would lose"),
        ({"policy_kwargs": {"net_arch": {"pi": [8], "qf": []}}}, "at least one hidden layer for the critics"),
    ],
)
def test_what_makes_no_sense_is_refused(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(**arguments)


def test_actions_that_are_no_box_are_refused() -> None:
    with pytest.raises(AssertionError, match="Box"):
        make_model(env=IdentityEnv(3))
