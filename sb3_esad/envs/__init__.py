"""Driving scenarios; importing this registers their ids with gymnasium and loads neither pygame nor highway-env."""

from gymnasium.envs.registration import register

_SCENARIOS = {
    "highway": "sb3_esad.envs.highway:Highway",
    "traffic-negotiation": "sb3_esad.envs.negotiation:TrafficNegotiation",
    "town03": "sb3_esad.envs.town_drive:Town03",
    "town04": "sb3_esad.envs.town_drive:Town04",
    "town06": "sb3_esad.envs.town_drive:Town06",
    "town07": "sb3_esad.envs.town_drive:Town07",
    "town10": "sb3_esad.envs.town_drive:Town10",
    "obstacle-avoidance": "sb3_esad.envs.obstacles:ObstacleAvoidance",
    "course": "sb3_esad.envs.course:Course",
    "course-1mps": "sb3_esad.envs.course:Course1",
    "course-2mps": "sb3_esad.envs.course:Course2",
    "course-3mps": "sb3_esad.envs.course:Course3",
    "braking": "sb3_esad.envs.braking:Braking",
}
_OBSERVATIONS = {"": "image", "-vector": "vector", "-dict": "dict"}

for _name, _entry_point in _SCENARIOS.items():
    for _suffix, _observation in _OBSERVATIONS.items():
        register(
            f"esad-{_name}{_suffix}-v0",
            entry_point=_entry_point,
            kwargs={"observation": _observation},
            disable_env_checker=True,  # it would check every observation; the tests run check_env instead
        )
