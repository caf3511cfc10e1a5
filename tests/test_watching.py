"""Every key is explained; films, histograms and the bar show what happened; what goes wrong is said once."""

import io
import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from PIL import Image
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage

from sb3_esad import ESADLEND, WCSAC
from sb3_esad.common import image_watch
from sb3_esad.common.buffers import SequenceReplayBuffer
from sb3_esad.common.callbacks import CostEvalCallback
from sb3_esad.common.image_watch import ImageWatch
from sb3_esad.film import ALONE, SEEN, side_by_side
from sb3_esad.progress import EpisodeProgressBar
from sb3_esad.watching import WatchCallback, imagine_episode
from tests.conftest import PICTURE, TINY, VECTOR, VIEWS, CountingEnv, RandomEnv, assert_same
from tests.test_callbacks import Recorder

PAGE = (Path(__file__).parents[1] / "docs" / "watching.md").read_text()
SMALL = {"learning_starts": 10, "buffer_size": 200, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "device": "cpu"}


class Succeeding(RandomEnv):
    """Tells at the end of each episode whether it was a success."""

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, {**info, "is_success": True}


class FakeOutput(TensorBoardOutputFormat):
    """A TensorBoard that keeps what is written to it."""

    def __init__(self) -> None:
        self.writer = self.file_writer = self  # type: ignore[assignment]
        self.films: list[tuple[str, Any, int]] = []
        self.histograms: list[tuple[str, th.Tensor, int]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0) -> None:
        self.histograms += [(key, each, step) for key, each in key_values.items() if isinstance(each, th.Tensor)]

    def add_summary(self, summary: Any, step: int) -> None:
        self.films += [(value.tag, value.image, step) for value in summary.value]

    def flush(self) -> None:
        pass

    def close(self) -> None:
        pass


def watched(model: OffPolicyAlgorithm, *outputs: Any) -> FakeOutput:
    fake = FakeOutput()
    model.set_logger(Logger(folder=None, output_formats=[fake, *outputs]))
    return fake


def make_latent(space: spaces.Space, n_envs: int = 1, **kwargs: Any) -> ESADLEND:
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "CnnPolicy" if space is PICTURE else "MlpPolicy"
    return ESADLEND(policy, DummyVecEnv([lambda: Monitor(Succeeding(space))] * n_envs), **{**TINY, **kwargs})


def logged_keys(model: OffPolicyAlgorithm, steps: int) -> set[str]:
    """All that is logged where everything is switched on."""
    recorder = Recorder()
    output = watched(model, recorder)
    model.penalty.calibration_band = (0.0, np.inf)
    model.penalty.min_episodes, model.penalty.episodes.road_steps = 1, 10
    eval_env = VecTransposeImage(DummyVecEnv([lambda: Monitor(Succeeding(PICTURE))]))
    evaluation = CostEvalCallback(eval_env, eval_freq=30, n_eval_episodes=1, verbose=0)
    model.learn(steps, callback=[evaluation, WatchCallback(every=30)], log_interval=1)
    return recorder.values.keys() | {key for key, _, _ in (*output.films, *output.histograms)}


def test_the_page_explains_every_key_that_there_is() -> None:
    rows = re.findall(r"^\| `([a-z_]+/[a-z_]+)` \| ([AEW]) \|", PAGE, re.MULTILINE)
    kwargs: dict[str, Any] = TINY["policy_kwargs"]
    latent = make_latent(PICTURE, filter_start=0, policy_kwargs={**kwargs, "head_kwargs": {"diffusion_steps": 1}})
    wcsac = WCSAC("CnnPolicy", Succeeding(PICTURE), **SMALL)
    for model, letter in ((latent, "E"), (wcsac, "W")):
        assert logged_keys(model, 70) == {key for key, by in rows if by in ("A", letter)}
    assert len(rows) == len({key for key, _ in rows})


# Films and histograms


