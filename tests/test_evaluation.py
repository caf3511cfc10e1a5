"""Evaluation: every seed once and to its end; tables, dreams, videos and curves of what came of it."""

import re
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import CountingEnv
from gymnasium.wrappers import RecordVideo
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecVideoRecorder

from sb3_esad import ESADLEND, WCSAC, moments
from sb3_esad.common.selection import Selection
from sb3_esad.common.type_aliases import LatentState
from sb3_esad.dream import DreamingDriver
from sb3_esad.driving_evaluation import SeededEpisodes, evaluate_driver, evaluate_model, stack_frames
from sb3_esad.envs.metrics import DrivingMetrics
from sb3_esad.explanation import ExplainedDriver
from sb3_esad.moments import Moment, explaining_frame
from sb3_esad.panels import HEIGHT, PANEL, ROW, WIDTH, Gauge, compose, paint
from sb3_esad.plots import plot_learning_curve
from sb3_esad.progress import Deadline, EpisodeProgressBar, TrainingEpisode
from sb3_esad.report import format_table, summarise_any
from sb3_esad.video import record_driver, record_explanation, record_model, write_video

SEEDS = [5, 0, 12, 7, 3, 9, 1, 30]
TINY = {"net_arch": [8], "memory_channels": 4, "latent_channels": 2}
OBSERVATIONS = {"CnnPolicy": "image", "MlpPolicy": "vector", "MultiInputPolicy": "dict"}
ENV_IDS = {policy: f"short-{name}-v0" for policy, name in OBSERVATIONS.items()}


class SeedEnv(CountingEnv):
    """Counts on from its seed, in an episode of as many steps as the seed, and one more."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        assert seed is not None
        self.start, self.episode_length = 1000 * seed, seed + 1
        return super().reset(seed=seed, options=options)


gym.register("SeedEnv-v0", SeedEnv)
for policy, name in OBSERVATIONS.items():
    kwargs = {"observation": name, "config": {"duration": 3.0}}
    gym.register(ENV_IDS[policy], "sb3_esad.envs.highway:Highway", disable_env_checker=True, kwargs=kwargs)


class Recorder:
    """Counts the steps of each environment's episode in its memory, and checks them with the observation."""

    observation_space, action_space = SeedEnv.observation_space, SeedEnv.action_space

    def get_vec_normalize_env(self) -> None:
        return None

    def predict(self, observation: Any, state: Any, episode_start: Any, deterministic: bool) -> tuple[Any, Any]:
        previous = np.full(len(observation), -1) if state is None else state[0]
        steps = np.where(episode_start, 0, previous + 1)
        running = observation[:, 0] % 1000 > 0
        assert (steps[running] == observation[running, 0] % 1000).all()
        return np.zeros((len(observation), 1), dtype=np.float32), (steps,)


def make_model(policy: str = "CnnPolicy", **kwargs: Any) -> ESADLEND:
    return ESADLEND(policy, ENV_IDS[policy], policy_kwargs=TINY, buffer_size=100, seed=0, **kwargs)


@pytest.fixture(scope="module")
def model() -> ESADLEND:
    return make_model()


