"""Obstacle avoidance: roadblocks, cones and stalled cars appear suddenly and block one or two lanes beside moving traffic."""

from typing import Any

from sb3_esad.envs.lanes import CAR_LENGTH, LANE_WIDTH
from sb3_esad.envs.road_users import EGO
from sb3_esad.envs.straight import StraightDrive
from sb3_esad.envs.traffic import Traffic
from sb3_esad.envs.users import Kind, Temper, User

NOWHERE = (-5000.0, 0.0)  # obstacles wait here
ROADBLOCK = ((0.0, 0.0, User(NOWHERE, kind=Kind.STATIC, drives=False, size=(1.0, 3.2))),)
STALLED_CAR = ((0.0, 0.0, User(NOWHERE, drives=False)),)
CONES = tuple(
    (2.0 * index, 1.4 - 0.95 * index, User(NOWHERE, kind=Kind.STATIC, drives=False, size=(0.6, 0.6))) for index in range(4)
)
BLOCKS = (ROADBLOCK, STALLED_CAR, CONES)
"""Ways to block a lane: users, and how far each stands past the place and to the right of the lane's centre [m]."""
CLEAR_AFTER = 8.0  # no lane is blocked while someone else is between the ego vehicle and this far past the place [m]
CLEARED_BEHIND = 25.0  # obstacles this far behind the ego vehicle are cleared away, lest traffic piles up there [m]


class ObstacleAvoidance(StraightDrive):
    """Drive 400 m at 12 m/s past obstacles that appear 25 to 50 m ahead. See :class:`Scenario`."""

    ego_temper = Temper(headway=0.8, gap=14.0, imposed_braking=3.0, gain=0.1, braking=3.0)

    @classmethod
    def default_config(cls) -> dict[str, Any]:
        """See :meth:`Scenario.default_config`."""
        return {
            **super().default_config(),
            "duration": 60.0,
            "route_length": 400.0,
            "target_speed": 12.0,
            "max_speed": 15.0,
            "start_speed": (10.0, 12.0),
            "traffic_behind": 60.0,
            "traffic_ahead": 160.0,
            "headway": (2.0, 6.0),
            "desired_speed": (10.0, 12.0),
            "desired_speed_spread": 1.0,
            "slow_share": 0.1,
            "slow_speed": (7.0, 9.0),
            "fast_share": 0.1,
            "fast_speed": (13.0, 15.0),
            "block_pause": (50.0, 90.0),
            "block_appears": (25.0, 50.0),
            "second_block_share": 0.4,
        }

    def _make_traffic(self) -> Traffic:
        self._draw_places()
        traffic = super()._make_traffic()
        self._obstacles = traffic.outsiders[traffic.outsiders != EGO]
        self._waiting = self._obstacles.tolist()
        return traffic

    def _draw_places(self) -> None:
        """Where lanes will be blocked, how far ahead that shows, and how many lanes it will be."""
        random, config = self.np_random, self.config
        self._places: list[tuple[float, float, int]] = []
        x = float(random.uniform(*config["block_pause"]))
        while x < config["route_length"]:
            lanes = 1 + int(self.lanes > 2 and random.random() < config["second_block_share"])
            self._places.append((x, float(random.uniform(*config["block_appears"])), lanes))
            x += float(random.uniform(*config["block_pause"]))

    def _others(self) -> list[User]:
        """The obstacles, all of them still nowhere."""
        random = self.np_random
        self._blocks = [BLOCKS[random.integers(len(BLOCKS))] for _, _, lanes in self._places for _ in range(lanes)]
        return [user for block in self._blocks for _, _, user in block]

    def _before_physics(self) -> None:
        if self._places and self._places[0][0] - self._places[0][1] <= self._progress():
            x, _, count = self._places.pop(0)
            for lane in [lane for lane in self._lanes_to_block() if not self._is_busy(lane, x)][:count]:
                self._block(lane, x)
        self._clear_behind()

    def _lanes_to_block(self) -> list[int]:
        """The ego vehicle's lane first, then the others in any order, save one beside it, which is the way out."""
        own = int(self.traffic.lane[EGO])
        beside = [lane for lane in (own - 1, own + 1) if 0 <= lane < self.lanes]
        way_out = self.np_random.choice(beside)
        others = self.np_random.permutation([lane for lane in range(self.lanes) if lane not in (own, way_out)])
        return [own, *others.tolist()]

    def _is_busy(self, lane: int, x: float) -> bool:
        traffic = self.traffic
        along = traffic.position[traffic.drivers, 0]
        near = (along > traffic.position[EGO, 0] - CAR_LENGTH) & (along < x + CLEAR_AFTER)
        there = traffic.present[lane, traffic.drivers] | (traffic.target_lane[traffic.drivers] == lane)
        return bool((near & there).any())

    def _block(self, lane: int, x: float) -> None:
        for past, right, _ in self._blocks.pop(0):
            self.traffic.position[self._waiting.pop(0)] = x + past, lane * LANE_WIDTH + right

    def _clear_behind(self) -> None:
        x = self.traffic.position[:, 0]
        self.traffic.position[self._obstacles[x[self._obstacles] < x[EGO] - CLEARED_BEHIND]] = NOWHERE