def test_the_latest_episode_that_has_ended() -> None:
    """Of two environments, in a ring that has gone round: the second's began last, but in the first it has not ended."""
    space, action = CountingEnv.observation_space, CountingEnv.action_space
    buffer = SequenceReplayBuffer(40, space, action, "cpu", n_envs=2, sequence_length=4)
    assert buffer.latest_episode(9) is None
    for step in range(50):
        count = np.array([[step % 8], [100 + step % 6]], dtype=np.float32)
        done = np.array([step % 8 == 7, step % 6 == 5])
        buffer.add(count, count + 1, count / 200, np.zeros(2), done, [{"cost": 0.0}] * 2)
    for length, expected in ((9, range(100, 106)), (3, range(100, 103))):
        episode = buffer.latest_episode(length)
        assert episode is not None
        before, after, actions = episode
        assert before.flatten().tolist() == list(expected)  # type: ignore[union-attr]
        assert after.flatten().tolist() == [each + 1 for each in expected]  # type: ignore[union-attr]
        th.testing.assert_close(actions, before / 200)  # type: ignore[operator]


@pytest.mark.parametrize("space", [PICTURE, VIEWS], ids=["image", "dictionary"])
def test_what_is_imagined_depends_on_the_looks_alone(space: spaces.Space) -> None:
    model = make_latent(space).learn(24)
    episode = model.replay_buffer.latest_episode(8)
    assert episode is not None
    before, after, actions = episode
    state = th.get_rng_state()
    pictures = [imagine_episode(model.policy, before, blinded(after, looks), actions, 3) for looks in (99, 2, 1)]
    assert th.equal(th.get_rng_state(), state)
    for key, shown in pictures[0].items():
        assert len(shown) == len(actions) + 1
        assert th.equal(pictures[1][key], shown), "from the fourth observation on nothing is seen"
        assert th.equal(pictures[2][key][:2], shown[:2]) and not th.equal(pictures[2][key][2], shown[2])


def blinded(observations: Any, looks: int) -> Any:
    if isinstance(observations, dict):
        return {key: blinded(each, looks) for key, each in observations.items()}
    return th.where(th.arange(len(observations)).view(-1, *[1] * (observations.dim() - 1)) < looks, observations, 0)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 6])
def test_pictures_beside_each_other(channels: int) -> None:
    """The newest of a stack, enlarged without smoothing."""
    real, imagined = th.zeros(3, channels, 50, 40), th.ones(3, channels, 50, 40)
    real[1, -1, 0, 0] = 0.5
    film = side_by_side(real, imagined, looks=2)
    assert film.shape == (3, 150, 120 + 4 + 120, 3)
    corner = [0, 0, 128] if channels % 3 == 0 else [128] * 3
    assert film[1, 2, 2].tolist() == corner and film[1, 3, 3].tolist() == film[0, 2, 2].tolist() == [0, 0, 0]
    assert (film[:, :, 124:] == 255).all()
    assert [tuple(frame[0, 121]) for frame in film] == [SEEN, SEEN, ALONE]


def test_films_show_what_happened() -> None:
    model = make_latent(PICTURE)
    output = watched(model)
    model.learn(60, callback=WatchCallback(every=25, length=6, looks=2), log_interval=1)
    assert [(key, step) for key, _, step in output.films] == [("imagination/film_observation", step) for step in (25, 50)]
    film = Image.open(io.BytesIO(output.films[-1][1].encoded_image_string))
    assert film.n_frames == 7 and film.size == (output.films[-1][1].width, output.films[-1][1].height)  # type: ignore[attr-defined]
    before, _, _ = model.replay_buffer.latest_episode(6) or pytest.fail()  # that of step 50 has ended at 45, and 54 is later
    assert before.shape == (6, 3, 36, 40)  # type: ignore[union-attr]


def test_a_watched_training_is_the_same() -> None:
    parameters = []
    for callback in (None, WatchCallback(every=10)):
        model = make_latent(PICTURE)
        watched(model)
        model.learn(60, callback=callback)
        parameters.append(model.get_parameters())
    assert_same(*parameters)


@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_histogram_has_every_step_of_the_policy_once(n_envs: int) -> None:
    model = make_latent(VECTOR, n_envs)
    output, risks = watched(model), Risks()
    model.learn(80, callback=[WatchCallback(every=2), risks], log_interval=1)
    assert not output.films
    assert {key for key, _, _ in output.histograms} == {"safety/risk"}
    shown = th.cat([each for _, each, _ in output.histograms])
    assert len(shown) > 30 and th.equal(shown, th.cat(risks.values)[: len(shown)])


