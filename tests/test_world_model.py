"""The world model: what a state may know, what it predicts, and what it looks like."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_esad.common import precision
from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.decoders import ImageHead
from sb3_esad.common.extractors import CombinedExtractor, SpatialCnn, grid_shape
from sb3_esad.common.heads import PredictionHeads, ValueDistribution
from sb3_esad.common.latents import Gaussian, GaussianHead, LatentHead
from sb3_esad.common.policies import LatentCnnPolicy, LatentMultiInputPolicy, LatentPolicy
from sb3_esad.common.rssm import RSSM, Filtered
from sb3_esad.common.starts import EVENT_HORIZON, SETTLING_STEPS, choose_starts
from sb3_esad.common.torch_layers import GridReadout, SparseReadout
from sb3_esad.common.type_aliases import NO_EVENT, LatentState, Predictions, SequenceSamples
from sb3_esad.common.world_model import WorldModel
from tests.conftest import CountingEnv

VECTOR = spaces.Box(-2.0, 2.0, (3,), np.float32)
IMAGE = spaces.Box(0, 255, (3, 32, 40), np.uint8)
DICT = spaces.Dict(
    {
        "front": IMAGE,
        "back": spaces.Box(0, 255, (1, 20, 17), np.uint8),
        "speed": VECTOR,
        "gear": spaces.Discrete(4),
        "lights": spaces.MultiBinary(2),
    }
)
SPACES: dict[str, spaces.Space] = {"vector": VECTOR, "image": IMAGE, "dict": DICT}
ACTIONS = spaces.Box(-1.0, 1.0, (2,), np.float32)


@pytest.fixture
def float32(monkeypatch: pytest.MonkeyPatch) -> None:
    """Full precision, so that equal means equal."""
    monkeypatch.setattr(precision, "has_fast_bfloat16", lambda device: False)


@pytest.fixture
def deterministic(monkeypatch: pytest.MonkeyPatch, float32: None) -> None:
    """Latents are the means of their distributions."""
    monkeypatch.setattr(Gaussian, "sample", lambda self, generator=None: self.mean)


def make_policy(space: spaces.Space, lr: float = 3e-3, **kwargs: Any) -> LatentPolicy:
    policy_class = LatentPolicy
    if isinstance(space, spaces.Dict):
        policy_class = LatentMultiInputPolicy
    elif isinstance(space, spaces.Box) and len(space.shape) == 3 and space.high.max() <= 255:
        policy_class = LatentCnnPolicy
    settings: dict[str, Any] = {"net_arch": [16], "memory_channels": 8, "latent_channels": 4}
    return policy_class(space, ACTIONS, lambda _: lr, **{**settings, **kwargs})


def draw(space: spaces.Space, shape: tuple[int, ...]) -> Any:
    """Random observations of a space, each key of a dictionary apart."""
    if isinstance(space, spaces.Dict):
        return {key: draw(part, shape) for key, part in space.spaces.items()}
    drawn = np.stack([np.atleast_1d(space.sample()) for _ in range(int(np.prod(shape)))])
    return th.as_tensor(drawn.reshape(*shape, *drawn.shape[1:]))


def make_samples(space: spaces.Space, is_first: list[list[int]]) -> SequenceSamples:
    """Windows of random observations; the observation after a step is the next one, unless that opens an episode."""
    n, length = np.shape(is_first)
    space.seed(0)
    observations, next_observations = draw(space, (n, length)), draw(space, (n, length))
    goes_on = ~th.tensor(is_first, dtype=th.bool)[:, 1:]
    keys = list(observations) if isinstance(observations, dict) else [None]
    for key in keys:
        now, after = (observations, next_observations) if key is None else (observations[key], next_observations[key])
        after[:, :-1][goes_on] = now[:, 1:][goes_on]
    ones = th.ones(n, length)
    return SequenceSamples(
        observations=observations,
        next_observations=next_observations,
        actions=2 * th.rand(n, length, 2) - 1,
        rewards=th.rand(n, length),
        costs=(th.rand(n, length) < 0.3).float(),
        continues=ones,
        is_first=th.tensor(is_first, dtype=th.bool),
        event_weights=th.ones(n),
        among_all=th.ones(n, dtype=th.bool),
        time_to_event=th.full((n, length), NO_EVENT),
    )


def seen(samples: SequenceSamples) -> th.Tensor:
    """No step is withheld."""
    return th.zeros_like(samples.is_first.T)


def at(observations: Any, index: Any) -> Any:
    if isinstance(observations, dict):
        return {key: value[index] for key, value in observations.items()}
    return observations[index]


@pytest.mark.parametrize("kind", SPACES)
def test_a_new_episode_ignores_history(kind: str, float32: None) -> None:
    model = make_policy(SPACES[kind]).world_model
    samples = make_samples(SPACES[kind], [[1, 0, 0, 1, 0, 0]] * 3)
    changed = make_samples(SPACES[kind], [[1, 0, 0, 1, 0, 0]] * 3)._replace(actions=samples.actions.clone())
    changed.actions[:, :3] *= -1
    outcomes = []
    for each in (samples, changed, changed._replace(is_first=th.tensor([[1, 0, 0, 0, 0, 0]] * 3) > 0)):
        th.manual_seed(0)
        with th.no_grad():
            outcomes.append(model.observe(each, seen(each)))
    same, other, without_start = (outcome.states.grid for outcome in outcomes)
    th.testing.assert_close(same[3:], other[3:])
    th.testing.assert_close(outcomes[0].before.grid[3:], outcomes[1].before.grid[3:])
    assert not th.isclose(same[:3], other[:3]).all(-1).any()
    assert not th.allclose(same[3:], without_start[3:])


@pytest.mark.parametrize("kind", SPACES)
def test_acting_is_the_training_computation(kind: str, deterministic: None) -> None:
    policy = make_policy(SPACES[kind])
    samples = make_samples(SPACES[kind], [[1, 0, 0, 0, 0], [1, 0, 1, 1, 0], [1, 0, 0, 1, 0]])
    with th.no_grad():
        filtered = policy.world_model.observe(samples, seen(samples))
    state = policy.initial_state(3).map(lambda field: field + 7.0)  # an old memory, to be forgotten
    for t in range(5):
        state = policy.learner.observe(
            at(samples.observations, (slice(None), t)), state, samples.is_first[:, t], deterministic=True
        ).state
        state = state._replace(action=samples.actions[:, t])
        for acted, trained in zip(state, filtered.before, strict=True):
            th.testing.assert_close(acted, trained[t])
    last = policy.learner.observe(
        at(samples.next_observations, (slice(None), -1)), state, th.zeros(3, dtype=th.bool), deterministic=True
    ).state
    th.testing.assert_close(last.grid, filtered.states.grid[-1])


def test_states_lead_to_each_other_within_an_episode() -> None:
    model = make_policy(VECTOR).world_model
    samples = make_samples(VECTOR, [[0, 0, 0, 1, 0, 0]] * 2)
    filtered = model.observe(samples, seen(samples))
    assert filtered.is_first.T.tolist() == [[True, False, False, True, False, False]] * 2
    th.testing.assert_close(filtered.before.grid[[1, 2, 4, 5]], filtered.states.grid[[0, 1, 3, 4]])
    assert not th.allclose(filtered.before.grid[3], filtered.states.grid[2])
    th.testing.assert_close(filtered.before.action, samples.actions.transpose(0, 1))


@pytest.mark.parametrize("kind", ["vector", "image"])
def test_imagining_one_step_is_the_prior(kind: str, deterministic: None) -> None:
    policy = make_policy(SPACES[kind])
    model = policy.world_model
    start = policy.initial_state(5).map(th.randn_like)
    with th.no_grad():
        memory = model.rssm.advance(start)
        expected = LatentState(memory, model.rssm.head.prior(memory).mean, th.zeros(5, 2))
        imagined = model.imagine(start, lambda grid: th.full((len(grid), 2), 0.5), horizon=2, gamma=0.9)
    th.testing.assert_close(model.rssm.imagine(start).grid, expected.grid)
    th.testing.assert_close(imagined.grids[0], start.grid)
    th.testing.assert_close(imagined.grids[1], expected.grid)
    th.testing.assert_close(imagined.grids[2], model.rssm.imagine(expected._replace(action=th.full((5, 2), 0.5))).grid)
    th.testing.assert_close(imagined.actions, th.stack([start.action, *[th.full((5, 2), 0.5)] * 2]))


@pytest.mark.parametrize("temperature", [0.0, 0.5, 1.0])
def test_samples_follow_the_distribution_at_a_temperature(temperature: float) -> None:
    head = make_policy(VECTOR, head_kwargs={"temperature": temperature}).world_model.rssm.head
    memory = th.randn(2, 8, 1, 1)
    with th.no_grad():
        prior, drawn = head.prior(memory), head.sample(memory, n_candidates=4000).unflatten(0, (4000, 2))
    th.testing.assert_close(drawn.mean(0), prior.mean, atol=0.08, rtol=0)
    th.testing.assert_close(drawn.std(0), temperature * prior.std, atol=0.05, rtol=0)


@pytest.mark.parametrize("temperature", [-0.5, 1.5])
def test_an_impossible_temperature_is_refused(temperature: float) -> None:
    with pytest.raises(ValueError, match=f"temperature is {temperature}; choose a factor in"):
        make_policy(VECTOR, head_kwargs={"temperature": temperature})


def test_what_is_observed_has_no_temperature() -> None:
    head = make_policy(VECTOR, head_kwargs={"temperature": 0.0}).world_model.rssm.head
    memory, embedding = th.randn(2, 8, 1, 1), th.randn(2, 8, 1, 1)
    with th.no_grad():
        posterior = head.posterior(memory, embedding)
        drawn = head.sample(memory, embedding, n_candidates=4000).unflatten(0, (4000, 2))
    th.testing.assert_close(drawn.std(0), posterior.std, atol=0.05, rtol=0)


def test_weights_are_the_discounted_chance_to_get_there(deterministic: None) -> None:
    policy = make_policy(VECTOR)
    start = policy.initial_state(3)
    imagined = policy.world_model.imagine(start, policy.actor, horizon=3, gamma=0.9)
    going_on = imagined.predictions.continues
    expected = th.stack([th.ones(3), 0.9 * going_on[0], 0.9**2 * going_on[0] * going_on[1]])
    th.testing.assert_close(imagined.weights, expected)
    assert imagined.grids.shape == (4, 3, 12, 1, 1) and imagined.actions.shape == (4, 3, 2)


def test_withheld_steps_use_the_prior(deterministic: None) -> None:
    model = make_policy(VECTOR).world_model
    samples = make_samples(VECTOR, [[1, 0, 0, 0, 0]] * 2)
    hidden = seen(samples)
    hidden[2:4, 1] = True
    filtered = model.observe(samples, hidden)
    for t in range(5):
        for b in range(2):
            source = filtered.prior if hidden[t, b] else filtered.posterior
            th.testing.assert_close(filtered.states.latent[t, b], source.mean[t, b])
    other = samples._replace(next_observations=samples.next_observations.clone())  # type: ignore[union-attr]
    other.next_observations[1, 2:4] += 1.0  # type: ignore[index]
    unchanged = model.observe(other, hidden).states.grid
    th.testing.assert_close(unchanged, filtered.states.grid)


def test_stretches_that_are_withheld() -> None:
    model = make_policy(VECTOR, world_model_kwargs={"open_loop_length": 4}).world_model
    hidden = model._withhold(th.zeros(12, 4000))
    assert not hidden[0].any(), "a window opens with an observation"
    assert hidden.any(0).all()
    assert hidden.sum(0).max() == 4
    starts_and_ends = hidden.int().diff(dim=0).abs().sum(0) + hidden[-1]
    assert (starts_and_ends == 2).all(), "one stretch, not several"
    assert not model._withhold(th.zeros(1, 50)).any()


def test_a_head_can_infer_again_from_what_its_loss_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make_policy(IMAGE).world_model
    head, caught = model.rssm.head, []

    def catch(*arguments: Any) -> tuple[th.Tensor, dict[str, float]]:
        caught.extend(arguments)
        return th.zeros(()), {}

    monkeypatch.setattr(head, "loss", catch)
    model.loss(make_samples(IMAGE, [[1, 0, 0, 1, 0], [0, 0, 1, 0, 0]]))
    posterior, prior, memory, embedding, _ = caught
    again = head.posterior(memory.flatten(0, 1), embedding.flatten(0, 1))
    th.testing.assert_close(again.mean, posterior.mean.flatten(0, 1))
    th.testing.assert_close(head.prior(memory.flatten(0, 1)).std, prior.std.flatten(0, 1))


class Oracle(LatentHead):
    """The latent is the observation itself."""

    def prior(self, memory: th.Tensor) -> Gaussian:
        return Gaussian(th.zeros_like(memory), th.full_like(memory, 1e-6))

    def embed(self, features: th.Tensor) -> th.Tensor:
        return features

    def posterior(self, memory: th.Tensor, embedding: th.Tensor) -> Gaussian:
        return Gaussian(embedding, th.full_like(embedding, 1e-6))

    def sample(
        self,
        memory: th.Tensor,
        embedding: th.Tensor | None = None,
        n_candidates: int = 1,
        generator: th.Generator | None = None,
    ) -> th.Tensor:
        return th.zeros_like(memory)

    def loss(
        self,
        posterior: Gaussian,
        prior: Gaussian,
        memory: th.Tensor,
        embedding: th.Tensor,
        generator: th.Generator | None = None,
    ) -> tuple[th.Tensor, dict[str, float]]:
        return th.zeros(()), {}


class Identity(BaseFeaturesExtractor):
    """The features are the observation itself."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        return observations.flatten(1)


