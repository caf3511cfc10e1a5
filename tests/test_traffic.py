"""Traffic on straight lanes moves as highway-env's does, and minds the ego vehicle."""

import numpy as np
import pytest
from highway_env.road.road import Road as StockRoad
from highway_env.road.road import RoadNetwork
from highway_env.vehicle.behavior import IDMVehicle

from sb3_esad.envs.lanes import NO_LANE, Lane
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.roads import Markings, Road, dashes
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, Temper, User

LANES, LENGTH, DT = 4, 10_000.0, 0.1
NOTHING = Markings(np.zeros((0, 4, 2)), np.zeros(0, int), dashes(0, 0, 0), np.zeros(0, bool))


def straight_road(lanes: int = LANES, length: float = LENGTH) -> Road:
    """Parallel lanes, the leftmost at y = 0."""
    return Road(
        [
            Lane.between(
                (0.0, 4.0 * i), (length, 4.0 * i), left=i - 1 if i else NO_LANE, right=i + 1 if i < lanes - 1 else NO_LANE
            )
            for i in range(lanes)
        ],
        NOTHING,
    )


def crowd(seed: int, count: int = 24) -> list[dict[str, float]]:
    """Dense traffic of mixed speeds, so that many lanes are changed."""
    random = np.random.default_rng(seed)
    x, cars = 50.0, []
    for _ in range(count):
        x += random.uniform(8.0, 22.0)
        speed = random.uniform(16.0, 26.0)
        cars.append(
            {
                "x": x,
                "lane": int(random.integers(LANES)),
                "speed": speed,
                "target": speed + random.uniform(-4.0, 5.0),
                "exponent": random.uniform(3.5, 4.5),
            }
        )
    return cars


class Stock(IDMVehicle):
    """As highway-env has it, before one of its environments has changed the class for all others."""

    COMFORT_ACC_MAX, COMFORT_ACC_MIN = 3.0, -5.0
    DISTANCE_WANTED, TIME_WANTED = 10.0, 1.5


def drive_stock(cars: list[dict[str, float]], steps: int) -> tuple[np.ndarray, int]:
    """Final positions in highway-env, and how often a car was seen changing lane."""
    road = StockRoad(network=RoadNetwork.straight_road_network(LANES, speed_limit=30.0))
    for car in cars:
        vehicle = Stock(road, [car["x"], 4.0 * car["lane"]], 0.0, car["speed"], target_speed=car["target"])
        vehicle.DELTA = car["exponent"]
        vehicle.check_collisions = False
        road.vehicles.append(vehicle)
    changes = 0
    for _ in range(steps):
        road.act()
        changes += sum(v.target_lane_index != v.lane_index for v in road.vehicles)
        road.step(DT)
    return np.array([v.position for v in road.vehicles]), changes


def drive_ours(cars: list[dict[str, float]], steps: int) -> np.ndarray:
    """Final positions in our traffic."""
    users = []
    for car in cars:
        position = (car["x"], 4.0 * car["lane"])
        timer = (sum(position) * np.pi) % 1.0
        temper = Temper(exponent=car["exponent"])
        users.append(User(position, 0.0, car["speed"], car["target"], temper=temper, timer=timer))
    traffic = Traffic(straight_road(), users)
    for _ in range(steps):
        traffic.act()
        traffic.move(DT)
    return traffic.position


@pytest.mark.parametrize("seed", range(50))
def test_positions_equal_stock_after_10_s(seed: int) -> None:
    cars = crowd(seed)
    stock, changes = drive_stock(cars, steps=100)
    assert changes > 0, "the comparison means little if nobody changes lane"
    np.testing.assert_allclose(drive_ours(cars, steps=100), stock, atol=0.1)


def test_follower_settles_at_the_equilibrium_gap() -> None:
    temper, speed = Temper(headway=1.2, gap=9.0), 20.0
    users = [User((200.0, 0.0), 0.0, speed, drives=False), User((100.0, 0.0), 0.0, speed, 25.0, temper=temper)]
    traffic = Traffic(straight_road(lanes=1), users)
    for _ in range(1200):
        traffic.act()
        traffic.move(DT)
    gap = traffic.position[0, 0] - traffic.position[1, 0]
    assert traffic.speed[1] == pytest.approx(speed, abs=1e-3)
    assert gap == pytest.approx((9.0 + 1.2 * speed) / np.sqrt(1 - (speed / 25.0) ** 4), rel=1e-3)


def test_cars_stop_for_what_stands_in_their_lane_and_never_reverse() -> None:
    users = [User((400.0, 0.0), drives=False, kind=Kind.STATIC), User((100.0, 0.0), 0.0, 25.0, 25.0)]
    traffic = Traffic(straight_road(lanes=1), users)
    for _ in range(600):
        traffic.act()
        traffic.move(DT)
        assert traffic.speed[1] >= 0.0
        assert traffic.position[1, 0] < 395.0
    assert traffic.speed[1] < 0.1


def test_cars_look_into_the_lane_that_continues_theirs() -> None:
    road = Road([Lane.between((0.0, 0.0), (100.0, 0.0), following=1), Lane.between((100.0, 0.0), (300.0, 0.0))], NOTHING)
    traffic = Traffic(road, [User((150.0, 0.0), drives=False), User((40.0, 0.0), 0.0, 20.0, 20.0)])
    assert traffic.front[1] == EGO
    for _ in range(200):
        traffic.act()
        traffic.move(DT)
    assert 100.0 < traffic.position[1, 0] < 145.0
    assert traffic.lane[1] == traffic.target_lane[1] == 1


def slow_leader_beside(other: User) -> Traffic:
    """Row 2 is stuck behind a slow car in lane 0 and would like to change into lane 1, where ``other`` is."""
    return Traffic(
        straight_road(lanes=2),
        [other, User((130.0, 0.0), 0.0, 12.0, 12.0), User((100.0, 0.0), 0.0, 20.0, 25.0, timer=2.0)],
    )


@pytest.mark.parametrize(
    ("place", "changes"), [((100.0, 4.0), False), ((92.0, 4.0), False), ((108.0, 4.0), False), ((900.0, 4.0), True)]
)
def test_nobody_changes_into_the_ego_vehicle(place: tuple[float, float], changes: bool) -> None:
    traffic = slow_leader_beside(User(place, 0.0, 20.0, 25.0, drives=False))
    traffic.act()
    assert bool(traffic.target_lane[2] == 1) is changes


def test_nobody_changes_into_a_lane_that_the_ego_vehicle_is_entering() -> None:
    road = straight_road(lanes=3)
    rest = [User((130.0, 0.0), 0.0, 12.0, 12.0), User((100.0, 0.0), 0.0, 20.0, 25.0, timer=2.0)]
    straight = Traffic(road, [User((99.0, 8.0), 0.0, 20.0, 25.0, drives=False), *rest])
    turning = Traffic(road, [User((99.0, 8.0), -0.15, 20.0, 25.0, drives=False), *rest])
    for traffic, lane in ((straight, 1), (turning, 0)):
        traffic.act()
        assert traffic.target_lane[2] == lane


def test_projection_is_exact_on_a_slanted_lane() -> None:
    road = Road([Lane.between((10.0, 5.0), (10.0 + 30.0, 5.0 + 40.0))], NOTHING)
    along, across = road.project(np.array([[10.0, 5.0], [40.0, 45.0], [10.0 - 0.8, 5.0 + 0.6]]))
    np.testing.assert_allclose(along[0], [0.0, 50.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(across[0], [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(road.position(0, 50.0, 1.0), [40.0 - 0.8, 45.0 + 0.6])