class Risks(BaseCallback):
    """Asks the model itself what it fears."""

    model: Any

    def __init__(self) -> None:
        super().__init__()
        self.values: list[th.Tensor] = []

    def _on_step(self) -> bool:
        if self.num_timesteps - self.training_env.num_envs >= self.model.learning_starts and self.model._n_updates > 0:
            actions = th.as_tensor(self.locals["buffer_actions"])
            with th.no_grad():
                self.values.append(self.model.risk(self.model._last_state(), actions))
        return True


def test_what_cannot_be_watched_is_refused() -> None:
    with pytest.raises(ValueError, match="ESADLEND has tensorboard_log=None, but WatchCallback writes there; choose"):
        make_latent(VECTOR).learn(10, callback=WatchCallback())
    with pytest.raises(ValueError, match="SAC expects no risk to show; give WatchCallback to ESADLEND"):
        SAC("MlpPolicy", CountingEnv(), **SMALL).learn(10, callback=WatchCallback())
    for name in ("every", "length", "looks"):
        with pytest.raises(ValueError, match=f"{name} is 0; choose"):
            WatchCallback(**{name: 0})


# The progress bar


@pytest.mark.filterwarnings("ignore:rich is experimental")
@pytest.mark.parametrize(("wrap", "shown"), [(Monitor, "return 28, cost 2.00"), (gym.Wrapper, "return nan, cost 2.00")])
def test_the_bar_shows_the_cost_of_any_environment(wrap: Any, shown: str) -> None:
    bar = EpisodeProgressBar()
    model = WCSAC("MlpPolicy", DummyVecEnv([lambda: wrap(CountingEnv(episode_length=7))]), **SMALL)
    model.learn(30, callback=bar)
    assert bar.pbar.desc.startswith(shown)
    assert [episode.step for episode in bar.history.episodes] == [7, 14, 21, 28]


# Images in which nothing happens


class Freezing(RandomEnv):
    """
    Its picture stays as it is after some steps of its life, or goes dark.

    :param good: steps until then
    :param dark: whether it goes dark
    """

    def __init__(self, good: int, dark: bool) -> None:
        super().__init__(PICTURE)
        self.good, self.dark, self.life = good, dark, 0
        self.last = PICTURE.sample()

    def step(self, action: np.ndarray) -> Any:
        self.life += 1
        return self._look(), *super().step(action)[1:]

    def reset(self, **kwargs: Any) -> Any:
        return self._look(), super().reset(**kwargs)[1]

    def _look(self) -> np.ndarray:
        if self.life < self.good:
            self.last = self.observation_space.sample()
        return np.full_like(self.last, self.life % 256) if self.dark and self.life >= self.good else self.last


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("algorithm", [ESADLEND, WCSAC])
def test_a_broken_camera_is_noticed(algorithm: Any, dark: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(image_watch, "PATIENCE", 30)
    early, late = (algorithm("CnnPolicy", Freezing(5, dark), learning_starts=1000, buffer_size=100) for _ in range(2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        early.learn(30)
    with pytest.warns(UserWarning, match="'observation' of environment 0 has been blank or the same for 30 steps") as caught:
        late.learn(120)
    assert len(caught) == 1


def test_who_waits_has_no_broken_camera() -> None:
    """A picture may stay the same for a while, another environment's may, and a vector for ever."""
    watch = ImageWatch(spaces.Dict({"camera": PICTURE, "speed": VECTOR}), normalize_images=True)
    pictures = np.stack([PICTURE.sample() for _ in range(4)])
    still, speed = pictures[:2], np.zeros((2, 3), dtype=np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(3):
            for before, after in [(still, still)] * (image_watch.PATIENCE - 1) + [(still, pictures[2:])]:
                watch.observe({"camera": before, "speed": speed}, {"camera": after, "speed": speed})
    one_broken = {"camera": np.stack([pictures[0], pictures[3]]), "speed": speed}
    with pytest.warns(UserWarning, match="'camera' of environment 0 has been"):
        for step in range(image_watch.PATIENCE + 1):
            moving = {"camera": np.stack([pictures[0], pictures[2 + step % 2]]), "speed": speed}
            watch.observe(one_broken, moving)
            one_broken = moving
