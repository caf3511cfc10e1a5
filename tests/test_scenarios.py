"""Every registered scenario is a well-behaved environment, can be solved and is not trivial."""

import itertools
import math
import pickle
from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_sb3_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_esad.driving_evaluation import evaluate_driver
from sb3_esad.envs.braking import Braking
from sb3_esad.envs.config import RULES
from sb3_esad.envs.course import Course, Course1, Course2, Course3
from sb3_esad.envs.drivers import CarFollower, ReferenceDriver, SpeedKeeper
from sb3_esad.envs.geometry import box_corners, boxes_overlap, wrap_angle
from sb3_esad.envs.highway import Highway
from sb3_esad.envs.lanes import NO_LANE
from sb3_esad.envs.metrics import summarise
from sb3_esad.envs.negotiation import TrafficNegotiation, crossroads
from sb3_esad.envs.obstacles import NOWHERE, ObstacleAvoidance
from sb3_esad.envs.right_of_way import RightOfWay
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.scenario import Scenario
from sb3_esad.envs.town_drive import Town03, Town04, Town06, Town07, Town10
from sb3_esad.envs.towns import PLANS, town
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, User

SCENARIOS: dict[str, type[Scenario]] = {
    "highway": Highway,
    "traffic-negotiation": TrafficNegotiation,
    "obstacle-avoidance": ObstacleAvoidance,
    "braking": Braking,
    "town03": Town03,
    "town04": Town04,
    "town06": Town06,
    "town07": Town07,
    "town10": Town10,
    "course": Course,
    "course-1mps": Course1,
    "course-2mps": Course2,
    "course-3mps": Course3,
}
SOLVED = {
    "highway": (30, 20.5),
    "traffic-negotiation": (30, 5.0),
    "obstacle-avoidance": (30, 8.0),
    "braking": (30, 18.0),
    "town03": (12, 8.0),
    "town04": (12, 13.0),
    "town06": (12, 9.5),
    "town07": (12, 6.5),
    "town10": (12, 4.0),
    "course": (12, 1.9),
    "course-1mps": (6, 1.8),
    "course-2mps": (12, 1.7),
    "course-3mps": (6, 1.7),
}
"""Episodes that are driven, and the least mean speed of the reference driver [m/s]."""
IDS = [f"esad-{name}{suffix}-v0" for name in SCENARIOS for suffix in ("", "-vector", "-dict")]


def make(env_id: str, **kwargs: Any) -> Any:
    """The scenario itself, without gymnasium's wrappers."""
    return gymnasium.make(env_id, **kwargs).unwrapped


def play(env: Any, actions: np.ndarray) -> list[Any]:
    """Everything that a rollout returns, as bytes and plain values."""
    seen: list[Any] = []
    for action in actions:
        observation, reward, terminated, truncated, info = env.step(action)
        arrays = observation.values() if isinstance(observation, dict) else [observation]
        seen.append(([array.tobytes() for array in arrays], reward, terminated, truncated, repr(info)))
        if terminated or truncated:
            break
    return seen


@pytest.mark.parametrize("env_id", IDS)
def test_checkers_are_content(env_id: str) -> None:
    check_env(make(env_id), skip_render_check=True)
    check_sb3_env(gymnasium.make(env_id))


@pytest.mark.parametrize("env_id", IDS)
def test_same_seed_same_episode_to_the_bit(env_id: str) -> None:
    actions = np.random.default_rng(0).uniform(-0.1, 0.1, (80, 2)).astype(np.float32)
    env, other = make(env_id), make(env_id)
    env.reset(seed=1)
    play(env, actions)
    env.reset(seed=7)
    other.reset(seed=7)
    first, second = play(env, actions), play(other, actions)
    assert len(first) > 4
    assert first == second
    other.reset(seed=8)
    assert play(other, actions) != first


@pytest.mark.parametrize("env_id", IDS)
def test_pickling_in_mid_episode(env_id: str) -> None:
    actions = np.random.default_rng(1).uniform(-0.1, 0.1, (60, 2)).astype(np.float32)
    env = make(env_id)
    env.reset(seed=5)
    play(env, actions[:4])
    copy = pickle.loads(pickle.dumps(env))
    assert play(copy, actions[4:]) == play(env, actions[4:])


