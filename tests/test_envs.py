"""What all scenarios share, by the example of the highway."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv

import sb3_esad.envs
from sb3_esad.envs import rewards
from sb3_esad.envs.drivers import CarFollower, SpeedKeeper
from sb3_esad.envs.geometry import box_corners, boxes_overlap
from sb3_esad.envs.highway import Highway
from sb3_esad.envs.lanes import LANE_WIDTH
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, User
from sb3_esad.envs.vehicle import Controls

IDS = [f"esad-highway{suffix}-v0" for suffix in ("", "-vector", "-dict")]
HOLD = np.zeros(2, np.float32)


def make(env_id: str = IDS[0], **kwargs: Any) -> Any:
    """The scenario itself, without gymnasium's wrappers."""
    return gymnasium.make(env_id, **kwargs).unwrapped


def alone(speed: float = 25.0, y: float = 4.0, heading: float = 0.0, x: float = 0.0, others: tuple[User, ...] = ()) -> Any:
    """A highway with nobody else on it, or only those given."""
    env = make()
    env.reset(seed=0)
    env.traffic = Traffic(env.road, [User((x, y), heading, speed, 25.0, drives=False), *others])
    return env


def test_episodes_differ_without_a_seed() -> None:
    env = make()
    first, _ = env.reset(seed=3)
    second, _ = env.reset()
    assert not np.array_equal(first, second)


def test_subprocesses() -> None:
    venv = make_vec_env(f"sb3_esad.envs:{IDS[2]}", n_envs=2, seed=0, vec_env_cls=SubprocVecEnv)
    observation = venv.reset()
    assert isinstance(observation, dict)
    assert observation["image"].shape == (2, 3, 64, 64)
    _, _, _, infos = venv.step(np.zeros((2, 2)))
    assert all("cost" in info for info in infos)
    venv.close()