@pytest.mark.parametrize("time_limit", [5, 1000])
def test_targets_belong_to_the_state_arrived_at(monkeypatch: pytest.MonkeyPatch, time_limit: int) -> None:
    """A state that knows the number of its step predicts the reward, the cost and the end of this very step."""
    env = DummyVecEnv([lambda: CountingEnv(time_limit=time_limit)])
    buffer = SequenceReplayBuffer(100, env.observation_space, env.action_space, "cpu", sequence_length=10)
    obs: Any = env.reset()
    for _ in range(100):
        new_obs, rewards, dones, infos = env.step(np.zeros((1, 1)))
        next_obs: Any = np.array([infos[0]["terminal_observation"]]) if dones[0] else new_obs
        buffer.add(obs, next_obs, np.zeros((1, 1)), rewards, dones, infos)
        obs = new_obs
    rssm = RSSM((1, 1, 1), 1, 1, Oracle())
    model = WorldModel(env.observation_space, Identity(env.observation_space, 1), rssm, units=4)
    caught: list[tuple[th.Tensor, Predictions, th.Tensor]] = []

    def catch(grid: th.Tensor, targets: Predictions, weights: th.Tensor) -> tuple[th.Tensor, dict[str, float]]:
        caught.append((grid, targets, weights))
        return th.zeros(()), {}

    monkeypatch.setattr(model, "_withhold", lambda steps, _: th.zeros_like(steps, dtype=th.bool))
    monkeypatch.setattr(model.predictions, "loss", catch)
    samples = buffer.sample(16)._replace(event_weights=th.arange(16.0))
    model.loss(samples)
    ((grid, targets, weights),) = caught
    count = model.preprocessing.scales["observation"].invert(grid[:, 1, 0]).squeeze(1).round()
    th.testing.assert_close(targets.rewards, count)
    th.testing.assert_close(targets.costs, (count % 3 == 0).float())
    th.testing.assert_close(targets.continues, (count < 7).float())
    assert count.max() == min(7, time_limit)
    assert weights.unflatten(0, (10, 16)).eq(samples.event_weights).all()


