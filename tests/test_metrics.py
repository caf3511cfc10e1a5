"""Every figure of the metrics on episodes whose values were worked out by hand."""

import math

import gymnasium
import numpy as np
import pytest

from sb3_esad.envs.course import hall
from sb3_esad.envs.episode import LONGEST_TTC, CourseEpisode, Episode
from sb3_esad.envs.hazards import clearance, time_to_collision
from sb3_esad.envs.highway import highway_road
from sb3_esad.envs.intervals import bootstrap_interval, mean_interval, poisson_interval, wilson_interval, worst_mean
from sb3_esad.envs.metrics import DrivingMetrics, summarise
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, User

ROAD = highway_road(3, 600.0, 200.0, 150.0)


def perfect() -> Episode:
    """100 m in 5 s along a route of 100 m, reward 1 a second."""
    episode = Episode(100.0)
    for second in range(5):
        episode.add_motion(1.0, 20.0, 20.0 * (second + 1), on_route=True)
        episode.add_outcome(1.0, 0.0, math.inf)
    return episode


def crash() -> Episode:
    """40 of 100 m in 2 s, then into a car; the smallest time to collision was 0.5 s."""
    episode = Episode(100.0)
    for progress, ttc, cost in ((20.0, 3.0, 0.0), (40.0, 0.5, 1.0)):
        episode.add_motion(1.0, 20.0, progress, on_route=True)
        episode.add_outcome(0.5, cost, ttc)
    episode.add_infraction("vehicle")
    return episode


def sinner() -> Episode:
    """60 m in 6 s, 10 of them off the route, over two red lights and into a person."""
    episode = Episode(100.0)
    for second in range(6):
        episode.add_motion(1.0, 10.0, 10.0 * (second + 1), on_route=second != 2)
        episode.add_outcome(0.0, float(second in (3, 4, 5)), 2.0)
    for name in ("red_light", "red_light", "person"):
        episode.add_infraction(name)
    return episode


def test_records_by_hand() -> None:
    good, bad, worst = perfect().record(True), crash().record(False), sinner().record(False)
    assert (good["route_completion"], good["infraction_score"], good["driving_score"]) == (1.0, 1.0, 1.0)
    assert (bad["route_completion"], bad["infraction_score"]) == (0.4, 0.6)
    assert bad["driving_score"] == pytest.approx(0.24)
    assert worst["route_completion"] == pytest.approx(0.5), "the 10 m off the route are taken off"
    assert worst["infraction_score"] == pytest.approx(0.7 * 0.7 * 0.5)
    assert (good["min_ttc"], bad["min_ttc"], worst["min_ttc"]) == (LONGEST_TTC, 0.5, 2.0)
    assert (good["mean_speed"], bad["mean_speed"], worst["mean_speed"]) == (20.0, 20.0, 10.0)
    assert (good["collisions"], bad["collisions"], worst["collisions"]) == (0.0, 1.0, 1.0)
    assert (good["infractions"], bad["infractions"], worst["infractions"]) == (0.0, 1.0, 3.0)
    assert (good["return"], bad["return"], bad["cost"], worst["cost"]) == (5.0, 1.0, 1.0, 3.0)
    assert all(type(value) is float for record in (good, bad, worst) for value in record.values())


def test_static_penalty() -> None:
    episode = perfect()
    episode.add_infraction("static")
    assert episode.record(False)["driving_score"] == pytest.approx(0.65)


def test_going_back_does_not_undo_progress_and_more_than_the_route_is_no_bonus() -> None:
    episode = Episode(100.0)
    for progress in (50.0, 120.0, 70.0):
        episode.add_motion(1.0, 50.0, progress, on_route=True)
    assert episode.record(True)["route_completion"] == 1.0


