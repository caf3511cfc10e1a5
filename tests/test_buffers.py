"""Windows of the sequence buffer, against an environment that counts its steps."""

import io
import pickle
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.type_aliases import NO_EVENT, SequenceSamples
from sb3_esad.common.windows import WindowIndex, event_weights, time_to_event
from tests.conftest import CountingEnv

EPISODE = 7
START = 1000


def make_env(n_envs: int = 1, **kwargs: Any) -> DummyVecEnv:
    return DummyVecEnv([lambda i=i: CountingEnv(start=START * i, **kwargs) for i in range(n_envs)])  # type: ignore[misc]


def make_buffer(env: VecEnv, size: int = 60, length: int = 10, **kwargs: Any) -> SequenceReplayBuffer:
    spaces_ = env.observation_space, env.action_space
    return SequenceReplayBuffer(size, *spaces_, n_envs=env.num_envs, device="cpu", sequence_length=length, **kwargs)


def collect(env: VecEnv, buffers: Sequence[ReplayBuffer], n_steps: int, obs: Any = None) -> Any:
    """Store steps as OffPolicyAlgorithm does: the last frame of an episode takes the place of the reset one."""
    obs = env.reset() if obs is None else obs
    for _ in range(n_steps):
        actions = np.array([env.action_space.sample() for _ in range(env.num_envs)])
        new_obs, rewards, dones, infos = env.step(actions)
        next_obs: Any = new_obs.copy()  # type: ignore[union-attr]
        for i in np.flatnonzero(dones):
            next_obs[i] = infos[i]["terminal_observation"]
        for buffer in buffers:
            buffer.add(obs, next_obs, actions, rewards, dones, infos)
        obs = new_obs
    return obs


def check_windows(samples: SequenceSamples, length: int, opens_first: bool = True) -> None:
    """Everything that can be told from the number of the step."""
    assert isinstance(samples.observations, th.Tensor) and isinstance(samples.next_observations, th.Tensor)
    count = samples.observations.squeeze(-1) % START
    reached = samples.next_observations.squeeze(-1) % START
    assert count.shape[1] == length
    assert (reached == count + 1).all()
    assert (samples.rewards == reached).all()
    assert (samples.costs == (reached % 3 == 0).float()).all()
    assert (samples.continues == (reached != EPISODE).float()).all()
    assert (samples.is_first == (count == 0)).all()
    assert (count[:, 1:] == reached[:, :-1] % EPISODE).all()
    envs = samples.observations.squeeze(-1) // START
    assert (envs == envs[:, :1]).all()


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_steps", [1, 4, 10, 29, 30, 31, 47, 60, 200])
def test_windows_are_contiguous(n_envs: int, n_steps: int) -> None:
    """Young, full and wrapped; were the write head inside a window, the counting would jump there."""
    env = make_env(n_envs, episode_length=EPISODE)
    buffer = make_buffer(env, size=30 * n_envs)
    collect(env, [buffer], n_steps)
    samples = buffer.sample(256)
    check_windows(samples, length=min(10, n_steps))
    assert samples.actions.shape == (256, min(10, n_steps), 1)
    assert samples.is_first.dtype == samples.among_all.dtype == th.bool
    assert samples.time_to_event.dtype == th.int64
    newest = samples.rewards[:, -1].unique()
    if n_steps > 40:
        assert len(newest) == EPISODE


def test_every_start_is_drawn() -> None:
    env = make_env(episode_length=1000)
    buffer = make_buffer(env, size=30)
    collect(env, [buffer], 47)
    starts = buffer.sample(5000).observations[:, 0, 0]  # type: ignore[index]
    assert starts.unique().tolist() == list(range(17, 38))


def test_truncation_continues() -> None:
    env = make_env(time_limit=5)
    buffer = make_buffer(env)
    collect(env, [buffer], 50)
    samples = buffer.sample(64)
    assert (samples.continues == 1).all()
    assert (samples.next_observations[samples.rewards == 5] == 5).all()  # type: ignore[index]
    assert samples.is_first.any()
    without = make_buffer(env, handle_timeout_termination=False)
    collect(env, [without], 50)
    samples = without.sample(64)
    assert (samples.continues == (samples.rewards != 5).float()).all()