def toy_samples(space: spaces.Space, n: int = 8, length: int = 8) -> SequenceSamples:
    """A world that repeats itself every four steps: everything follows from the phase."""
    space.seed(0)
    phase = (th.arange(length + 1) + th.arange(n)[:, None]) % 4
    views = at(draw(space, (4,)), phase)
    first, after = at(views, (slice(None), slice(None, -1))), at(views, (slice(None), slice(1, None)))
    samples = make_samples(space, [[1] + [0] * (length - 1)] * n)
    return samples._replace(
        observations=first, next_observations=after, rewards=phase[:, 1:].float(), costs=(phase[:, 1:] == 2).float()
    )


@pytest.mark.parametrize("kind", SPACES)
def test_learns_a_deterministic_world(kind: str) -> None:
    model = make_policy(SPACES[kind], lr=1e-2, memory_channels=16, net_arch=[32]).world_model
    samples = toy_samples(SPACES[kind])
    losses = []
    for _ in range(50):
        with precision.autocast(th.device("cpu")):
            loss, _, logs = model.loss(samples)
        model.optimizer.zero_grad()
        loss.backward()
        model.optimizer.step()
        losses.append(loss.item())
    assert np.isfinite(losses).all()
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
    assert {"observation_loss", "reward_loss", "cost_loss", "continue_loss", "kl"} <= logs.keys()