def test_same_seed_same_episode_in_other_processes() -> None:
    """All scenarios at once, each in a process of its own."""
    makers = [partial(gymnasium.make, f"sb3_esad.envs:esad-{name}-vector-v0") for name in SCENARIOS]
    here, there = DummyVecEnv(makers), SubprocVecEnv(makers)
    for env in (here, there):
        env.seed(3)
    np.testing.assert_array_equal(here.reset(), there.reset())
    for action in np.random.default_rng(0).uniform(-0.1, 0.1, (20, len(SCENARIOS), 2)).astype(np.float32):
        for ours, theirs in zip(here.step(action)[:3], there.step(action)[:3], strict=True):
            np.testing.assert_array_equal(ours, np.asarray(theirs, dtype=ours.dtype))
    there.close()


@pytest.mark.parametrize(
    ("name", "config", "message"),
    [
        ("town03", {"spawn": "anywhere"}, "spawn is 'anywhere'; choose random or fixed"),
        ("town10", {"cars": -1}, "cars is -1; choose a whole number from 0 on"),
        ("course-2mps", {"walking_speed": -1.0}, "walking_speed is -1.0; choose a number above 0"),
        ("course", {"obstacles": (9, 3)}, r"obstacles is \(9, 3\); choose two whole numbers from 0 on, the smaller one"),
        ("course", {"obstacles": (1.5, 2.5)}, "choose two whole numbers"),
        ("course", {"hall_width": 1.0}, "hall_width is 1.0; choose a number from 4 on"),
        ("course", {"course_length": (1.0, 2.0)}, "choose two numbers from 15 on"),
        ("course", {"box_side": (0.0, 0.0)}, "choose two numbers above 0"),
        ("traffic-negotiation", {"approach": (300.0, 300.0)}, "choose two numbers from 0 to 240"),
        ("braking", {"graded_cost": "no"}, "graded_cost is 'no'; choose True or False"),
        ("braking", {"reward_weights": {"lane": math.nan}}, "choose finite weights"),
        ("highway", {"frame": "x"}, "frame is 'x'; choose one of lane, ego"),
        ("town04", {"route_length": 50_000.0}, "leads through town04 in circles; choose a shorter one"),
        ("highway", {"start_speed": (-3.0, 2.0)}, "start_speed is .* choose two numbers from 0 on"),
        ("town04", {"route_lenght": 100.0}, "unknown configuration key 'route_lenght'; did you mean 'route_length'"),
    ],
)
def test_settings_that_make_no_sense(name: str, config: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        gymnasium.make(f"esad-{name}-vector-v0", config=config).reset(seed=0)


def test_an_unknown_town_is_named_with_those_there_are() -> None:
    with pytest.raises(ValueError, match="there is no town05; choose one of town03, town04, town06, town07, town10"):
        town("town05")


def test_every_setting_is_checked() -> None:
    """A key that no rule knows would be taken as it comes."""
    checked = {name for rule in RULES for name in rule.names}
    assert set().union(*(scenario.default_config() for scenario in SCENARIOS.values())) == checked


@pytest.mark.parametrize("name", SOLVED)
def test_it_can_be_solved_and_is_not_trivial(name: str) -> None:
    """Some of the hundred seeds of the table in the README."""
    (episodes, least_speed), env_id = SOLVED[name], f"esad-{name}-vector-v0"
    seeds = range(episodes)
    reference, keeper, chance = (
        summarise(evaluate_driver(driver, env_id, seeds)) for driver in ("reference", "keeper", "random")
    )
    assert reference["DS"] >= 95
    assert reference["collision_free"] >= 0.97
    assert keeper["DS"] <= reference["DS"] - 25
    assert chance["DS"] < 25
    assert reference["speed"] > least_speed


def test_on_the_highway_following_is_enough_and_quick() -> None:
    follower = summarise(evaluate_driver("follower", "esad-highway-vector-v0", range(30)))
    assert follower["collision_free"] >= 0.95
    assert follower["speed"] > 19.5


def test_the_car_ahead_brakes_to_a_halt_and_drives_on() -> None:
    env, follow = make("esad-braking-vector-v0", config={"cut_in_share": 0.0, "lane_counts": (2, 2)}), CarFollower()
    for seed in range(3):
        env.reset(seed=seed)
        while not env.traffic.forced_braking.any():
            env.step(follow(env))
        car, speeds = env.traffic.forced_braking.argmax(), []
        while env.traffic.forced_braking[car]:
            speeds.append(float(env.traffic.speed[car]))
            env.step(follow(env))
        slowing = -np.diff(speeds[: speeds.index(0.0)]) * env.config["policy_frequency"]
        assert ((slowing > 6.0 - 1e-6) & (slowing < 8.0 + 1e-6)).all()
        assert 0.5 <= speeds.count(0.0) / env.config["policy_frequency"] <= 2.5 + 0.4


def test_cars_cut_in_close_ahead() -> None:
    env, hold, distances = make("esad-braking-vector-v0", config={"cut_in_share": 1.0}), SpeedKeeper(), []
    for seed in range(20):
        env.reset(seed=seed)
        own = int(env.traffic.lane[EGO])
        for _ in range(60):
            outside = env.traffic.lane != own
            _, _, terminated, _, _ = env.step(hold(env))
            came = np.flatnonzero(outside & (env.traffic.lane == own))
            distances += (env.traffic.position[came, 0] - env.traffic.position[EGO, 0]).tolist()
            if terminated:
                break
    assert sum(0 < distance < 25 for distance in distances) >= 5


def test_obstacles_appear_suddenly_ahead_and_leave_a_way_out() -> None:
    env, hold, seen = make("esad-obstacle-avoidance-vector-v0"), SpeedKeeper(), 0
    for seed in range(20):
        env.reset(seed=seed)
        assert (env.traffic.position[env._obstacles] == NOWHERE).all()
        terminated = False
        while not terminated and (env.traffic.position[env._obstacles, 0] == NOWHERE[0]).all():
            before = env.traffic.position[EGO, 0]
            _, _, terminated, _, _ = env.step(hold(env))
        there = env._obstacles[env.traffic.position[env._obstacles, 0] != NOWHERE[0]]
        if there.size:
            seen += 1
            distance = env.traffic.position[there, 0] - before
            assert 24.0 - 12.0 / 5 <= distance.min() <= 50.0
            blocked = {int(lane) for lane in np.rint(env.traffic.position[there, 1] / 4.0)}
            own = int(env.traffic.lane[EGO])
            assert any(0 <= lane < env.lanes and lane not in blocked for lane in (own - 1, own + 1))
            assert len(blocked) <= 2
    assert seen >= 15


def place(env: Any, lane: int, along: float, across: float) -> None:
    """Put the ego vehicle beside the centre of a lane, in the direction of the lane."""
    env.traffic.position[EGO] = env.road.position(lane, along, across)
    env.traffic.heading[EGO] = env.road.lanes[lane].heading_at(along)
    env.traffic.move(0.0)


@pytest.mark.parametrize(
    ("name", "nobody"),
    [
        ("town06", {"cars": 0}),
        ("town07", {"cars": 0}),
        ("traffic-negotiation", {"cars_per_street": 0}),
    ],
)
@pytest.mark.parametrize(("across", "wrong"), [(0.0, False), (-1.5, False), (-4.0, True)])
def test_the_lane_of_those_who_come_towards_one_is_the_wrong_way(
    name: str, nobody: dict[str, int], across: float, wrong: bool
) -> None:
    env = make(f"esad-{name}-v0", config=nobody)
    env.reset(seed=3)
    leftmost = env.road.row(int(env.traffic.lane[EGO]), env.road.left)[-1]
    place(env, leftmost, float(env.traffic.along[leftmost, EGO]), across)
    _, reward, _, _, info = env.step(np.zeros(2))
    assert info["cost_terms"]["wrong_way"] == bool(info["cost"]) == (reward == 0.0) == wrong
    assert (env.episode.off_route > 0) == wrong


def test_a_street_that_is_not_on_the_route_pays_nothing() -> None:
    env = make("esad-traffic-negotiation-v0", config={"cars_per_street": 0})
    for seed in range(3):
        env.reset(seed=seed)
        way_out = next(w.target for w in env.crossroads.ways if not env.route.contains[w.target])
        place(env, way_out, 20.0, 0.0)
        _, reward, _, _, info = env.step(np.zeros(2))
        assert reward == info["cost"] == 0.0 and info["speed"] > 0


def test_ways_through_a_junction_cross_or_not() -> None:
    road, _, ways, crossings = crossroads()
    crosses = crossings.crosses
    headings = [road.heading[way.source] for way in ways], [road.heading[way.target] for way in ways]
    turns = np.rint(wrap_angle(headings[1] - np.array(headings[0])) / (np.pi / 2)).astype(int)
    assert sorted(turns.tolist()) == [-1] * 4 + [0] * 4 + [1] * 4
    for first, own in enumerate(ways):
        assert not crosses[first][[other.source == own.source for other in ways]].any()
        for second, other in enumerate(ways):
            if other.target == own.target and first != second:
                assert crosses[first, second], "they merge"
            opposite = abs(wrap_angle(headings[0][first] - headings[0][second])) > 3
            if opposite and turns[first] == 0:
                assert crosses[first, second] == (turns[second] == -1), "only who turns left crosses oncoming traffic"


def test_people_beside_a_junction_hold_up_nobody() -> None:
    road, streets, ways, crossings = crossroads()
    arriving = [towards for _, towards in streets]
    way = next(each for each in ways if each.source == arriving[0].exits[0])
    start, heading = tuple(road.position(way.source, 235.0).tolist()), float(road.heading[way.source])
    car = User(start, heading, 8.0, 10.0, path=(way.source, *way.lanes, way.target))
    far = User(tuple(road.position(arriving[1].exits[0], 10.0).tolist()), drives=False)
    people = [
        User(tuple(road.position(lane.exits[0], 246.0, 4.5).tolist()), kind=Kind.PERSON, drives=False) for lane in arriving
    ]
    traffic = Traffic(road, [far, *people, car])
    RightOfWay(crossings).regulate(traffic)
    assert not np.isfinite(traffic.stop_distance).any()


def test_everybody_gets_through_the_junction() -> None:
    env, reference = make("esad-traffic-negotiation-vector-v0", config={"duration": 90.0}), ReferenceDriver()
    before = [towards.exits[0] for _, towards in crossroads().streets]
    for seed in range(4):
        env.reset(seed=seed)
        for _ in range(350):
            if env.step(reference(env))[2]:
                break
        for _ in range(250):
            env._before_physics()
            env.traffic.speed[EGO] = 0.0
            env.traffic.position[EGO] = env.road.position(env.route.lanes[-1], 240.0)
            for _ in range(2):
                env.traffic.act()
                env.traffic.move(0.1)
        assert not np.isin(env.traffic.lane[1:], before).any(), f"seed {seed}"


def test_every_registered_scenario_is_tested() -> None:
    assert {spec for spec in gymnasium.registry if spec.startswith("esad-")} == set(IDS)


@pytest.mark.parametrize("name", PLANS)
def test_lanes_of_a_town_lead_on_where_they_end(name: str) -> None:
    road, _, ways, _ = town(name)
    for way in ways:
        for lane, chosen in itertools.pairwise((way.source, *way.lanes, way.target)):
            continuing = int(road.following[lane])
            following = continuing if road.row_of[chosen] == road.row_of[continuing] else chosen  # then one changes lane
            np.testing.assert_allclose(road.end(lane), road.start[following], atol=1e-6)
            turned = road.lanes[lane].heading_at(float(road.length[lane])) - road.heading[following]
            assert math.remainder(turned, 2 * math.pi) == pytest.approx(0.0, abs=1e-6)
    leads_on = set(np.flatnonzero(road.following != NO_LANE).tolist())
    assert leads_on == set(range(len(road.length))), "nobody drives out of the town"


@pytest.mark.parametrize(
    "name", ["traffic-negotiation", "obstacle-avoidance", "braking", "town03", "town04", "town06", "town07"]
)
def test_the_others_do_not_collide(name: str) -> None:
    env, follow = make(f"esad-{name}-vector-v0"), CarFollower()
    for seed in range(8):
        env.reset(seed=seed)
        for _ in range(100):
            _, _, terminated, truncated, _ = env.step(follow(env))
            traffic = env.traffic
            corners = box_corners(traffic.position, traffic.heading, traffic.size)
            here = np.flatnonzero(traffic.position[:, 0] != NOWHERE[0])
            for index, row in enumerate(here[:-1]):
                assert not boxes_overlap(corners[row], corners[here[index + 1 :]]).any(), f"seed {seed}"
            if terminated or truncated:
                break
