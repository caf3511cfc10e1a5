"""Towns: motorways whose lanes one must choose in time, narrow streets, lights, and people who look where they walk."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from sb3_esad.envs.drivers import SpeedKeeper
from sb3_esad.envs.lanes import NO_LANE, Lane
from sb3_esad.envs.lights import AMBER, PERIOD, SETBACK, TrafficLights
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Markings, Road, dashes
from sb3_esad.envs.towns import PLANS, town
from sb3_esad.envs.traffic import GET_BACK, Traffic
from sb3_esad.envs.users import Kind, User
from sb3_esad.envs.walkers import PATIENCE, Walkers

NOTHING = Markings(np.zeros((0, 4, 2)), np.zeros(0, int), dashes(0, 0, 0), np.zeros(0, bool))
RING = town("town04")
WEAVING = [street[0] for street in RING.streets if len(street[0].lanes) == 3]
DT = 0.1


def car(road: Road, lane: int, along: float, speed: float, path: tuple[int, ...] = (), drives: bool = True) -> User:
    """A car in the middle of a lane."""
    x, y = road.position(lane, along).tolist()
    return User((x, y), road.lanes[lane].heading_at(along), speed, speed, drives=drives, path=path)


def far_away(road: Road, lane: int) -> User:
    """An ego vehicle that is in nobody's way."""
    return car(road, lane, 1.0, 0.0, drives=False)


def go_on(lane: int, count: int) -> tuple[int, ...]:
    """A lane and those that continue it."""
    lanes = [lane]
    for _ in range(count):
        lanes.append(int(RING.road.following[lanes[-1]]))
    return tuple(lanes)


@pytest.mark.parametrize("place", range(4))
def test_who_wants_to_leave_the_motorway_changes_to_the_third_lane(place: int) -> None:
    weaving = WEAVING[place]
    before = int(np.flatnonzero(RING.road.following == weaving.entries[1])[0])
    path = (before, *go_on(weaving.entries[2], 3))
    traffic = Traffic(RING.road, [far_away(RING.road, WEAVING[place - 2].entries[0]), car(RING.road, before, 5.0, 18.0, path)])
    lanes = []
    for _ in range(400):
        traffic.act()
        traffic.move(DT)
        lanes.append(int(traffic.lane[1]))
    assert weaving.entries[1] in lanes, "the lane goes on straight"
    assert path[2] in lanes, "the ramp"


@pytest.mark.parametrize("others", [0, 2])
def test_who_wants_to_stay_gets_off_the_third_lane(others: int) -> None:
    weaving = WEAVING[0]
    ramp = next(lane for lane in np.flatnonzero(RING.road.following == weaving.entries[2]))
    path = (int(ramp), *go_on(weaving.entries[1], 3))
    crowd = [car(RING.road, weaving.entries[1], 12.0 + 24.0 * index, 15.0) for index in range(others)]
    traffic = Traffic(
        RING.road, [far_away(RING.road, WEAVING[2].entries[0]), car(RING.road, int(ramp), 5.0, 14.0, path), *crowd]
    )
    for _ in range(250):
        traffic.act()
        traffic.move(DT)
    assert int(traffic.lane[1]) in RING.road.with_lanes_beside(path[2:])


def test_far_from_the_end_of_a_lane_nobody_is_in_a_hurry() -> None:
    weaving = WEAVING[0]
    path = go_on(weaving.entries[1], 2)
    third = weaving.entries[2]
    traffic = Traffic(RING.road, [far_away(RING.road, WEAVING[2].entries[0]), car(RING.road, third, 10.0, 15.0, path)])
    while traffic.along[third, 1] < RING.road.length[third] - GET_BACK - 3.0:
        traffic.act()
        traffic.move(DT)
        assert traffic.target_lane[1] == third


def test_towards_leads_from_lane_to_lane() -> None:
    road = town("town04").road
    left, middle, right = WEAVING[0].entries
    towards = road.towards([left])
    assert towards[[left, middle, right]].tolist() == [left, left, middle]
    assert len({int(road.row_of[lane]) for lane in (left, middle, right)}) == 1
    others = np.setdiff1d(np.arange(len(road.length)), [left, middle, right])
    np.testing.assert_array_equal(towards[others], others)


@pytest.mark.parametrize("name", PLANS)
def test_lanes_beside_each_other_are_so_both_ways(name: str) -> None:
    road = town(name).road
    for lane, left in enumerate(road.left):
        assert left == NO_LANE or road.right[left] == lane
    for lane, row in enumerate(road.row_of):
        assert row in road.row(lane, road.left)


@pytest.mark.parametrize(("offset", "off"), [(0.45, False), (0.55, True), (0.95, True)])
def test_a_narrow_street_has_room_for_a_car_and_half_a_metre_on_either_side(offset: float, off: bool) -> None:
    env: Any = gymnasium.make("esad-town03-vector-v0").unwrapped
    env.reset(seed=0)
    narrow = int(np.flatnonzero((env.road.width == 3.0) & (env.road.curvature == 0))[0])
    env.traffic.position[EGO] = env.road.position(narrow, 20.0, offset)
    env.traffic.heading[EGO] = env.road.heading[narrow]
    env.traffic.speed[EGO] = 0.0
    env.traffic.position[1:] += 5000.0
    env.traffic.move(DT)
    env._check_crash()
    assert env.off_road == off and not env.collided