def test_importing_loads_no_simulator_and_no_window() -> None:
    package = str(Path(sb3_esad.envs.__file__).parents[1])
    code = f"""if True:
        import sys, types
        sys.modules["sb3_esad"] = types.ModuleType("sb3_esad")  # whatever else the package may load
        sys.modules["sb3_esad"].__path__ = [{package!r}]
        import sb3_esad.envs
        print({{"pygame", "highway_env", "cv2", "torch", "scipy"}} & set(sys.modules) or "nothing")
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "nothing"


def test_nobody_runs_into_a_driver_who_brakes_hard() -> None:
    env, follow = make(IDS[1]), CarFollower()
    for seed in range(15):
        env.reset(seed=seed)
        terminated = truncated = False
        while not (terminated or truncated):
            action = follow(env)
            if (env.episode.steps // 10 + seed) % 4 == 0:
                action[0] = -1.0
            _, _, terminated, truncated, info = env.step(action)
        assert info["driving"]["collisions"] == 0, f"seed {seed}"


def test_the_car_ahead_slows_down_and_drives_on() -> None:
    env, follow = make(IDS[1], config={"slowdown_share": 1.0, "slowdown_start": (3.0, 3.0)}), CarFollower()
    env.reset(seed=0)
    wanted = env.traffic.target_speed.copy()
    slow = []
    for _ in range(60):
        env.step(follow(env))
        slow.append(np.flatnonzero(env.traffic.target_speed != wanted).tolist())
    assert not any(slow[:14])
    assert [len(rows) for rows in slow[15:30]] == [1] * 15, "one car, for 3 s"
    assert not any(slow[31:])
    assert env.traffic.kind[slow[20][0]] == Kind.VEHICLE


def test_traffic_does_not_crash_into_itself_and_merges() -> None:
    merged = 0
    for seed in range(6):
        env, follow = make(IDS[1]), CarFollower()
        env.reset(seed=seed)
        traffic, terminated = env.traffic, False
        ramp = traffic.drivers[traffic.lane[traffic.drivers] >= env.lanes]
        while not terminated:
            corners = box_corners(traffic.position, traffic.heading, traffic.size)
            for row in range(len(corners) - 1):
                assert not boxes_overlap(corners[row], corners[row + 1 :]).any(), f"seed {seed}, {env.episode.time:.1f} s"
            _, _, terminated, _, _ = env.step(follow(env))
        merged += int((traffic.lane[ramp] < env.lanes).sum())
    assert merged >= 6


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"durration": 3}, "did you mean 'duration'"),
        ({"reward_weights": {"velocty": 1.0}}, "did you mean 'velocity'"),
        ({"frame": "world"}, "choose one of lane, ego"),
        ({"physics_frequency": 7}, "no multiple"),
        ({"max_speed": 20.0}, r"start_speed \(22.0, 25.0\) goes beyond max_speed 20.0; lower the one or raise the other"),
        ({"physics_frequency": 0}, "physics_frequency is 0; choose a whole number from 1 on"),
        ({"target_speed": 0}, "target_speed is 0; choose a number above 0"),
        ({"duration": -1.0}, "duration is -1.0; choose a number above 0"),
        ({"lane_tolerance": float("nan")}, "lane_tolerance is nan; choose a number above 0"),
        ({"route_length": "long"}, "route_length is 'long'; choose a number above 0"),
        ({"image_shape": (64,)}, r"image_shape is \(64,\); choose two numbers above 0"),
        ({"metres_per_pixel": (0, 1)}, r"metres_per_pixel is \(0, 1\); choose two numbers above 0"),
        ({"graded_cost_ttc": 0}, "graded_cost_ttc is 0; choose a number"),
        ({"policy_frequency": 0}, "policy_frequency is 0; choose a whole number from 1 on"),
        ({"policy_frequency": -5}, "policy_frequency is -5; choose"),
        ({"policy_frequency": 2.5}, r"policy_frequency is 2\.5; choose"),
        ({"policy_frequency": "5"}, "policy_frequency is '5'; choose"),
        ({"headway": (-1.0, -0.5)}, r"headway is \(-1\.0, -0\.5\); choose two numbers from 0 on, the smaller one first"),
        ({"desired_speed": (25.0, 21.5)}, r"desired_speed is \(25\.0, 21\.5\); choose two numbers"),
        ({"lane_counts": 3}, "lane_counts is 3; choose a sequence of whole numbers from 2 on"),
        ({"lane_counts": (1, 2)}, r"lane_counts is \(1, 2\); choose a sequence of whole numbers from 2 on"),
        ({"lane_counts": ()}, r"lane_counts is \(\); choose"),
        ({"slow_share": 1.2}, r"slow_share is 1\.2; choose a share from 0 to 1"),
        ({"merging_cars": -1}, "merging_cars is -1; choose a whole number from 0 on"),
        ({"traffic_ahead": float("inf")}, "traffic_ahead is inf; choose a number from 0 on"),
        (
            {"reward_weights": 0.5},
            r"reward_weights is 0\.5; give a dictionary with some of the keys velocity, lane, orientation, exploration",
        ),
    ],
)
def test_wrong_configurations_are_named(config: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(config=config)


def test_pictures_come_as_often_as_decisions(monkeypatch: pytest.MonkeyPatch) -> None:
    env = Highway({"policy_frequency": 10}, render_mode="human")
    assert env.metadata["render_fps"] == 10 and Highway.metadata["render_fps"] == 5
    shown = []
    monkeypatch.setattr(env, "render", lambda: shown.append(env.episode.steps))
    env.reset(seed=0)
    env.step(np.zeros(2, dtype=np.float32))
    assert shown == [0, 1]


def test_wrong_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="unknown observation 'sound'"):
        make(observation="sound")
    with pytest.raises(ValueError, match="unknown render_mode"):
        Highway(render_mode="ansi")
    env = make()
    env.reset(seed=0)
    for action in (np.zeros(3), np.array([np.nan, 0.0])):
        with pytest.raises(ValueError, match="two finite numbers"):
            env.step(action)


def test_configuration_overrides_keep_the_rest() -> None:
    env = make(IDS[1], config={"duration": 2.0, "reward_weights": {"exploration": 0.5}})
    assert env.config["reward_weights"]["velocity"] == 0.7
    env.reset(seed=0)
    ends = [env.step(HOLD)[2:4] for _ in range(10)]
    assert ends == [(False, False)] * 9 + [(False, True)]


def test_the_image_is_never_blank_and_shows_the_ego_vehicle() -> None:
    env = make()
    for seed in range(10):
        image, _ = env.reset(seed=seed)
        assert image[0].max() > 150
        assert image[2, 48:51, 30:34].min() > 90
        assert image[1].max() > 0 or seed


def test_lane_frame_and_ego_frame() -> None:
    images = {}
    for frame in ("lane", "ego"):
        env = make(config={"frame": frame})
        env.reset(seed=0)
        env.traffic = Traffic(env.road, [User((50.0, 4.0), 0.2, 25.0, drives=False)])
        env._note_heading()
        images[frame] = env.observation.observe(env)
    rows = {frame: image[0].astype(float).std(0).mean() for frame, image in images.items()}
    assert rows["lane"] < rows["ego"], "along its columns a road aligned with the lane changes little"


def test_vector_by_hand() -> None:
    env = make(IDS[1])
    env.reset(seed=0)
    lanes = env.lanes
    others = [User((30.0, 8.0), 0.0, 10.0), User((-10.0, 4.0), 0.1, 25.0), User((300.0, 0.0), 0.0, 25.0)]
    env.traffic = Traffic(env.road, [User((0.0, 4.5), 0.0, 25.0, drives=False), *others])
    vector = env.observation.observe(env)
    assert vector[:6] == pytest.approx([25 / 30, 0.0, 0.25, 1.0, 6.5 / 16, (lanes * LANE_WIDTH - 6.5) / 16])
    users = vector[6:].reshape(8, 7)
    assert users[0, :5] == pytest.approx([1, -0.1, -0.5 / 16, (25 * np.cos(0.1) - 25) / 30, 25 * np.sin(0.1) / 30], abs=1e-6)
    assert users[0, 5:] == pytest.approx([np.cos(0.1), np.sin(0.1)])
    assert users[1] == pytest.approx([1, 0.3, 3.5 / 16, -0.5, 0, 1, 0])
    assert not users[2:].any(), "the third is too far away"


def test_holding_speed_and_lane_alone_is_perfect() -> None:
    env = alone()
    total = 0.0
    for _ in range(121):
        _, reward, terminated, truncated, info = env.step(HOLD)
        assert reward == pytest.approx(1.0)
        assert info["cost"] == 0.0
        total += reward
        if terminated or truncated:
            break
    assert terminated
    assert not truncated
    assert info["is_success"]
    assert info["driving"]["driving_score"] == 1.0
    assert info["driving"]["return"] == pytest.approx(total)
    assert info["driving"]["distance"] == pytest.approx(600.0, abs=5.0)


def test_speed_and_acceleration_limits() -> None:
    env = alone(speed=25.0)
    for _ in range(15):
        env.step(np.array([1.0, 0.0]))
    assert env.traffic.speed[EGO] == pytest.approx(30.0)
    _, _, _, _, info = env.step(np.array([-1.0, 0.0]))
    assert info["speed"] == pytest.approx(30.0 - 6.0 * 0.2)
    for _ in range(60):
        env.step(np.array([-1.0, 0.0]))
    assert env.traffic.speed[EGO] == 0.0


@pytest.mark.parametrize("speed", [3.0, 10.0, 20.0, 30.0])
def test_steering_is_limited_by_wheel_angle_and_lateral_acceleration(speed: float) -> None:
    controls = Controls(3.0, 6.0, 0.5, 4.0, 30.0, (5.0, 2.0))
    _, angle = controls.decode(np.array([0.0, 1.0]), speed)
    yaw_rate = speed * np.sin(np.arctan(0.5 * np.tan(angle))) / 2.5
    assert angle <= 0.5 + 1e-9
    assert yaw_rate * speed <= 4.0 + 1e-9
    assert angle == pytest.approx(0.5) or yaw_rate * speed == pytest.approx(4.0)


@given(pedal=st.floats(-1, 1), wheel=st.floats(-1, 1), speed=st.floats(0, 30))
@settings(max_examples=100, deadline=None)
def test_encode_inverts_decode(pedal: float, wheel: float, speed: float) -> None:
    controls = Controls(3.0, 6.0, 0.5, 4.0, 30.0, (5.0, 2.0))
    action = np.array([pedal, wheel])
    np.testing.assert_allclose(controls.encode(*controls.decode(action, speed), speed), action, atol=1e-6)


def test_leaving_the_road_is_no_collision_but_counts_as_the_barrier() -> None:
    env = alone(y=0.0, heading=-0.1)
    while True:
        _, _, terminated, truncated, info = env.step(HOLD)
        if terminated or truncated:
            break
    assert terminated
    assert info["crashed"]
    assert info["cost"] == 1.0
    assert info["cost_terms"] == {"collision": False, "off_road": True, "wrong_way": False, "red_light": False}
    assert info["driving"]["infractions_static"] == info["driving"]["collisions"] == 1.0
    assert not info["is_success"]


@pytest.mark.parametrize(("kind", "name"), [(Kind.VEHICLE, "vehicle"), (Kind.STATIC, "static"), (Kind.PERSON, "person")])
def test_hitting_something_ends_the_episode_and_is_named(kind: Kind, name: str) -> None:
    env = alone(others=(User((40.0, 4.0), kind=kind, drives=False),))
    terminated = False
    while not terminated:
        _, _, terminated, _, info = env.step(HOLD)
        assert info["cost"] == float(terminated)
    assert env.episode.time == pytest.approx(1.4, abs=0.11), "35 m at 25 m/s"
    assert info["cost_terms"] == {"collision": True, "off_road": False, "wrong_way": False, "red_light": False}
    assert info["driving"][f"infractions_{name}"] == 1.0
    assert info["driving"]["infractions"] == 1.0


def test_hitting_something_off_the_road_is_both_and_costs_once() -> None:
    env = alone(y=-4.0, others=(User((5.0, -4.0), kind=Kind.STATIC, drives=False),))
    _, _, terminated, _, info = env.step(HOLD)
    assert terminated and info["crashed"]
    assert info["cost_terms"] == {"collision": True, "off_road": True, "wrong_way": False, "red_light": False}
    assert info["cost"] == info["driving"]["collisions"] == 1.0


def test_wrong_way_and_ramp() -> None:
    env = alone(speed=5.0, x=100.0, heading=np.pi)
    _, reward, _, _, info = env.step(HOLD)
    assert info["cost_terms"]["wrong_way"]
    assert info["rewards"]["velocity"] == info["rewards"]["lane"] == info["rewards"]["orientation"] == 0.0
    assert reward == 0.0
    env = alone(speed=20.0, x=float(env.road.start[env.lanes, 0]) + 20.0, y=LANE_WIDTH * env.lanes)
    _, reward, _, _, _ = env.step(HOLD)
    assert env.episode.off_route == pytest.approx(4.0)
    assert reward == 0.0, "the ramp is not the way"


def test_graded_cost_rises_before_the_crash() -> None:
    env = make(config={"graded_cost": True})
    env.reset(seed=0)
    other = User((50.0, 4.0), kind=Kind.STATIC, drives=False, size=(5.0, 2.0))
    env.traffic = Traffic(env.road, [User((0.0, 4.0), 0.0, 25.0, drives=False), other])
    costs = []
    for _ in range(20):
        _, _, terminated, _, info = env.step(HOLD)
        costs.append(info["cost"])
        if terminated:
            break
    assert costs[0] == 0.0
    assert costs[3] == pytest.approx(1 - (45 - 20) / 25 / 1.5)
    assert costs == sorted(costs)
    assert terminated
    assert 0.5 < costs[-2] < costs[-1] == 1.0, "a crash costs no more than an indicator"
    env.reset(seed=0)
    env.traffic = Traffic(env.road, [User((100.0, 4.0), np.pi, 5.0, drives=False)])
    assert env.step(HOLD)[-1]["cost"] == 1.0, "the wrong way, with nobody near"


def test_reward_terms_by_hand() -> None:
    assert rewards.velocity_reward(25.0, 25.0, 0.2) == 1.0
    assert rewards.velocity_reward(0.0, 25.0, 0.2) == rewards.velocity_reward(-9.0, 25.0, 0.2) == 0.0
    assert rewards.velocity_reward(20.0, 25.0, 0.2) == pytest.approx((1 / 2 - 1 / 6) / (1 - 1 / 6))
    assert rewards.velocity_reward(30.0, 25.0, 0.2) == pytest.approx(0.4)
    assert rewards.lane_reward(0.0, 2.0) == 1.0
    assert rewards.lane_reward(-0.5, 2.0) == pytest.approx(0.75)
    assert rewards.lane_reward(2.1, 2.0) == -1.0
    assert rewards.orientation_reward(-0.2, 5.0) == pytest.approx(0.5)
    assert rewards.exploration_reward(0, 0.1) == 1.0
    assert rewards.exploration_reward(10, 0.1) == pytest.approx(np.exp(-1))
    assert rewards.progress_share(-3.0, 25.0) == 0.0
    assert rewards.progress_share(30.0, 25.0) == 1.0


def test_every_metre_per_second_pays_more_than_the_one_before() -> None:
    """By hand: at 20 of 25 m/s (1/2 - 1/6) / (1 - 1/6) with the scenario's 0.2 s/m."""
    sharpness = alone().config["velocity_sharpness"]
    pays = [rewards.velocity_reward(float(speed), 25.0, sharpness) for speed in range(26)]
    assert pays[20] == pytest.approx(0.4) and (pays[0], pays[25]) == (0.0, 1.0)
    assert (np.diff(pays) > 0).all() and (np.diff(pays, n=2) > 0).all()