def test_summary_by_hand() -> None:
    figures = summarise([perfect().record(True), crash().record(False), sinner().record(False)])
    assert figures["DS"] == pytest.approx(100 * (1 + 0.24 + 0.5 * 0.245) / 3)
    assert figures["RC"] == pytest.approx(100 * (1 + 0.4 + 0.5) / 3)
    assert figures["IS"] == pytest.approx(100 * (1 + 0.6 + 0.245) / 3)
    assert figures["CR"] == pytest.approx(2 / 0.2), "2 collisions in 200 m"
    assert figures["CO"] == pytest.approx(2 / 2), "the same per 100 m"
    assert figures["IPK"] == pytest.approx(4 / 0.2)
    assert figures["TTC"] == pytest.approx((LONGEST_TTC + 0.5 + 2.0) / 3)
    assert figures["TTC_5"] == pytest.approx(np.percentile([LONGEST_TTC, 0.5, 2.0], 5)) == pytest.approx(0.65)
    assert figures["success"] == pytest.approx(1 / 3)
    assert figures["collision_free"] == pytest.approx(1 / 3)
    assert figures["speed"] == pytest.approx(50 / 3)
    assert figures["return"] == pytest.approx(2.0)
    assert figures["cost"] == pytest.approx(4 / 3)
    assert figures["cost_cvar"] == 3.0
    assert figures["DS_low"] < figures["DS"] < figures["DS_high"]
    assert (figures["CR_low"], figures["CR_high"]) == pytest.approx((0.2422 / 0.2, 7.2247 / 0.2), abs=1e-2)
    assert figures["CO_high"] == pytest.approx(figures["CR_high"] / 10)


def test_no_records_is_an_error() -> None:
    with pytest.raises(ValueError, match="at least one episode"):
        summarise([])