@pytest.mark.parametrize(("probability", "oversampled"), [(0.01, False), (0.05, False), (0.05, True)])
def test_cost_head_is_calibrated(probability: float, oversampled: bool) -> None:
    """In spite of the weight on costs, and of windows drawn for their costs, it predicts how often there is one."""
    heads = PredictionHeads((1, 1, 1), 8, cost_weight=10.0, sparsity_weight=0.03)
    n = 1000
    costs = (th.arange(n) < probability * n).float()
    weights = th.ones(n)
    if oversampled:  # half of the batch are costs; the weights are the true over the drawn frequency
        costs = (th.arange(n) % 2).float()
        weights = th.where(costs > 0, probability / 0.5, (1 - probability) / 0.5)
    targets = Predictions(th.zeros(n), costs, 1 - costs)
    optimizer = th.optim.Adam(heads.parameters(), lr=0.02)
    for _ in range(150):
        loss, _ = heads.loss(th.ones(n, 1, 1, 1), targets, weights)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    predictions = heads(th.ones(1, 1, 1, 1))
    assert predictions.costs.item() == pytest.approx(probability, rel=0.05)
    assert predictions.continues.item() == pytest.approx(1 - probability, rel=0.05)


def test_weights_leave_the_reward_alone() -> None:
    heads = PredictionHeads((1, 1, 1), 8, cost_weight=10.0, sparsity_weight=0.03)
    grid, ones = th.randn(6, 1, 1, 1), th.ones(6)
    targets = Predictions(ones, ones, ones)
    _, once = heads.loss(grid, targets, ones)
    _, twice = heads.loss(grid, targets, 2 * ones)
    assert twice["reward_loss"] == pytest.approx(once["reward_loss"])
    assert twice["cost_loss"] == pytest.approx(2 * once["cost_loss"])
    assert twice["continue_loss"] == pytest.approx(2 * once["continue_loss"])