@pytest.mark.parametrize("n_envs", [1, 3, 8, 20])
def test_every_seed_is_played_once_and_to_its_end(n_envs: int) -> None:
    records = evaluate_model(Recorder(), "SeedEnv-v0", SEEDS, n_envs=n_envs)  # type: ignore[arg-type]
    assert [record["seed"] for record in records] == SEEDS
    assert [record["steps"] for record in records] == [seed + 1 for seed in SEEDS]
    assert [record["return"] for record in records] == [sum(range(1, seed + 2)) for seed in SEEDS]
    assert [record["cost"] for record in records] == [(seed + 1) // 3 for seed in SEEDS]


def test_frames_are_stacked_as_the_model_was_shown_them() -> None:
    env = VecFrameStack(DummyVecEnv([lambda: gym.make(ENV_IDS["CnnPolicy"])]), 4)
    model = WCSAC("CnnPolicy", env, buffer_size=10, policy_kwargs={"net_arch": [8]}, device="cpu")
    assert model.observation_space.shape == (12, 64, 64)
    records = evaluate_model(model, ENV_IDS["CnnPolicy"], [3, 1])
    assert [record["seed"] for record in records] == [3, 1] and all(record["steps"] > 0 for record in records)


def test_only_what_becomes_the_wanted_space_is_stacked() -> None:
    env = DummyVecEnv([CountingEnv])
    three = gym.spaces.Box(0.0, 1e6, (3,), np.float32)
    stacked = stack_frames(env, three)
    stacked.reset()
    shown = [stacked.step(np.zeros((1, 1)))[0].tolist() for _ in range(2)]  # type: ignore[union-attr]
    assert stacked.observation_space == three and shown == [[[0, 0, 1]], [[0, 1, 2]]]
    for other in (env.observation_space, gym.spaces.Box(0.0, 1.0, (3,), np.float32)):
        assert stack_frames(env, other) is env


def test_finished_episodes_stand_still() -> None:
    env = SeededEpisodes(SeedEnv(), [2])
    env.reset()
    while not env.finished:
        observation, *_ = env.step(np.zeros(1, dtype=np.float32))
    assert observation == 2003
    assert env.reset()[0] == 2000
    assert env.step(np.zeros(1, dtype=np.float32)) == (2000, 0.0, False, False, {})
    assert len(env.records) == 1


def test_evaluation_needs_seeds() -> None:
    with pytest.raises(ValueError, match="no seeds to evaluate"):
        evaluate_model(Recorder(), "SeedEnv-v0", [])  # type: ignore[arg-type]


@pytest.mark.parametrize("policy", ENV_IDS)
def test_evaluate_model_in_all_observations(policy: str) -> None:
    model = make_model(policy)
    records = evaluate_model(model, ENV_IDS[policy], range(3), n_envs=2)
    assert [record["seed"] for record in records] == [0, 1, 2]
    assert all(0 <= record["driving_score"] <= 1 for record in records)


def test_other_models_are_evaluated_too() -> None:
    model = SAC("MlpPolicy", SeedEnv(), policy_kwargs={"net_arch": [4]}, buffer_size=10)
    assert [record["steps"] for record in evaluate_model(model, "SeedEnv-v0", [3, 4])] == [4, 5]


def test_what_was_learned_normalised_is_evaluated_normalised(monkeypatch: pytest.MonkeyPatch) -> None:
    env = VecNormalize(DummyVecEnv([lambda: CountingEnv()]))
    env.obs_rms.mean, env.obs_rms.var = np.array([3000.0]), np.array([4.0])
    model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": [4]}, buffer_size=10)
    seen = []
    monkeypatch.setattr(
        model, "predict", lambda observation, *_: (seen.append(observation.item()), (np.zeros((1, 1)), None))[1]
    )
    evaluate_model(model, "SeedEnv-v0", [3])
    assert seen == pytest.approx([0.0, 0.5, 1.0, 1.5], abs=1e-6)


def test_evaluate_model_refuses_another_environment(model: ESADLEND) -> None:
    with pytest.raises(ValueError, match=r"Observations of short-vector-v0 are Box.*trained on Box.*; give the id"):
        evaluate_model(model, "short-vector-v0", [0])


@pytest.mark.parametrize("name", ["keeper", "random"])
def test_evaluate_driver_is_a_plain_loop(name: str) -> None:
    records = evaluate_driver(name, "short-image-v0", [3, 1])
    again = evaluate_driver(name, "short-image-v0", [1, 3])
    assert records == again[::-1]


def test_records_are_those_of_the_scenario() -> None:
    env = DrivingMetrics(gym.make("short-image-v0"))
    env.reset(seed=4)
    while not env.records:
        env.step(np.array([0.0, 1.0]))
    seeded = SeededEpisodes(gym.make("short-image-v0"), [4])
    seeded.reset()
    while not seeded.finished:
        seeded.step(np.array([0.0, 1.0]))
    assert seeded.records == [{"seed": 4, **env.records[0]}]


def test_scripted_drivers_need_a_scenario() -> None:
    with pytest.raises(ValueError, match=r"SeedEnv-v0 is no driving scenario; .* starts with esad-"):
        evaluate_driver("reference", "SeedEnv-v0", [0])


def test_table_of_any_environment() -> None:
    figures = summarise_any([{"return": 1.0, "cost": 0.0, "steps": 4.0}, {"return": 3.0, "cost": 1.0, "steps": 6.0}])
    assert (figures["return"], figures["cost"], figures["steps"]) == (2, 0.5, 5)
    assert figures["return_low"] < 2 < figures["return_high"]
    lines = format_table({"mine": figures, "another's": figures}).splitlines()
    assert len({len(line) for line in lines}) == 1, "columns are aligned"
    assert [re.split(r" {2,}| \|", line)[0] for line in lines[2:]] == [
        "| return ↑",
        "| cost per episode ↓",
        "| steps per episode",
    ]
    assert "2.0 [-10.7, 14.7]" in lines[2]


def test_table_of_a_scenario() -> None:
    table = format_table({"holds": summarise_any(evaluate_driver("keeper", "short-image-v0", [0, 1]))})
    for label in ("driving score DS [%]", "episodes without collision [%]", "TTC, 5th percentile [s]", "cost, worst tenth"):
        assert label in table


def latent(driver: DreamingDriver) -> tuple[LatentState, LatentState]:
    return driver._state, driver._dream


def test_dream_starts_from_the_memory_and_goes_on_alone(model: ESADLEND) -> None:
    env = gym.make("short-image-v0")
    driver = DreamingDriver(model, dream_length=3)
    memory, dreams = None, [model.policy.initial_state(1)]
    for step in range(7):
        observation, _ = env.reset(seed=step)
        action = driver(observation)
        expected, memory = model.predict(observation, state=memory, deterministic=True)
        np.testing.assert_array_equal(action, expected)
        state, dream = latent(driver)
        assert driver.blind_steps == step % 3
        th.testing.assert_close(dream.action, th.as_tensor(action)[None])
        assert th.equal(dream.latent, state.latent) == (step % 3 == 0)
        assert th.equal(dream.memory, state.memory) == (step % 3 < 2)  # which depends on what was before
        if step % 3:
            th.testing.assert_close(
                dream.memory, model.policy.world_model_target.rssm.advance(dreams[-1]), msg="it sees nothing"
            )
        dreams.append(dream)
    assert 0 <= driver.risk() <= 1
    assert driver.reconstruction()["observation"].shape == driver.dream()["observation"].shape == (1, 3, 64, 64)


def test_paint_tells_cars_from_the_agent() -> None:
    observation = np.zeros((3, 64, 64))
    observation[1, 5, 10] = observation[2, 50, 32] = observation[0, 50, 10] = 0.5
    picture = paint(observation).astype(int)
    car, agent, line, grass = picture[10, 63 - 5], picture[32, 63 - 50], picture[10, 63 - 50], picture[0, 0]
    assert car.argmax() == 2 and agent.argmax() == 1
    assert np.ptp(line) < 10 < line.min() - grass.max()


def test_compose_has_the_size_of_a_video_frame() -> None:
    scene = np.zeros((320, 960, 3), dtype=np.uint8)
    picture = compose(
        scene, {"seen": np.full((64, 64, 3), 200, np.uint8)}, [Gauge("risk", "1 %", 2.0, 0.5, (255, 0, 0))], "Arrived"
    )
    assert picture.shape == (HEIGHT + ROW, WIDTH, 3)
    assert (picture == 200).all(-1).sum() == PANEL[0] * PANEL[1]


def read_video(path: Path) -> tuple[int, tuple[int, ...], str]:
    video = cv2.VideoCapture(str(path))
    code = int(video.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little").decode()
    frames = []
    while (read := video.read())[0]:
        frames.append(read[1])
    return len(frames), frames[0].shape, code


@pytest.mark.parametrize("policy", ["CnnPolicy", "MultiInputPolicy"])
def test_record_model(policy: str, tmp_path: Path) -> None:
    model, env_id = make_model(policy), ENV_IDS[policy]
    record_model(tmp_path / "episode.mp4", model, env_id, seed=3)
    n_frames, shape, code = read_video(tmp_path / "episode.mp4")
    steps = int(evaluate_model(model, env_id, [3])[0]["steps"])
    assert steps < n_frames <= steps + 10
    assert shape == (HEIGHT + ROW, WIDTH, 3)
    assert code in ("h264", "avc1")
    assert [path.name for path in tmp_path.iterdir()] == ["episode.mp4"]


def test_a_film_shows_the_model_what_it_was_trained_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    env_id = ENV_IDS["MultiInputPolicy"]
    env = VecNormalize(DummyVecEnv([lambda: gym.make(env_id)]), norm_obs_keys=["vector"])
    env.obs_rms["vector"].mean += 0.5  # type: ignore[index]
    model, seen = ESADLEND("MultiInputPolicy", env, policy_kwargs=TINY, buffer_size=100), []
    predict = model.predict
    monkeypatch.setattr(model, "predict", lambda observation, *args, **kwargs: (
        seen.append(observation["vector"].ravel()) or predict(observation, *args, **kwargs)))  # fmt: skip
    evaluate_model(model, env_id, [3])
    n_steps = len(seen)
    record_model(tmp_path / "episode.mp4", model, env_id, seed=3)
    np.testing.assert_array_equal(seen[n_steps], seen[0])
    assert seen[0].max() < 0.9, "the presence of others is 1"


def test_what_is_explained_is_what_is_done(model: ESADLEND) -> None:
    env = gym.make("short-image-v0")
    driver, memory = ExplainedDriver(model, n_futures=5, horizon=3), None
    for step in range(4):
        observation, _ = env.reset(seed=step)
        action = driver(observation)
        expected, memory = model.predict(observation, state=memory, deterministic=True)
        np.testing.assert_allclose(action, expected, rtol=1e-6)
    futures = driver.futures()
    assert th.equal(futures.costs, futures.costs.sort(descending=True).values)
    assert futures.images["observation"].shape == (5, 3, 64, 64)
    assert driver.tail(futures) == pytest.approx(futures.costs[:3].mean().item())  # of 5 the worst half
    th.testing.assert_close(driver.futures().costs, futures.costs, msg="the same moment is explained by the same futures")


@pytest.mark.parametrize(
    ("risk", "intervened", "helpless", "words", "label"),
    [
        (np.nan, False, False, "Filter: at rest, for its critics are not trusted", "mean of the futures"),
        (0.001, False, False, "Filter: the actor's own action", "as the filter judged the actor's"),
        (0.3, True, False, "Filter: another action taken", "as the filter judged the actor's"),
        (0.3, True, True, "Filter: nothing is safe, least risk taken", "as the filter judged the actor's"),
    ],
)
def test_the_film_tells_what_the_filter_has_done(
    risk: float, intervened: bool, helpless: bool, words: str, label: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Any] = []
    monkeypatch.setattr(moments, "compose", lambda scene, panels, gauges, *text: shown.extend([panels, gauges]))
    env = gym.make("short-image-v0", render_mode="rgb_array")
    driver = ExplainedDriver(make_model("CnnPolicy", filter_start=0))
    observation, info = env.reset(seed=0)
    driver(observation)
    driver.selection = Selection(driver.selection.actions, *(th.tensor([value]) for value in (intervened, helpless, risk)))
    explaining_frame(Moment(env, observation, info, 0.0, ""), driver)
    panels, gauges = shown
    assert words in panels
    (gauge,) = (each for each in gauges if each.label.startswith(label))
    assert np.isnan(risk) or gauge.label.endswith(f"at most {100 * driver.model.penalty.budget_scale:.2f} %")
    assert np.isnan(risk) or gauge.text == f"{100 * risk:.1f} %"


def test_record_explanation(model: ESADLEND, tmp_path: Path) -> None:
    record_explanation(tmp_path / "why.mp4", model, "short-image-v0", seed=3)
    n_frames, shape, _ = read_video(tmp_path / "why.mp4")
    assert n_frames > 10 and shape == (HEIGHT + 2 * ROW, WIDTH, 3)


def test_record_driver(tmp_path: Path) -> None:
    record_driver(tmp_path / "random.mp4", "random", "short-vector-v0", seed=3)
    assert read_video(tmp_path / "random.mp4")[1] == (320, 960, 3)


def test_record_model_needs_an_image(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="short-vector-v0 has no image"):
        record_model(tmp_path / "episode.mp4", make_model("MlpPolicy"), "short-vector-v0", 0)


@pytest.mark.parametrize("env_id", ["short-vector-v0", "short-dict-v0"])
def test_record_model_refuses_another_environment(env_id: str, model: ESADLEND, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"Observations of {env_id} are .*trained on Box.*; give the id"):
        record_model(tmp_path / "episode.mp4", model, env_id, 0)
    assert not list(tmp_path.iterdir())


def test_videos_are_mp4(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"episode\.gif is no MP4"):
        record_driver(tmp_path / "episode.gif", "keeper", "short-image-v0", 0)


def test_broken_video_leaves_nothing(tmp_path: Path) -> None:
    def frames() -> Any:
        yield np.zeros((32, 32, 3), dtype=np.uint8)
        raise RuntimeError("the scenario broke")

    with pytest.raises(RuntimeError, match="the scenario broke"):
        write_video(tmp_path / "episode.mp4", frames(), 5)
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("ignore:rich is experimental")
def test_training_is_followed(tmp_path: Path) -> None:
    model = make_model("MlpPolicy", learning_starts=10_000)
    bar = EpisodeProgressBar()
    history = bar.history
    assert history.recent() is None
    model.learn(150, callback=bar)
    assert len(history.episodes) >= 2
    last = history.episodes[-1]
    assert last.step <= 150 and 0 < last.driving_score < 100
    assert sum(each.cost for each in history.episodes) == model.total_cost
    assert last.total_reward == pytest.approx(model.ep_info_buffer[-1]["r"])  # type: ignore[index]
    recent = history.recent(2)
    assert recent is not None and recent.total_reward == np.mean([each.total_reward for each in history.episodes[-2:]])
    plot_learning_curve(tmp_path / "curve.png", history.episodes, cost_limit=0.05)
    assert cv2.imread(str(tmp_path / "curve.png")).std() > 10


@pytest.mark.parametrize(("steps", "seconds_a_step", "done"), [(1000, 1.0, 60), (40, 1.0, 40), (40, 0.01, 40)])
def test_schedules_end_with_the_time(steps: int, seconds_a_step: float, done: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of the test goes on by each look at it; a minute is given."""
    clock = count(0.0, seconds_a_step)
    monkeypatch.setattr("sb3_esad.progress.time.monotonic", lambda: next(clock))
    model = make_model("MlpPolicy", learning_starts=10_000)
    remaining: list[float] = []
    update = model._update_current_progress_remaining

    def note(num_timesteps: int, total_timesteps: int) -> None:
        update(num_timesteps, total_timesteps)
        remaining.append(model._current_progress_remaining)

    monkeypatch.setattr(model, "_update_current_progress_remaining", note)
    model.learn(steps, callback=Deadline(minutes=1))
    assert model.num_timesteps == done
    assert remaining == pytest.approx([1 - (step + 1) / done for step in range(len(remaining))], abs=0.02)
    assert len(remaining) >= done - 1


@pytest.mark.parametrize("cost_limit", [0.05, None])
def test_learning_curve_of_few_episodes(tmp_path: Path, cost_limit: float | None) -> None:
    plot_learning_curve(tmp_path / "curve.png", [TrainingEpisode(10, 1.0, 0.0, float("nan"))], cost_limit)
    assert (tmp_path / "curve.png").exists()
    with pytest.raises(ValueError, match="No training episode has ended"):
        plot_learning_curve(tmp_path / "none.png", [], cost_limit)


def test_records_count_the_cost_that_was_asked_for() -> None:
    class TwoCosts(CountingEnv):
        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
            observation, reward, terminated, truncated, info = super().step(action)
            return observation, reward, terminated, truncated, {**info, "bump": 0.5, "driving": {"cost": 68.0}}

    env = SeededEpisodes(TwoCosts(episode_length=4), [0], cost_key="bump")
    env.reset()
    for _ in range(4):
        env.step(env.action_space.sample())
    assert [record["cost"] for record in env.records] == [2.0]


def test_the_recorders_of_gymnasium_and_sb3_film_a_scenario(tmp_path: Path) -> None:
    env = RecordVideo(gym.make("short-vector-v0", render_mode="rgb_array"), str(tmp_path / "gymnasium"), disable_logger=True)
    env.reset(seed=0)
    while not any(env.step(np.zeros(2, dtype=np.float32))[2:4]):
        pass
    env.close()
    vec_env = DummyVecEnv([lambda: gym.make("short-vector-v0", render_mode="rgb_array")])
    film = VecVideoRecorder(vec_env, str(tmp_path / "sb3"), record_video_trigger=lambda step: step == 0, video_length=5)
    film.reset()
    for _ in range(6):
        film.step(np.zeros((1, 2), dtype=np.float32))
    film.close()
    for folder in ("gymnasium", "sb3"):
        (path,) = (tmp_path / folder).glob("*.mp4")
        n_frames, shape, _ = read_video(path)
        assert n_frames >= 5 and shape == (320, 960, 3)
