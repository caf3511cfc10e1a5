"""Which lanes road users take one after the other."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_esad.envs.geometry import Floats
from sb3_esad.envs.lanes import NO_LANE
from sb3_esad.envs.roads import Ints, Road
from sb3_esad.envs.users import User

OFF_PATH = 1.5  # where lanes overlap, one is on that of one's path even if another is as much nearer [m]
LOOKAHEAD = 3  # lanes that are looked into beyond the present one
_NONE = np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros(0)


class Outlook(NamedTuple):
    """
    Where n users look: along a lane each, and along the lanes that they will take after it.

    :param rows: the users, shape ``(n,)``
    :param lanes: the lane of each, shape ``(n,)``
    :param order: whose each of k further lanes is, as a place among ``rows``; those of a user in order, the furthest first,
        shape ``(k,)``
    :param further: these lanes, shape ``(k,)``
    :param starts: how far each starts from the start of the user's first lane, shape ``(k,)`` [m]
    """

    rows: Ints
    lanes: Ints
    order: Ints
    further: Ints
    starts: Floats


class Paths:
    """
    The paths of all road users, looked up by user and lane.

    :param road: the lanes
    :param users: who takes them
    """

    def __init__(self, road: Road, users: Sequence[User]) -> None:
        self.next_lane = np.tile(road.following, (len(users), 1))
        """The lane that each user takes after each lane, ``NO_LANE`` if it ends there, shape ``(users, lanes)``."""
        self.towards = np.tile(np.arange(len(road.lanes)), (len(users), 1))
        """The lane to change to from each in order to be on the path, itself if there is none, shape ``(users, lanes)``."""
        self.leads_astray = np.zeros(self.next_lane.shape, dtype=bool)
        """Whether a lane is beside the path but does not lead on to where the path goes, shape ``(users, lanes)``."""
        self.handicap = np.zeros(self.next_lane.shape)
        """What keeps users off lanes that they will not take, shape ``(users, lanes)`` [m]."""
        for row, user in enumerate(users):
            if user.path:
                self._read(road, row, user.path)
        self.any_leads_astray = bool(self.leads_astray.any())
        self._any_goes_on = bool((self.next_lane != NO_LANE).any())
        self._further, self._starts = self._foresee(road)

    def _read(self, road: Road, row: int, path: Sequence[int]) -> None:
        lanes, wanted = np.array(path[:-1], dtype=np.int64), np.array(path[1:], dtype=np.int64)
        beside = road.row_of[road.following[lanes]] == road.row_of[wanted]  # there one changes lane instead
        turns = (road.following[lanes] == NO_LANE) | ~beside
        self.next_lane[row, lanes[turns]] = wanted[turns]
        self.towards[row] = road.towards(path)
        self.leads_astray[row] = road.leads_astray(path)
        self.handicap[row] = OFF_PATH
        self.handicap[row, list(road.with_lanes_beside(path))] = 0.0

    def _foresee(self, road: Road) -> tuple[Ints, Floats]:
        """
        Go on from every lane as every user would.

        :return: the lanes ahead, the furthest first, ``NO_LANE`` past the last one, and how far each starts from the start of
            the first [m]; both ``(users, lanes, LOOKAHEAD)``
        """
        users = np.arange(len(self.next_lane))[:, None]
        lanes, passed = np.tile(np.arange(len(road.lanes)), (len(users), 1)), np.zeros(self.next_lane.shape)
        further, starts = (np.empty((*lanes.shape, LOOKAHEAD), dtype=kind) for kind in (np.int64, np.float64))
        for place in reversed(range(LOOKAHEAD)):
            passed = passed + road.length[lanes]
            lanes = np.where(lanes == NO_LANE, NO_LANE, self.next_lane[users, lanes])
            further[..., place], starts[..., place] = lanes, passed
        return further, starts

    def outlook(self, rows: Ints, lanes: Ints) -> Outlook:
        """
        Tell which lanes some users will take.

        :param rows: users, shape ``(n,)``
        :param lanes: the lane from which each goes on, shape ``(n,)``
        :return: these lanes and those after them
        """
        if not self._any_goes_on:
            return Outlook(rows, lanes, *_NONE)
        further = self._further[rows, lanes]
        order, step = (further != NO_LANE).nonzero()
        return Outlook(rows, lanes, order, further[order, step], self._starts[rows[order], lanes[order], step])
