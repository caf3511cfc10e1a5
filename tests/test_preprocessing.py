"""Vectors at a common scale: closed forms, and a model that does not mind the units of what it sees."""

from typing import cast

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_esad import ESADLEND
from sb3_esad.common.decoders import VectorHead
from sb3_esad.common.preprocessing import Preprocessing
from sb3_esad.common.running_scale import CLIP, MIN_RATE, RunningScale
from sb3_esad.common.world_model import WorldModel
from tests.conftest import TINY, CountingEnv


def test_the_scale_is_that_of_all_batches_together() -> None:
    scale, vectors = RunningScale(3), th.randn(20, 64, 3) * th.tensor([0.01, 1.0, 50.0]) + th.tensor([1.0, -1.0, 1e3])
    vectors += th.arange(20.0)[:, None, None] * th.tensor([0.01, 0.0, 10.0])  # means move from batch to batch
    for batch in vectors:
        scale.follow(batch)
    together = vectors.flatten(0, 1)
    th.testing.assert_close(scale.mean, together.mean(0))
    th.testing.assert_close(scale.variance, together.var(0, correction=0), rtol=1e-4, atol=0)
    scaled = scale(together)
    th.testing.assert_close(scaled.mean(0), th.zeros(3), atol=1e-3, rtol=0)
    th.testing.assert_close(scaled.std(0), th.ones(3), atol=1e-3, rtol=0)
    th.testing.assert_close(scale.invert(scaled), together, rtol=1e-5, atol=1e-4)


def test_what_is_new_counts_in_the_end() -> None:
    scale = RunningScale(1)
    for mean, n_batches in ((0.0, 2000), (1.0, 1000)):
        for _ in range(n_batches):
            scale.follow(mean + th.randn(64, 1))
    assert scale.mean.item() == pytest.approx(1 - (1 - MIN_RATE) ** 1000, abs=0.02)


def test_what_never_varied_is_cut_where_it_varies_and_is_learned() -> None:
    scale = RunningScale(1)
    scale.follow(th.full((8, 1), 3.0))
    assert scale(th.tensor([[3.0], [4.0], [-99.0]])).flatten().tolist() == [0.0, CLIP, -CLIP]
    for _ in range(300):
        scale.follow(3.0 + th.randn(64, 1))
    assert scale.variance.item() == pytest.approx(1.0, abs=0.3)


def test_an_outlier_does_not_blind() -> None:
    scale = RunningScale(1)
    for _ in range(10):
        scale.follow(th.randn(512, 1))
    scale.follow(th.cat([th.randn(511, 1), th.full((1, 1), 1e20)]))
    assert scale.variance.item() == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("share", [0.002, 0.005, 0.01, 0.02])
def test_an_entry_that_varies_seldom_keeps_its_scale(share: float) -> None:
    scale = RunningScale(1)
    scale.follow(th.zeros(256, 1))
    for _ in range(3000):
        scale.follow((th.rand(256, 1) < share) * (0.2 + 0.8 * th.rand(256, 1)))
    true = (share * (0.6**2 + 0.8**2 / 12) - (0.6 * share) ** 2) ** 0.5
    assert true / 1.5 < scale.variance.item() ** 0.5 < 1.5 * true


def test_tables_keep_their_shape() -> None:
    preprocessing = Preprocessing(spaces.Box(-1, 1, (2, 3), np.float32), normalize_images=True)
    seen = th.rand(5, 2, 3)
    preprocessing.follow(seen)
    prepared = preprocessing(seen)
    assert isinstance(prepared, th.Tensor)
    th.testing.assert_close(prepared.mean(0), th.zeros(2, 3), atol=1e-5, rtol=0)
    assert prepared.shape == seen.shape


def test_the_error_of_each_entry_counts_by_its_weight() -> None:
    head = VectorHead((4, 1, 1), 2, weight=10.0)
    for parameter in head.layers[1].parameters():
        th.nn.init.zeros_(parameter)
    observations = th.tensor([[0.0, 1.0], [-1.0, 3.0]])
    expected = 10 * (2 * np.log(2) ** 2 + np.log(4) ** 2) / 2
    assert head.loss(th.zeros(2, 4, 1, 1), observations).item() == pytest.approx(expected)


def test_only_vectors_are_scaled_and_each_by_its_own() -> None:
    space = spaces.Dict(
        {
            "image": spaces.Box(0, 255, (3, 16, 16), np.uint8),
            "speed": spaces.Box(-99, 99, (2,)),
            "gear": spaces.Discrete(3),
        }
    )
    preprocessing = Preprocessing(space, normalize_images=True)
    seen = {
        "image": th.full((4, 3, 16, 16), 51, dtype=th.uint8),
        "speed": th.tensor([[1.0, 5.0], [3.0, 5.0], [1.0, 5.0], [3.0, 5.0]]),
        "gear": th.tensor([[0], [1], [1], [1]]),
    }
    preprocessing.follow(seen)
    prepared = cast(dict[str, th.Tensor], preprocessing(seen))
    assert prepared["image"].unique().tolist() == pytest.approx([0.2])
    assert prepared["speed"].tolist() == [[-1, 0], [1, 0], [-1, 0], [1, 0]]
    deviation = np.sqrt(3) / 4
    np.testing.assert_allclose(prepared["gear"][:2, 0], np.array([[0.75, -0.75, 0], [-0.25, 0.25, 0]]) / deviation, rtol=1e-5)
    shown = preprocessing.invert(prepared)
    assert shown["speed"].tolist() == seen["speed"].tolist()
    np.testing.assert_allclose(shown["gear"][0, 0], [1.0, 0.0, 0.0], atol=1e-6)


def fit(unit: float, zero: float) -> tuple[WorldModel, float, th.Tensor]:
    """A world model that has seen a few windows in other units, its loss, and what it has made of them."""
    algorithm = ESADLEND("MlpPolicy", CountingEnv(), **{**TINY, "learning_starts": 100}).learn(60)
    samples = algorithm.replay_buffer.sample(8)
    change = {name: unit * getattr(samples, name) + zero for name in ("observations", "next_observations")}
    model = algorithm.policy.world_model
    th.manual_seed(0)
    loss, filtered, _ = model.loss(samples._replace(**change))
    return model, loss.item(), filtered.posterior.mean


def test_units_do_not_matter() -> None:
    """Neither to what is learned nor to what is remembered; what is shown has the units of what is seen."""
    model, loss, seen = fit(1.0, 0.0)
    other_model, other_loss, other_seen = fit(0.02, 5.0)
    assert other_loss == pytest.approx(loss, rel=1e-3)
    th.testing.assert_close(other_seen, seen, rtol=1e-3, atol=1e-3)
    shown, other_shown = (each.reconstruct(each.initial(1))["observation"] for each in (model, other_model))
    th.testing.assert_close(other_shown, 0.02 * shown + 5.0, rtol=1e-3, atol=1e-3)
