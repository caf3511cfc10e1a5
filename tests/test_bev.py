"""The bird's-eye view shows what one must know to drive, to a fraction of a pixel."""

import numpy as np
import pytest

from sb3_esad.envs.bev import BirdsEyeView, Ground
from sb3_esad.envs.geometry import box_corners
from sb3_esad.envs.highway import highway_road
from sb3_esad.envs.lights import NO_LINES, StopLines
from sb3_esad.envs.roads import Markings
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, User
from sb3_esad.envs.view import Frame, View

SHAPE, SCALE, AHEAD = (64, 64), (1.25, 0.4), 0.775
BARE = Markings(np.zeros((0, 4, 2)), np.zeros(0, bool), np.zeros((0, 2, 2)), np.zeros(0, bool))
VIEW = View(SHAPE, SCALE, AHEAD)
BEV = BirdsEyeView(VIEW)
ROAD = highway_road(3, 600.0, 200.0, 150.0)
ROUTE = np.array([True, True, True, False, False])


def scene(*users: User) -> Traffic:
    """Users on a highway of three lanes, the first of them the ego vehicle."""
    return Traffic(ROAD, users)


def ego(x: float = 50.0, y: float = 4.0, heading: float = 0.0, speed: float = 25.0) -> User:
    """The ego vehicle, by default in the middle lane."""
    return User((x, y), heading, speed, drives=False)


def see(*users: User, markings: Markings = ROAD.markings, heading: float = 0.0) -> np.ndarray:
    """Image of a scene as signed numbers."""
    return BEV.draw(Ground(markings, ROUTE), scene(*users), NO_LINES, heading).astype(int)


@pytest.mark.parametrize("frame", ["lane", "ego"])
def test_a_small_shift_sideways_changes_the_image(frame: str) -> None:
    heading = 0.0 if frame == "lane" else 0.05
    before, after = (see(ego(y=y, heading=heading), heading=0.0 if frame == "lane" else heading) for y in (4.0, 4.2))
    assert np.abs(after[0] - before[0]).sum() > 500


def test_the_shift_has_the_right_size_and_sense() -> None:
    left, right = (see(ego(), User((70.0, y), 0.0, 20.0), markings=BARE)[1] for y in (0.0, 0.2))
    columns = np.arange(SHAPE[1])
    centroids = [(image.sum(0) * columns).sum() / image.sum() for image in (left, right)]
    assert centroids[1] - centroids[0] == pytest.approx(0.2 / 0.4, abs=0.1)


def test_a_stopped_car_at_the_stopping_distance_is_in_view() -> None:
    stopping = 25.0**2 / (2 * 6.0) + 0.2 * 25.0
    assert see(ego(), User((50.0 + stopping + 5.0, 4.0), 0.0, 0.0))[1].max() >= 90


def test_boxes_cover_their_true_area_and_place() -> None:
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for heading in (0.0, 0.1, 0.5, 1.57):
        image = see(ego(), User((70.0, 7.0), heading, 0.0), markings=BARE)[1] / 95
        assert image.sum() == pytest.approx(5.0 * 2.0 / (1.25 * 0.4), rel=0.25)
        assert (rows * image).sum() / image.sum() == pytest.approx(64 * AHEAD - 0.5 - 20.0 / 1.25, abs=0.2)
        assert (columns * image).sum() / image.sum() == pytest.approx(31.5 + 3.0 / 0.4, abs=0.2)


def test_grey_levels_tell_speed_and_kind() -> None:
    for speed, grey in ((0.0, 95), (20.0, 175), (40.0, 255), (60.0, 255)):
        image = see(ego(speed=20.0), User((70.0, 4.0), 0.0, speed))
        assert image[1].max() == grey
        assert image[2][:, 4:-4].max() == 95 + 50
    obstacle = see(ego(), User((70.0, 4.0), kind=Kind.STATIC))
    assert obstacle[1].max() == 0
    assert obstacle[2].max() == 255


def test_the_ego_box_shows_its_heading() -> None:
    straight, turned = see(ego(), markings=BARE)[2], see(ego(heading=0.05), markings=BARE)[2]
    assert np.abs(turned - straight).sum() > 100


def test_dashes_stay_on_the_ground() -> None:
    now, later, one_period_later = (see(ego(x=x))[0] for x in (400.0, 405.0, 420.0))
    assert np.abs(later - now).sum() > 1000
    np.testing.assert_array_equal(one_period_later, now)


