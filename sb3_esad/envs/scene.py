"""What there is to see of a scenario, for those who draw it and for those who observe it."""

from typing import Any, Protocol

from sb3_esad.envs.bev import Ground
from sb3_esad.envs.episode import Episode
from sb3_esad.envs.lights import StopLines
from sb3_esad.envs.roads import Road
from sb3_esad.envs.routes import Route
from sb3_esad.envs.traffic import Traffic


class Scene(Protocol):
    """A scenario as it is now."""

    config: dict[str, Any]
    road: Road
    route: Route
    ground: Ground
    traffic: Traffic
    episode: Episode

    @property
    def heading_error(self) -> float:
        """Angle from the lane to the ego vehicle [rad]."""

    @property
    def stop_lines(self) -> StopLines:
        """The lines before lights that are not green."""

    @property
    def remaining(self) -> float:
        """Share of the route that lies ahead."""

    @property
    def crashed(self) -> bool:
        """Whether the ego vehicle hit something or left the road."""