def test_episodes_that_look_alike_are_told_apart_by_done() -> None:
    buffer = make_buffer(make_env(), length=4)
    same = np.zeros((1, 1), dtype=np.float32)
    for step in range(20):
        buffer.add(same, same, same, same[0], np.array([step % 5 == 4]), [{"cost": 0.0}])
    assert np.flatnonzero(buffer.episode_starts).tolist() == [0, 5, 10, 15]
    assert not buffer._frames._set_aside


def test_reset_from_outside_opens_an_episode() -> None:
    env = make_env(episode_length=1000)
    buffer = make_buffer(env)
    collect(env, [buffer], 5)
    collect(env, [buffer], 7)
    samples = buffer.sample(500)
    count, reached = samples.observations[..., 0], samples.next_observations[..., 0]  # type: ignore[index]
    assert (reached == count + 1).all() and (samples.continues == 1).all()
    assert (samples.is_first == (count == 0)).all()
    assert samples.is_first[:, 1:].any()


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_steps", [13, 30, 77])
def test_length_one_equals_replay_buffer(n_envs: int, n_steps: int) -> None:
    env = make_env(n_envs, episode_length=EPISODE)
    ours = make_buffer(env, size=30 * n_envs, length=1)
    theirs = ReplayBuffer(30 * n_envs, env.observation_space, env.action_space, "cpu", n_envs)
    collect(env, [ours, theirs], n_steps)
    for name in ("observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
    steps, envs = np.divmod(np.arange(theirs.size() * n_envs), n_envs)
    jumps = ours.episode_starts[(steps + 1) % 30, envs]
    next_obs = ours._frames.get_next(steps[:, None], envs[:, None], jumps[:, None])
    np.testing.assert_array_equal(next_obs[:, 0], theirs.next_observations[steps, envs])
    assert ours.size() == theirs.size() and ours.pos == theirs.pos and ours.full == theirs.full


def test_next_frames_of_unrelated_steps() -> None:
    """SB3's tests store steps that do not continue one another."""
    env = make_env()
    buffer = make_buffer(env, size=8, length=1)
    frames = np.random.rand(20, 2, 1, 1).astype(np.float32)
    for obs, next_obs in frames:
        buffer.add(obs, next_obs, np.zeros((1, 1)), np.zeros(1), np.zeros(1), [{"cost": 0.0}])
    steps = np.arange(12, 20)
    found = buffer._frames.get_next(steps[:, None] % 8, np.zeros((8, 1), dtype=int), np.ones((8, 1), dtype=bool))
    np.testing.assert_array_equal(found[:, 0], frames[12:, 1, 0])
    assert len(buffer._frames._set_aside) == 7


def test_extend() -> None:
    env = make_env()
    buffer = make_buffer(env, length=3)
    obs = np.arange(5, dtype=np.float32).reshape(5, 1, 1)
    zeros = np.zeros((5, 1))
    buffer.extend(obs, obs + 1, zeros, zeros, zeros, [[{"cost": 1.0}]] * 5)
    assert buffer.size() == 5 and buffer.costs[:5].sum() == 5


def add_costs(buffer: SequenceReplayBuffer, costs: np.ndarray, dones: np.ndarray | None = None) -> None:
    """Store given costs; the observation is the number of the step."""
    dones = np.zeros_like(costs) if dones is None else dones
    for step, (cost, done) in enumerate(zip(costs, dones, strict=True)):
        obs = np.full((len(cost), 1), step, dtype=np.float32)
        zeros = np.zeros((len(cost), 1))
        buffer.add(obs, obs + 1, zeros, zeros[:, 0], done, [{"cost": c} for c in cost])


def event_starts(costs: np.ndarray, length: int) -> set[tuple[int, int]]:
    starts = np.ndindex(len(costs) - length + 1, costs.shape[1])
    return {(step, env) for step, env in starts if costs[step : step + length, env].any()}


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("length", [1, 4, 17, 40])
def test_event_windows_equal_brute_force(n_envs: int, length: int) -> None:
    for probability in (0.0, 0.02, 0.2, 1.0):
        costs = np.random.rand(40, n_envs) < probability
        windows = WindowIndex(costs, length)
        expected = event_starts(costs, length)
        assert windows.event_share == pytest.approx(len(expected) / ((41 - length) * n_envs))
        if expected:
            drawn = windows.draw_events(200 * len(expected))
            pairs, counts = np.unique(np.stack(drawn), axis=1, return_counts=True)
            assert {(int(s), int(e)) for s, e in pairs.T} == expected
            assert counts.min() > 100 and counts.max() < 300


def test_half_of_a_batch_has_events() -> None:
    env = make_env()
    buffer = make_buffer(env, size=1000, length=10)
    costs = np.zeros((500, 1))
    add_costs(buffer, costs)
    samples = buffer.sample(16)
    assert samples.among_all.all() and (samples.event_weights == 1).all() and (samples.time_to_event == NO_EVENT).all()
    assert buffer.continue_after_cost == 0.0
    costs[250] = 1
    add_costs(buffer, costs)
    samples = buffer.sample(16)
    assert samples.among_all.tolist() == [True] * 8 + [False] * 8
    assert samples.costs[8:].any(dim=1).all()
    assert buffer.continue_after_cost == 1.0


def test_events_are_found_in_a_wrapped_buffer() -> None:
    buffer = make_buffer(make_env(), size=50, length=5, recency=0.0)
    costs = np.zeros((127, 1))
    costs[[20, 90]] = 1
    add_costs(buffer, costs)
    for _ in range(20):
        samples = buffer.sample(16)
        assert samples.costs[8:].any(dim=1).all()
        has_event = samples.costs.any(dim=1)
        expected = th.where(has_event, 1 / (0.5 + 0.5 * 46 / 5), 2.0)
        th.testing.assert_close(samples.event_weights, expected)


def test_known_weights() -> None:
    weights = event_weights(np.array([True, False]), 0.5, 0.02)
    assert weights.tolist() == pytest.approx([1 / 25.5, 2.0])
    assert weights[0] == pytest.approx(0.0392, abs=1e-4)
    assert event_weights(np.array([False]), 0.0, 0.0).tolist() == [1.0]


@pytest.mark.parametrize(("fraction", "recency"), [(0.25, 0.0), (0.5, 0.0), (0.5, 3.0)])
def test_weights_are_unbiased(fraction: float, recency: float) -> None:
    env = make_env(2)
    buffer = make_buffer(env, size=400, length=8, event_fraction=fraction, recency=recency)
    add_costs(buffer, np.ones((7, 2)))  # of which nothing is left
    costs = (np.random.rand(200, 2) < np.linspace(0.03, 0.0, 200)[:, None]) * np.random.rand(200, 2)
    add_costs(buffer, costs)
    starts = np.lib.stride_tricks.sliding_window_view(costs, 8, axis=0).mean(axis=(1, 2))
    expected = np.average(starts, weights=np.exp(recency * np.arange(len(starts)) / len(starts)))
    weighted, weights = [], []
    for _ in range(2000):
        samples = buffer.sample(16)
        weighted.append((samples.event_weights * samples.costs.mean(dim=1)).mean().item())
        weights.append(samples.event_weights.mean().item())
    assert np.mean(weighted) == pytest.approx(expected, rel=0.04)
    assert np.mean(weights) == pytest.approx(1.0, rel=0.02)
    assert np.std(weighted) / np.sqrt(2000) < 0.02 * expected


def test_what_is_newer_is_drawn_more_often() -> None:
    events = np.random.rand(50, 2) < 0.2
    windows = WindowIndex(events, 3, recency=3.0)
    density = np.exp(3.0 * np.arange(48) / 48)[:, None] * np.ones(2)
    density /= density.sum()
    has_event = np.zeros((48, 2), dtype=bool)
    for step, env in event_starts(events, 3):
        has_event[step, env] = True
    assert windows.event_share == pytest.approx(density[has_event].sum())
    for draw, expected in ((windows.draw, density), (windows.draw_events, density * has_event / density[has_event].sum())):
        counts = np.zeros((48, 2))
        np.add.at(counts, tuple(draw(200_000)), 1)
        assert (counts[expected == 0] == 0).all()
        np.testing.assert_allclose(counts, 200_000 * expected, atol=5 * np.sqrt(200_000 * expected.max()))


def test_a_wrapped_buffer_knows_what_is_new() -> None:
    buffer = make_buffer(make_env(), size=50, length=5, recency=20.0)
    add_costs(buffer, np.zeros((127, 1)))
    assert (buffer.sample(64).observations > 110).float().mean() > 0.9


def test_another_recency_counts_at_once() -> None:
    buffer = make_buffer(make_env(), size=200, length=5, recency=100.0)
    add_costs(buffer, np.zeros((200, 1)))
    assert (buffer.sample(64).observations > 150).all()
    buffer.recency = 0.0
    assert (buffer.sample(64).observations < 100).any()


def test_time_to_event() -> None:
    events = np.array([[0, 0, 1, 0, 0, 1], [0, 0, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0]], dtype=bool)
    lasts = np.array([[0, 0, 1, 0, 0, 0], [0, 1, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0]], dtype=bool)
    never = NO_EVENT
    expected = [[2, 1, 0, 2, 1, 0], [never, never, 2, 1, 0, never], [never] * 6]
    assert time_to_event(events, lasts).tolist() == expected


def test_time_to_event_in_samples() -> None:
    env = make_env(episode_length=EPISODE)
    buffer = make_buffer(env)
    collect(env, [buffer], 60)
    samples = buffer.sample(256)
    reached = samples.rewards.long()
    near = samples.time_to_event < NO_EVENT
    assert ((reached + samples.time_to_event)[near] % 3 == 0).all()
    assert (samples.time_to_event[reached == EPISODE] == NO_EVENT).all()


def test_continue_after_cost_counts_steps() -> None:
    buffer = make_buffer(make_env())
    add_costs(buffer, np.array([[1.0], [0.0], [1.0], [0.2], [1.0]]), np.array([[0], [0], [1], [1], [0]]))
    assert buffer.continue_after_cost == 0.5


def test_continue_after_cost_is_of_the_steps_that_are_left() -> None:
    """Counted as steps come and are overwritten; by brute force, and from nothing after a reset."""
    buffer = make_buffer(make_env(2), size=14, length=5)
    random = np.random.default_rng(0)
    for _ in range(3):
        for _ in range(11):
            add_costs(buffer, random.integers(0, 2, (1, 2)).astype(float), random.integers(0, 2, (1, 2)))
            events = buffer.costs[: buffer.size()] > 0
            left = 1 - buffer.dones[: buffer.size()][events]
            assert buffer.continue_after_cost == (left.mean() if events.any() else 0.0)
        buffer.reset()
        assert buffer.continue_after_cost == 0.0


def test_same_seed_same_samples() -> None:
    env = make_env(2, episode_length=EPISODE)
    buffer = make_buffer(env, size=200)
    collect(env, [buffer], 60)

    def draw() -> SequenceSamples:
        np.random.seed(0)
        return buffer.sample(8)

    for first, second in zip(draw(), draw(), strict=True):
        th.testing.assert_close(first, second, rtol=0, atol=0)


class PictureEnv(CountingEnv):
    """The number of the step as the colour of a picture."""

    observation_space = spaces.Box(0, 255, (3, 64, 64), np.uint8)

    def _observe(self) -> np.ndarray:
        return np.full((3, 64, 64), self.count % 256, dtype=np.uint8)


def test_images_stay_bytes_and_are_stored_once() -> None:
    env = DummyVecEnv([lambda: PictureEnv(episode_length=40)])
    buffer = make_buffer(env, size=2000, length=32)
    collect(env, [buffer], 3000)
    frame_bytes = 2000 * 3 * 64 * 64
    assert len(pickle.dumps(buffer)) <= 1.05 * frame_bytes + 2000 * 64
    assert not hasattr(buffer, "next_observations")
    samples = buffer.sample(4)
    assert samples.observations.dtype == samples.next_observations.dtype == th.uint8  # type: ignore[union-attr]
    assert samples.next_observations.shape == (4, 32, 3, 64, 64)  # type: ignore[union-attr]
    assert (samples.next_observations[:, :, 0, 0, 0] == samples.rewards).all()  # type: ignore[index]


def test_a_young_buffer_needs_little_room_in_a_file() -> None:
    env = DummyVecEnv([lambda: PictureEnv(episode_length=40)])
    buffer = make_buffer(env, size=2000, length=32)
    collect(env, [buffer], 100)
    content = pickle.dumps(buffer)
    assert len(content) <= 1.1 * 100 * 3 * 64 * 64
    loaded = pickle.loads(content)
    assert loaded.observations is loaded._frames.frames and loaded.observations.shape == buffer.observations.shape


class DictEnv(CountingEnv):
    """Three views of the number of the step."""

    observation_space = spaces.Dict(
        {
            "picture": spaces.Box(0, 255, (1, 8, 8), np.uint8),
            "count": spaces.Box(0.0, 1e6, (1,), np.float32),
            "odd": spaces.Discrete(2),
        }
    )

    def _observe(self) -> Any:
        return {
            "picture": np.full((1, 8, 8), self.count, dtype=np.uint8),
            "count": np.array([self.count], dtype=np.float32),
            "odd": self.count % 2,
        }


@pytest.mark.parametrize("n_envs", [1, 2])
def test_dict_observations(n_envs: int) -> None:
    env = DummyVecEnv([lambda: DictEnv(episode_length=EPISODE)] * n_envs)
    buffer = make_buffer(env, size=40 * n_envs)
    theirs = DictReplayBuffer(40 * n_envs, env.observation_space, env.action_space, "cpu", n_envs)  # type: ignore[arg-type]
    obs: Any = env.reset()
    for _ in range(70):
        new_obs, rewards, dones, infos = env.step(np.zeros((n_envs, 1)))
        next_obs: Any = {key: value.copy() for key, value in new_obs.items()}  # type: ignore[union-attr]
        for i in np.flatnonzero(dones):
            for key in next_obs:
                next_obs[key][i] = infos[i]["terminal_observation"][key]
        for each in (buffer, theirs):
            each.add(dict(obs), dict(next_obs), np.zeros((n_envs, 1)), rewards, dones, infos)
        obs = new_obs
    for key, array in theirs.observations.items():
        np.testing.assert_array_equal(buffer.observations[key], array)
    samples = buffer.sample(64)
    assert isinstance(samples.observations, dict) and isinstance(samples.next_observations, dict)
    assert samples.next_observations["picture"].dtype == th.uint8
    assert (samples.next_observations["picture"][:, :, 0, 0, 0] == samples.rewards).all()
    assert (samples.next_observations["count"][..., 0] == samples.rewards).all()
    assert (samples.next_observations["odd"][..., 0] == samples.rewards % 2).all()
    assert (samples.is_first == (samples.observations["count"][..., 0] == 0)).all()


def test_discrete_observations() -> None:
    buffer = SequenceReplayBuffer(10, spaces.Discrete(5), spaces.Box(-1, 1, (2, 2)), "cpu", n_envs=2, sequence_length=2)
    for step in range(4):
        obs = np.array([step, step])
        buffer.add(obs, obs + 1, np.zeros((2, 2, 2)), np.zeros(2), np.zeros(2), [{"cost": 0.0}] * 2)
    samples = buffer.sample(3)
    assert samples.actions.shape == (3, 2, 4)
    assert samples.observations.shape == (3, 2, 1)  # type: ignore[union-attr]


def test_normalisation_leaves_costs_alone() -> None:
    env = VecNormalize(make_env(2, episode_length=EPISODE))
    buffer = make_buffer(env, size=100)
    env.reset()
    for _ in range(40):
        obs = env.get_original_obs()
        _, _, dones, infos = env.step(np.zeros((2, 1)))
        next_obs: Any = env.get_original_obs().copy()
        for i in np.flatnonzero(dones):
            next_obs[i] = env.unnormalize_obs(infos[i]["terminal_observation"])
        buffer.add(obs, next_obs, np.zeros((2, 1)), env.get_original_reward(), dones, infos)
    np.random.seed(1)
    raw = buffer.sample(32)
    np.random.seed(1)
    normalised = buffer.sample(32, env=env)
    np.testing.assert_allclose(normalised.observations, env.normalize_obs(raw.observations.numpy()))  # type: ignore
    np.testing.assert_allclose(normalised.next_observations, env.normalize_obs(raw.next_observations.numpy()))  # type: ignore
    np.testing.assert_allclose(normalised.rewards, env.normalize_reward(raw.rewards.numpy()), rtol=1e-6)
    assert normalised.rewards.dtype == th.float32
    th.testing.assert_close(normalised.costs, raw.costs)


@pytest.mark.parametrize("n_steps", [20, 77])
def test_pickling(n_steps: int) -> None:
    env = make_env(2, episode_length=EPISODE)
    buffer = make_buffer(env)
    obs = collect(env, [buffer], n_steps)
    file = io.BytesIO()
    save_to_pkl(file, buffer)
    file.seek(0)
    loaded = load_from_pkl(file)
    for name in ("observations", "actions", "rewards", "dones", "timeouts", "costs", "episode_starts"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(buffer, name))
    collect(env, [loaded], 5, obs)
    check_windows(loaded.sample(64), length=10)


def test_reset_forgets() -> None:
    env = make_env(episode_length=EPISODE)
    buffer = make_buffer(env)
    collect(env, [buffer], 70)
    buffer.reset()
    assert buffer.size() == 0
    collect(env, [buffer], 12)
    check_windows(buffer.sample(64), length=10)


def test_smallest_buffer() -> None:
    env = make_env(episode_length=EPISODE)
    buffer = make_buffer(env, size=1, length=1)
    collect(env, [buffer], 10)
    check_windows(buffer.sample(4), length=1)


def test_search_for_events_is_fast_with_many_steps() -> None:
    """It is made anew for each batch after a step, about 0.3 ms with 100 000 steps; the bar allows for a busy machine."""
    events = np.random.rand(100_000, 1) < 0.01
    seconds = []
    for _ in range(20):
        start = time.process_time()
        WindowIndex(np.roll(events, -5, axis=0), 32, recency=3.0).draw_events(8)
        seconds.append(time.process_time() - start)
    assert np.median(seconds) < 3e-3


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"optimize_memory_usage": True}, "optimize_memory_usage=True would lose"),
        ({"length": 61}, "sequence_length is 61; choose it from 1 to 60"),
        ({"length": 0}, "sequence_length is 0"),
        ({"event_fraction": 1.0}, "event_fraction is 1.0"),
        ({"recency": -1.0}, "recency is -1.0"),
        ({"recency": 101.0}, "recency is 101.0"),
    ],
)
def test_refuses_what_it_cannot_do(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_buffer(make_env(), **kwargs)


def test_empty_buffer_says_so() -> None:
    with pytest.raises(ValueError, match="empty"):
        make_buffer(make_env()).sample(1)


def test_a_loaded_buffer_draws_as_the_model_asks() -> None:
    wanted, loaded = (
        make_buffer(make_env(), length=length, event_fraction=share, recency=recency)
        for length, share, recency in ((4, 0.25, 3.0), (8, 0.5, 0.0))
    )
    del loaded.recency  # as in a file of a version that had none
    loaded.take_settings_of(wanted)
    assert (loaded.sequence_length, loaded.event_fraction, loaded.recency) == (4, 0.25, 3.0)