def test_the_route_is_brighter_than_the_ramp_and_ends_in_the_dark() -> None:
    on_ramp = see(ego(x=250.0, y=8.0))[0]
    row = on_ramp[20]
    assert row[32] > row[32 + 10] > 0, "route, then acceleration lane"
    assert row[-8] == 0, "then nothing"
    assert see(ego(x=580.0))[0][: int(64 * AHEAD - 25.0 / 1.25)].max() == 0


def test_a_mirrored_world_gives_the_mirrored_image() -> None:
    random = np.random.default_rng(0)
    for _ in range(20):
        places = [(random.uniform(40, 100), random.uniform(0, 8), random.uniform(-0.4, 0.4)) for _ in range(6)]
        users = [User((x, y), angle, random.uniform(0, 30)) for x, y, angle in places]
        mirrored = [User((u.position[0], 8.0 - u.position[1]), -u.heading, u.speed) for u in users]
        flip = np.array([1.0, -1.0])
        other = Markings(
            ROAD.markings.surfaces * flip + [0, 8], ROAD.markings.lane, ROAD.markings.lines * flip + [0, 8],
            ROAD.markings.dashed,
        )  # fmt: skip
        difference = np.abs(see(*users)[:, :, ::-1] - see(*mirrored, markings=other))
        assert difference.mean() < 1.0
        assert np.percentile(difference, 99) < 40


def test_the_dial_tells_the_own_speed_to_a_fraction_of_a_pixel() -> None:
    for speed in (0.0, 10.3, 25.0, 31.9, 40.0):
        image = see(ego(speed=speed), markings=BARE)[2]
        height = image[:, 0].sum() / 160
        assert height == pytest.approx(min(speed, 32.0) / 32.0 * SHAPE[0], abs=0.01)
        assert np.array_equal(image[:, 0], image[:, -1])


def test_an_empty_world_is_black_but_for_the_ego_vehicle() -> None:
    image = see(ego(), markings=BARE)
    assert image[:2].max() == 0
    assert image[2].max() > 0


def test_other_sizes_and_scales() -> None:
    view = View((96, 48), (1.0, 0.5), 0.75)
    image = BirdsEyeView(view).draw(Ground(ROAD.markings, ROUTE), scene(ego()), NO_LINES, 0.0)
    assert image.shape == (3, 96, 48)
    assert image.dtype == np.uint8
    assert np.flatnonzero(image[2][:, 4:-4].any(1)).mean() == pytest.approx(96 * 0.75 - 0.5, abs=1.0)


def test_an_amber_light_s_line_is_less_bright_than_a_red_one_s() -> None:
    places = ((70.0, 2.0), (80.0, 6.0))
    corners = box_corners(np.array(places), np.zeros(2), np.array([[4.0, 3.0]] * 2))
    image = BEV.draw(Ground(BARE, ROUTE), scene(ego()), StopLines(corners, np.array([True, False])), 0.0)[2]
    values = set(np.unique(image).tolist())
    assert {255, 210} <= values
    assert not {255, 210} & set(np.unique(BEV.draw(Ground(BARE, ROUTE), scene(ego()), NO_LINES, 0.0)[2]).tolist())


def test_who_is_left_out_early_leaves_no_trace() -> None:
    """Shapes around the edges of the view are the same picture if all of them are drawn, wherever they are."""
    random = np.random.default_rng(0)
    for _ in range(200):
        origin, heading = random.uniform(-100.0, 100.0, 2), float(random.uniform(-4.0, 4.0))
        middle = origin + (AHEAD - 0.5) * SHAPE[0] * SCALE[0] * np.array([np.cos(heading), np.sin(heading)])
        turns, away = random.uniform(-4.0, 4.0, (2, 20)), random.uniform(35.0, 55.0, 20)
        places = middle + away[:, None] * np.stack([np.cos(away), np.sin(away)], -1)
        corners = box_corners(places, turns[0], random.uniform(1.0, 12.0, (20, 2)))
        frame = Frame(VIEW, origin, heading)
        near = frame.near(places, np.hypot(*(corners[:, 0] - places).T))
        pictures = np.zeros((2, *SHAPE), dtype=np.uint8)
        for picture, shapes in zip(pictures, (corners, corners[near]), strict=True):
            VIEW.draw([picture] * len(shapes), frame.pixels(shapes), [200] * len(shapes), [False] * len(shapes))
        assert len(near) < len(places)
        np.testing.assert_array_equal(pictures[0], pictures[1])