@pytest.mark.parametrize("name", ["town03", "town04", "town07"])
def test_nobody_starts_faster_than_the_lane_allows(name: str) -> None:
    env: Any = gymnasium.make(f"esad-{name}-vector-v0").unwrapped
    for seed in range(20):
        env.reset(seed=seed)
        assert env.traffic.speed[EGO] <= env.road.speed_limit[env.route.lanes[0]]


def before_a_light(speed: float, distance: float, closed_for: float) -> Any:
    """Town 10 without anybody else; the agent comes to a light that has not been green for some time."""
    env: Any = gymnasium.make("esad-town10-vector-v0", config={"cars": 0, "people": 0}).unwrapped
    for seed in range(50):
        env.reset(seed=seed)
        lane = env.route.lanes[0]
        way = env.right_of_way.way_ahead(env.traffic, EGO)
        if way is None:
            env.traffic.position[EGO] = env.road.position(lane, float(env.road.length[lane]) - 30.0)
            env.traffic.move(0.0)
            way = env.right_of_way.way_ahead(env.traffic, EGO)
        times = np.arange(0.0, PERIOD, 0.1)
        closed = [env.lights.closed(time)[way[0]] for time in times]
        if closed[0] or not any(closed):
            continue
        env.episode.time = float(times[closed.index(True)]) + closed_for - 1 / env.config["policy_frequency"]
        env.traffic.position[EGO] = env.road.position(lane, float(env.road.length[lane]) - SETBACK - distance)
        env.traffic.speed[EGO] = speed
        env.traffic.move(0.0)
        return env
    raise AssertionError("no episode begins before a light")


@pytest.mark.parametrize(("closed_for", "infractions"), [(0.5, 0), (AMBER - 0.3, 0), (AMBER + 0.3, 1), (6.0, 1)])
def test_a_red_light_counts_once_and_an_amber_one_does_not(closed_for: float, infractions: int) -> None:
    env = before_a_light(speed=8.0, distance=1.0, closed_for=closed_for)
    hold, costs = SpeedKeeper(), 0.0
    for _ in range(6):
        _, _, terminated, _, info = env.step(hold(env))
        costs += info["cost"]
        assert info["cost"] == float(info["cost_terms"]["red_light"])
        if terminated:
            break
    assert env.episode.infractions["red_light"] == infractions == costs


@pytest.mark.parametrize(("distance", "stops"), [(30.0, True), (8.0, True), (3.0, False)])
def test_a_light_that_turns_amber_stops_those_who_can(distance: float, stops: bool) -> None:
    """At 9 m/s one needs 6.75 m."""
    env = before_a_light(speed=9.0, distance=distance, closed_for=0.2)
    env._before_physics()
    assert (env.traffic.stop_distance[EGO] < np.inf) == stops
    if stops:
        assert env.traffic.stop_distance[EGO] == pytest.approx(distance, abs=0.1)


def test_lines_before_lights_leave_room_for_people() -> None:
    plan = town("town10")
    lights = TrafficLights(plan.road, plan.ways, np.zeros(16))
    centres = lights.lines(0.0).corners.mean(1)
    ends = np.array([plan.road.end(way.source) for way in plan.ways])
    nearest = np.hypot(*(centres[:, None] - ends[None]).transpose(2, 0, 1)).min(1)
    np.testing.assert_allclose(nearest, SETBACK, atol=1e-6)


def street(speed: float, x: float = 0.0, y: float = 0.0) -> User:
    """A car on a wide straight street along the x axis."""
    return User((x, y), 0.0, speed, speed, drives=False)


def walk(cars: list[User], ends: list[list[list[float]]], speed: float, steps: int) -> tuple[Traffic, list[Any]]:
    """Let people walk among cars that hold their speed, 5 decisions a second, and note where they are."""
    road = Road([Lane((-100.0, 0.0), 0.0, 300.0, width=30.0)], NOTHING)
    walkers = Walkers(np.random.default_rng(0), np.array(ends), speed, (0.0, 0.0), caution=1.0)
    traffic, places = Traffic(road, [*cars, *walkers.people()]), []
    people = traffic.kind == Kind.PERSON
    for step in range(steps):
        walkers.walk(traffic, step / 5)
        for _ in range(2):
            traffic.move(DT)
            places.append(traffic.position[people].copy())
    return traffic, places


@pytest.mark.parametrize("speed", [1.0, 2.0, 3.0])
def test_nobody_walks_into_a_car_that_stands_in_the_way(speed: float) -> None:
    """They stop beside it, and turn round when they have waited long enough."""
    _, places = walk([street(0.0)], [[[0.5, -8.0], [0.5, 8.0]]], speed, steps=round((8 / speed + PATIENCE + 2) * 5))
    across = np.array(places)[:, 0, 1]
    assert across.max() < -1.0 - 0.42, "half a car, and half the diagonal of a person"
    assert across.max() > -1.0 - 1.7, "and they come near it"
    assert across[-1] < across.max() - 0.5


@pytest.mark.parametrize(("away", "waits"), [(6.0, True), (40.0, False)])
def test_nobody_steps_in_front_of_a_car_that_drives(away: float, waits: bool) -> None:
    _, places = walk([street(8.0, x=-away)], [[[0.0, -2.3], [0.0, 6.0]]], 2.0, steps=5)
    assert (np.array(places)[-1, 0, 1] < -1.6) == waits


def test_who_is_in_front_of_a_car_already_walks_on() -> None:
    _, places = walk([street(8.0, x=-12.0)], [[[0.0, -0.5], [0.0, 6.0]]], 2.0, steps=4)
    assert np.array(places)[-1, 0, 1] > 1.0