def test_parking_pays_nothing_and_exploration_wears_off() -> None:
    env = alone(speed=0.0)
    explored = []
    for _ in range(5):
        _, reward, _, _, info = env.step(HOLD)
        explored.append(info["rewards"]["exploration"])
        assert reward == 0.0
    assert explored == pytest.approx(np.exp(-0.1 * np.arange(5)))


def brute_force_overlap(first: np.ndarray, second: np.ndarray) -> bool:
    """Whether a fine grid of points on one box, edges included, has a point in the other."""
    u, v = np.meshgrid(np.linspace(0, 1, 60), np.linspace(0, 1, 60))
    points = first[0] + u[..., None] * (first[1] - first[0]) + v[..., None] * (first[3] - first[0])
    inside = np.ones(u.shape, bool)
    for i in range(4):
        edge = second[(i + 1) % 4] - second[i]
        offset = points - second[i]
        inside &= edge[0] * offset[..., 1] - edge[1] * offset[..., 0] >= 0
    return bool(inside.any())


@given(
    place=st.tuples(st.floats(-7, 7), st.floats(-7, 7)), turns=st.tuples(st.floats(-4, 4), st.floats(-4, 4)),
    size=st.tuples(st.floats(0.5, 6), st.floats(0.5, 3)),
)  # fmt: skip
@settings(max_examples=150, deadline=None)
def test_overlap_equals_brute_force(place: tuple[float, float], turns: tuple[float, float], size: tuple[float, float]) -> None:
    def boxes(growth: float) -> np.ndarray:
        return box_corners(np.array([(0.0, 0.0), place]), np.array(turns), np.array([(5.0, 2.0), size]) + growth)

    exact, smaller, larger = boxes(0.0), boxes(-0.25), boxes(0.25)
    found = boxes_overlap(exact[0], exact[1:])[0]
    if brute_force_overlap(smaller[1], smaller[0]):
        assert found
    if not brute_force_overlap(larger[1], larger[0]) and not brute_force_overlap(larger[0], larger[1]):
        assert not found


def test_render_shows_a_picture() -> None:
    env = make(render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (320, 960, 3)
    assert picture.dtype == np.uint8
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 20
    assert make().render() is None


def test_scripted_drivers_want_a_scenario() -> None:
    with pytest.raises(ValueError, match="no driving scenario"):
        SpeedKeeper()(gymnasium.make("CartPole-v1"))