def test_wilson_interval_by_hand() -> None:
    assert wilson_interval(0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson_interval(5, 10) == pytest.approx((0.2366, 0.7634), abs=1e-4)
    assert wilson_interval(97, 100) == pytest.approx((0.9155, 0.9897), abs=1e-4)
    low, high = wilson_interval(10, 10)
    assert (low, high) == pytest.approx((0.7225, 1.0), abs=1e-4)


def test_mean_interval_by_hand() -> None:
    low, high = mean_interval(np.array([1.0, 2.0, 3.0]))
    assert (low, high) == pytest.approx((2 - 4.3027 / math.sqrt(3), 2 + 4.3027 / math.sqrt(3)), abs=1e-3)
    assert mean_interval(np.array([7.0])) == (7.0, 7.0)


def test_poisson_interval_by_hand() -> None:
    """Garwood's table: 3 / n for none of n, and (4.80, 18.39) for 10."""
    assert poisson_interval(0) == pytest.approx((0.0, 3.689), abs=1e-3)
    assert poisson_interval(10) == pytest.approx((4.795, 18.390), abs=1e-3)


def test_worst_mean_by_hand() -> None:
    costs = np.arange(20.0)
    assert worst_mean(costs, 0.1) == 18.5
    assert worst_mean(costs, 0.25) == 17.0
    assert worst_mean(costs, 1.0) == 9.5
    assert worst_mean(np.array([3.0]), 0.1) == 3.0


@pytest.mark.parametrize(
    ("place", "heading", "speed", "expected"),
    [
        ((65.0, 4.0), 0.0, 15.0, 1.0),  # 15 m between centres, 10 m between bumpers, closing at 10 m/s
        ((65.0, 4.0), 0.0, 25.0, math.inf),  # as fast
        ((35.0, 4.0), 0.0, 40.0, math.inf),  # from behind: not in the path
        ((65.0, 6.5), 0.0, 15.0, math.inf),  # half a metre of room beside it
        ((65.0, 5.5), 0.0, 15.0, 1.0),  # half a metre of overlap
        ((65.0, 4.0), math.pi, 15.0, 10.0 / 40.0),  # oncoming
        ((65.0, 7.0), math.pi / 2, 0.0, 11.5 / 25.0),  # stands across the lanes, its rear half a metre in the path
        ((65.0, 7.6), math.pi / 2, 0.0, math.inf),  # its rear beside it
    ],
)
def test_time_to_collision_by_hand(place: tuple[float, float], heading: float, speed: float, expected: float) -> None:
    users = [User((50.0, 4.0), 0.0, 25.0, drives=False), User(place, heading, speed)]
    assert time_to_collision(Traffic(ROAD, users)) == pytest.approx(expected)


def test_time_to_collision_takes_the_nearest_and_never_falls_below_zero() -> None:
    users = [
        User((50.0, 4.0), 0.0, 25.0, drives=False),
        User((95.0, 4.0), kind=Kind.STATIC, size=(5.0, 2.0)),
        User((65.0, 4.0), 0.0, 15.0),
    ]
    assert time_to_collision(Traffic(ROAD, users)) == pytest.approx(1.0)
    assert time_to_collision(Traffic(ROAD, [users[0], User((54.0, 4.0), 0.0, 15.0)])) == 0.0


class OneStep(gymnasium.Env):
    """Ends at the first step, with whatever info it was given."""

    observation_space = gymnasium.spaces.Discrete(1)
    action_space = gymnasium.spaces.Discrete(1)

    def __init__(self, info: dict) -> None:
        self.info = info

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[int, dict]:
        return 0, {}

    def step(self, action: int) -> tuple[int, float, bool, bool, dict]:
        return 0, 0.0, False, True, self.info


def test_wrapper_keeps_the_records() -> None:
    env = DrivingMetrics(OneStep({"driving": perfect().record(True)}))
    for _ in range(3):
        env.reset()
        env.step(0)
    assert len(env.records) == 3
    assert summarise(env.records)["DS"] == 100.0


def test_wrapper_says_what_is_missing() -> None:
    env = DrivingMetrics(OneStep({}))
    env.reset()
    with pytest.raises(KeyError, match="wrap a scenario"):
        env.step(0)


def test_resampled_interval_of_a_mean_is_that_of_the_normal_distribution() -> None:
    values = np.random.default_rng(3).exponential(size=400)
    low, high = bootstrap_interval(values, lambda draw: float(np.mean(draw)))
    half = 1.96 * values.std() / math.sqrt(400)
    assert (low, high) == pytest.approx((values.mean() - half, values.mean() + half), abs=0.15 * half)
    assert bootstrap_interval(np.array([7.0]), worst_mean) == (7.0, 7.0)


def test_resampled_interval_holds_the_truth_of_a_tail() -> None:
    """The worst tenth of an exponential distribution has the mean 1 + ln 10."""
    random = np.random.default_rng(4)
    intervals = [bootstrap_interval(random.exponential(size=200), worst_mean) for _ in range(60)]
    assert 0.85 <= np.mean([low < 1 + math.log(10) < high for low, high in intervals]) <= 1.0


def test_the_course_s_figures_by_hand() -> None:
    """Two episodes of 4 and 6 m, one of which hits something; half of the first path and two thirds of the other have room."""
    free, hit = CourseEpisode(10.0), CourseEpisode(10.0)
    for room, turned in ((0.6, 0.1), (0.5, -0.4)):
        free.add_motion(1.0, 2.0, 2.0, on_route=True)
        free.add_path(2.0, turned, room)
    for room in (5.0, 0.4, 0.8):
        hit.add_motion(1.0, 2.0, 2.0, on_route=True)
        hit.add_path(2.0, 0.0, room)
    hit.add_path(0.001, 1.0, 0.0)  # hardly a step: no curvature
    hit.add_infraction("static")
    first, second = free.record(True), hit.record(False)
    assert (first["clear_distance"], second["clear_distance"]) == (2.0, 4.0)
    assert (first["max_curvature"], second["max_curvature"]) == (pytest.approx(0.2), 0.0)
    figures = summarise([first, second])
    assert figures["safety"] == pytest.approx(100 * 0.5 * 6.0 / 10.0)
    assert 0.0 <= figures["safety_low"] <= figures["safety"] <= figures["safety_high"] <= 100.0
    assert (figures["path"], figures["curvature"], figures["duration"]) == (5.0, pytest.approx(0.1), 2.5)
    assert not {"path", "curvature", "safety"} & set(summarise([perfect().record(True)]))


def test_room_to_what_is_nearest() -> None:
    """In a hall 12 m wide a vehicle of 1.2 x 0.8 m has 5.6 m to either wall, capped at 5, and 1.3 m to a box ahead."""
    road = hall(40.0, 12.0)
    ego = User((10.0, 0.0), drives=False, size=(1.2, 0.8))
    box = User((12.4, 0.0), kind=Kind.STATIC, drives=False, size=(1.0, 1.0))
    assert clearance(road, Traffic(road, [ego])) == pytest.approx(5.0)
    assert clearance(road, Traffic(road, [ego, box])) == pytest.approx(1.3)
    beside = User((10.0, 4.8), drives=False, size=(1.2, 0.8))
    assert clearance(road, Traffic(road, [beside, box])) == pytest.approx(0.8)