def rare_events(n: int, generator: th.Generator) -> tuple[th.Tensor, th.Tensor]:
    """Grids of noise on 4x4 cells, and whether the first number of one of the cells is high."""
    grids = th.randn(n, 8, 4, 4, generator=generator)
    return grids, (grids[:, 0, 2, 1] > 1.5).float()


def separation(sparsity_weight: float) -> float:
    """How well heads that have seen 20 events tell new ones: the area under the curve."""
    th.manual_seed(0)
    generator = th.Generator().manual_seed(1)
    heads = PredictionHeads((8, 4, 4), 32, cost_weight=10.0, sparsity_weight=sparsity_weight)
    grids, costs = rare_events(300, generator)
    targets, optimizer = Predictions(th.zeros(300), costs, 1 - costs), th.optim.Adam(heads.parameters(), lr=0.01)
    for _ in range(200):
        loss, _ = heads.loss(grids, targets, th.ones(300))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    fresh, labels = rare_events(4000, generator)
    scores = heads(fresh).costs.detach()
    events, others = scores[labels > 0], scores[labels == 0]
    return (events[:, None] > others).float().mean().item()


def test_rare_events_are_understood_instead_of_learned_by_heart() -> None:
    """Twenty events tell which cell matters, if looking at a cell has its price."""
    assert separation(sparsity_weight=0.03) > 0.95
    assert separation(sparsity_weight=0.0) < 0.9


def test_every_cell_has_its_price() -> None:
    readout = SparseReadout((1, 2, 2), 2)
    weight = th.zeros(2, 4)  # a row for each number of the summary, a column for each cell
    weight[:, 1] = th.tensor([3.0, 4.0])
    weight[0, 2] = -2.0
    next(readout.mix.parameters()).data = weight
    assert readout.price().item() == pytest.approx(5.0 + 2.0)
    assert GridReadout((8, 2, 2), 2).price().item() == 0.0


def test_value_distribution_starts_at_zero_and_fits_numbers() -> None:
    distribution = ValueDistribution()
    assert distribution.mean(th.zeros(2, 101)).tolist() == pytest.approx([0.0, 0.0], abs=1e-2)
    values = th.tensor([-300.0, -1.0, 0.0, 0.3, 2000.0])
    logits = th.zeros(5, 101, requires_grad=True)
    optimizer = th.optim.Adam([logits], lr=0.5)
    for _ in range(200):
        optimizer.zero_grad()
        distribution.loss(logits, values).sum().backward()
        optimizer.step()
    th.testing.assert_close(distribution.mean(logits), values, rtol=0.02, atol=0.02)


@pytest.mark.parametrize("shape", [(3, 36, 36), (1, 40, 40), (3, 64, 64), (2, 37, 50), (4, 16, 129)])
def test_pictures_of_any_size(shape: tuple[int, int, int]) -> None:
    space = spaces.Box(0, 255, shape, np.uint8)
    policy = make_policy(space)
    model = policy.world_model
    cells = (-(-shape[1] // 8), -(-shape[2] // 8))
    assert model.rssm.memory_shape == (8, *cells) and model.rssm.latent_shape == (4, *cells)
    state = policy.learner.observe(draw(space, (2,)), policy.initial_state(2), th.ones(2) > 0, deterministic=False).state
    assert state.grid.shape == (2, 12, *cells)
    assert model.reconstruct(state)["observation"].shape == (2, *shape)
    samples = make_samples(space, [[1, 0]] * 2)
    loss, _, _ = model.loss(samples)
    loss.backward()
    gradients = [parameter.grad for parameter in model.features_extractor.parameters()]
    assert all(gradient is not None and gradient.abs().sum() > 0 for gradient in gradients)


def test_extractor_shapes() -> None:
    assert SpatialCnn(IMAGE, channels=5).grid_shape == (5, 4, 5)
    combined = CombinedExtractor(DICT, channels=5, vector_features=7)
    assert combined.grid_shape == (5 + 5 + 3 * 7, 4, 5)
    assert combined(preprocessed(DICT, 3)).shape == (3, combined.features_dim)
    assert grid_shape(Identity(VECTOR, 3)) == (3, 1, 1)


def preprocessed(space: spaces.Dict, n: int) -> dict[str, th.Tensor]:
    """Random observations as SB3's preprocessing leaves them."""
    sizes = {"front": IMAGE.shape, "back": (1, 20, 17), "speed": (3,), "gear": (4,), "lights": (2,)}
    return {key: th.rand(n, *sizes[key]) for key in space.spaces}


def test_what_is_seen_stays_where_it_is() -> None:
    """A change in one corner of the picture reaches the cells of that corner only."""
    extractor = SpatialCnn(spaces.Box(0, 255, (3, 64, 64), np.uint8), channels=6)
    dark, lit = th.zeros(1, 3, 64, 64), th.zeros(1, 3, 64, 64)
    lit[..., :8, 56:] = 1.0
    changed = (extractor(lit) - extractor(dark)).unflatten(1, extractor.grid_shape).abs().sum(1)[0] > 0
    assert changed[0, 7] and changed.sum() <= 4 and not changed[2:].any() and not changed[:, :6].any()


@pytest.mark.parametrize("key", DICT.spaces)
def test_every_part_of_a_dictionary_counts(key: str, float32: None) -> None:
    model = make_policy(DICT).world_model
    observations = preprocessed(DICT, 2)
    changed = {**observations, key: 1 - observations[key]}
    one, other = (model.features_extractor(each).unflatten(1, model.embedding_shape) for each in (observations, changed))
    assert not th.allclose(one, other)
    if key not in ("front", "back"):
        assert ((one != other).any(1) == (one != other).any(1)[:, :1, :1]).all(), "vectors reach all cells alike"


def test_dictionaries_are_reconstructed_by_key() -> None:
    policy = make_policy(DICT)
    shapes = {key: tuple(view.shape) for key, view in policy.world_model.reconstruct(policy.initial_state(2)).items()}
    assert shapes == {"front": (2, 3, 32, 40), "back": (2, 1, 20, 17), "speed": (2, 3), "gear": (2, 4), "lights": (2, 2)}
    assert set(policy.world_model.preprocessing.images(DICT.sample())) == {"front", "back"}


def test_vectors_have_a_single_cell() -> None:
    policy = LatentPolicy(VECTOR, ACTIONS, lambda _: 1e-3)
    rssm = policy.world_model.rssm
    assert (rssm.memory_shape, rssm.latent_shape) == ((256, 1, 1), (32, 1, 1))
    assert rssm.cell.local.kernel_size == (1, 1)


def test_a_flat_extractor_of_the_users_gives_a_flat_memory() -> None:
    policy = make_policy(IMAGE, features_extractor_class=Identity, features_extractor_kwargs={"features_dim": 3 * 32 * 40})
    assert policy.world_model.rssm.memory_shape == (8, 1, 1)
    assert policy.world_model.reconstruct(policy.initial_state(2))["observation"].shape == (2, *IMAGE.shape)


def test_float_images_are_pictures_if_they_are_normalised() -> None:
    space = spaces.Dict({"view": spaces.Box(0.0, 1.0, (3, 32, 32), np.float32)})
    extractor = make_policy(space, normalize_images=False).world_model.features_extractor
    assert isinstance(extractor, CombinedExtractor) and isinstance(extractor.extractors["view"], SpatialCnn)
    policy = make_policy(space["view"], normalize_images=False)
    assert policy.world_model.rssm.memory_shape == (8, 4, 4)
    assert isinstance(policy.world_model.observations["observation"], ImageHead)


def test_a_single_cell_draws_a_whole_picture() -> None:
    head = ImageHead((4, 1, 1), (1, 64, 64), foreground_weight=0.0)
    picture = th.zeros(1, 1, 64, 64)
    picture[..., 32:] = 1.0  # dark on the left, bright on the right
    optimizer = th.optim.Adam(head.parameters(), lr=0.01)
    for _ in range(60):
        loss = head.loss(th.ones(1, 4, 1, 1), picture)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert (head(th.ones(1, 4, 1, 1)) - picture).abs().max() < 0.2


def test_numbers_that_are_no_picture_keep_their_digits() -> None:
    space = spaces.Box(-1e6, 1e6, (2, 3, 3), np.float32)
    model = make_policy(space).world_model
    grid = th.full((1, 2, 3, 3), 5.678912)
    assert th.equal(cast(th.Tensor, model.preprocessing(grid)), grid)


def test_background_is_the_median() -> None:
    """Of each channel; its mean would be 0.68 in the first, 0.16 in the second."""
    head = ImageHead((2, 2, 2), (2, 16, 16), foreground_weight=10.0)
    values = th.tensor([[0.2, 0.6, 1.0], [0.0, 0.1, 0.4]])
    for _ in range(150):
        drawn = th.multinomial(th.tensor([0.1, 0.6, 0.3]), 32 * 2 * 256, replacement=True).view(32, 2, 16, 16)
        head.loss(th.zeros(32, 2, 2, 2), th.stack([values[channel][drawn[:, channel]] for channel in (0, 1)], dim=1))
    th.testing.assert_close(head.background.flatten(), th.tensor([0.6, 0.1]), atol=0.04, rtol=0)


def blind_head(image_shape: tuple[int, int, int]) -> ImageHead:
    """Every pixel is reconstructed as black, which is the usual background too."""
    head = ImageHead((2, 2, 3), image_shape, foreground_weight=10.0)
    th.nn.init.zeros_(head.pixels.weight)
    th.nn.init.zeros_(head.pixels.bias)
    return head


def test_what_is_rare_weighs_more() -> None:
    image = th.zeros(4, 2, 13, 20)
    image[0, 1, 12, 19], image[2, 0, 3, 7] = 0.5, 0.05  # the first differs from the background, the second hardly
    assert blind_head((2, 13, 20)).loss(th.zeros(4, 2, 2, 3), image).item() == pytest.approx((11 * 0.25 + 0.0025) / 4)


@pytest.mark.parametrize(("share", "weight"), [(0.25, 3.0), (0.5, 1.0), (0.75, 1.0), (0.0625, 11.0)])
def test_foreground_and_background_weigh_the_same(share: float, weight: float) -> None:
    """A quarter of the pixels has three times the weight of the others, up to a bound; the majority is never lifted."""
    images = (th.arange(16 * 24) % 16 < 16 * share).float().view(16, 24).expand(3, 1, 16, 24)
    loss = blind_head((1, 16, 24)).loss(th.zeros(3, 2, 2, 3), images).item()
    assert loss == pytest.approx(weight * share * 16 * 24)


def test_pixels_come_back_where_they_were() -> None:
    """The patches in which the loss is taken are those that the reconstruction puts together."""
    head = ImageHead((2, 2, 3), (2, 13, 20), foreground_weight=0.0)
    grid = th.randn(3, 2, 2, 3)
    with th.no_grad():
        reconstruction = head(grid)
        padded = th.nn.functional.pixel_shuffle(head._patches(grid).movedim(-1, 1), 4).square().sum()
        outside = padded - reconstruction.square().sum()
        assert head.loss(grid, reconstruction).item() == pytest.approx(outside.item() / 3, rel=1e-4)


def make_filtered(is_first: list[list[int]], hidden: list[list[int]]) -> Filtered:
    """Filtered windows, given batch-major; the memory of the state before step t of window b is 100 b + t."""
    opens, blind = th.tensor(is_first).T > 0, th.tensor(hidden).T > 0
    opens[0] = True
    length, n = opens.shape
    names = (100 * th.arange(n) + th.arange(length)[:, None]).float()[..., None, None, None]
    state = LatentState(names, names, names[..., 0, 0])
    gaussian = Gaussian(names, names)
    return Filtered(state, state, gaussian, gaussian, names, opens, blind)


def test_settled_states() -> None:
    is_first = [[0, 0, 0, 0, 0, 0], [1, 0, 0, 0, 0, 0], [0, 0, 1, 0, 0, 0], [0, 0, 0, 0, 0, 0]]
    hidden = [[0, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 1, 1, 0, 0]]
    settled = make_filtered(is_first, hidden).settled(3, th.tensor(is_first).T > 0).T.int().tolist()
    assert settled == [
        [0, 0, 0, 1, 1, 1],  # a window that starts within an episode has seen too little at first
        [1, 1, 1, 1, 1, 1],  # where an episode really starts the agent knows no more when it acts
        [0, 0, 1, 1, 1, 1],  # and what was withheld before does not matter then
        [0, 0, 0, 0, 0, 1],  # the states after withheld observations have been imagined
    ]


def drawn_starts(n: int, filtered: Filtered, **fields: Any) -> list[int]:
    """Names of the states that imagination starts from."""
    length, windows = filtered.is_first.shape
    defaults: dict[str, Any] = {
        "is_first": th.zeros(windows, length, dtype=th.bool),
        "among_all": th.ones(windows, dtype=th.bool),
        "time_to_event": th.full((windows, length), NO_EVENT),
        "continues": th.ones(windows, length),
    }
    samples = SimpleNamespace(**{**defaults, **fields})
    starts = choose_starts(cast(SequenceSamples, samples), filtered, n)
    return [int(name) for name in starts.memory.flatten()]


def test_imagination_starts_from_settled_states_half_of_them_usual() -> None:
    filtered = make_filtered([[0] * 8] * 3, [[0] * 8, [0, 0, 0, 0, 1, 1, 0, 0], [0] * 8])
    time_to_event = th.full((3, 8), NO_EVENT)
    time_to_event[2] = th.arange(10, 2, -1)  # within reach of the horizon from its fourth state on
    among_all = th.tensor([True, True, False])
    chosen = drawn_starts(1000, filtered, among_all=among_all, time_to_event=time_to_event)
    usual, dangerous = chosen[:500], chosen[500:]
    assert SETTLING_STEPS == 3 and EVENT_HORIZON == 8
    assert set(usual) == {3, 4, 5, 6, 7, 103, 104, 107}
    assert set(dangerous) == {203, 204, 205, 206, 207}


def test_imagination_starts_where_an_action_was_taken() -> None:
    """The last state of an episode is none of them, its first state is one."""
    is_first = th.tensor([[0, 0, 0, 0, 1, 0, 0, 0]]) > 0
    filtered = make_filtered([[0, 0, 0, 0, 1, 0, 0, 0]], [[0] * 8])
    assert set(drawn_starts(500, filtered, is_first=is_first)) == {3, 4, 5, 6, 7}


def test_without_danger_all_starts_are_usual() -> None:
    filtered = make_filtered([[0] * 6] * 2, [[0] * 6] * 2)
    among_all = th.tensor([True, False])
    assert set(drawn_starts(401, filtered, among_all=among_all)) == {3, 4, 5}
    assert len(drawn_starts(401, filtered, among_all=among_all)) == 401


def test_any_start_is_better_than_none() -> None:
    assert set(drawn_starts(100, make_filtered([[0, 0]], [[0, 0]]))) == {0, 1}


def test_free_nats_stop_the_pull() -> None:
    """Below the free nats neither distribution is moved; above them both are, towards each other."""
    head = GaussianHead((4, 1, 1), 4, 2, 4, free_nats=1.0)
    nothing = (th.zeros(5, 4, 1, 1), th.zeros(5, 4, 1, 1))
    near = Gaussian(th.zeros(5, 2, 1, 1, requires_grad=True), th.ones(5, 2, 1, 1))
    prior = Gaussian(th.zeros(5, 2, 1, 1, requires_grad=True), th.ones(5, 2, 1, 1))
    loss, logs = head.loss(near, prior, *nothing)
    loss.backward()
    assert loss.item() == pytest.approx(0.6) and logs["kl"] == pytest.approx(0.0)
    assert near.mean.grad is not None and (near.mean.grad == 0).all()
    far = Gaussian(th.full((5, 2, 1, 1), 3.0, requires_grad=True), th.ones(5, 2, 1, 1))
    loss, logs = head.loss(far, prior, *nothing)
    assert logs["kl"] == pytest.approx(9.0) and loss.item() == pytest.approx(0.6 * 9.0)
    loss.backward()
    assert far.mean.grad is not None and prior.mean.grad is not None
    assert far.mean.grad.min() > 0 and prior.mean.grad.max() < 0
    th.testing.assert_close(far.mean.grad, -prior.mean.grad / 5)
