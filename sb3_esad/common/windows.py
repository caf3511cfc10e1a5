"""Which windows of a replay buffer to draw, so that rare costs are in every batch."""

from typing import NamedTuple

import numpy as np

from sb3_esad.common.type_aliases import NO_EVENT


class Starts(NamedTuple):
    """
    Starts of a batch of windows.

    :param steps: (B,), counted from the oldest stored step
    :param envs: (B,)
    """

    steps: np.ndarray
    envs: np.ndarray


class WindowIndex:
    """
    All windows of one length, and those of them that hold a cost event.

    What is newer is drawn more often: the probability of a window falls exponentially with its age.

    The starts whose window reaches the event at ``p`` are p - length + 1 ... p. Cut where the previous event of the same
    environment reaches them too, these ranges are disjoint, so a draw needs the events only, not all steps.

    :param events: (size, n_envs) bool, oldest step first
    :param length: steps in a window, at most ``size``
    :param recency: >= 0; probabilities grow by e to this power from the oldest step to the newest, 0 if all are equal
    """

    def __init__(self, events: np.ndarray, length: int, recency: float = 0.0) -> None:
        size, self.n_envs = events.shape
        self.n_starts = size - length + 1
        self.length, self.recency = length, recency
        envs, steps = np.nonzero(events.T)
        previous = np.where(np.diff(envs, prepend=-1) == 0, np.roll(steps, 1), -1)
        first = np.maximum(np.maximum(steps - length, previous) + 1, 0)
        end = np.minimum(steps + 1, self.n_starts)
        some = first < end
        self._envs, self._first, self._end = envs[some], first[some], end[some]
        self._before = self._share_older(self._first)
        self._cumulated = np.append(0.0, np.cumsum(self._share_older(self._end) - self._before))

    @property
    def event_share(self) -> float:
        """Probability that a window drawn among all holds an event."""
        return float(self._cumulated[-1]) / self.n_envs

    def draw(self, n: int) -> Starts:
        """
        Draw among all windows.

        :param n: number of windows
        :return: their starts
        """
        steps = np.minimum(self._start_at(np.random.rand(n)), self.n_starts - 1)
        return Starts(steps, np.random.randint(self.n_envs, size=n))

    def draw_events(self, n: int) -> Starts:
        """
        Draw among those with an event, as likely relative to each other as in :meth:`draw`.

        :param n: number of windows; 0 if there are none
        :return: their starts
        """
        shares = np.random.rand(n) * self._cumulated[-1]
        ranges = np.searchsorted(self._cumulated, shares, side="right") - 1
        steps = self._start_at(self._before[ranges] + shares - self._cumulated[ranges])
        return Starts(steps.clip(self._first[ranges], self._end[ranges] - 1), self._envs[ranges])

    def _share_older(self, starts: np.ndarray) -> np.ndarray:
        """Probability that a window begins before a start."""
        places = starts / self.n_starts
        return np.expm1(self.recency * places) / np.expm1(self.recency) if self.recency > 0 else places

    def _start_at(self, shares: np.ndarray) -> np.ndarray:
        """The start up to which windows have a share of the probability, the inverse of :meth:`_share_older`."""
        places = np.log1p(shares * np.expm1(self.recency)) / self.recency if self.recency > 0 else shares
        return (places * self.n_starts).astype(np.int64)


def event_weights(has_event: np.ndarray, fraction: float, event_share: float) -> np.ndarray:
    """
    Importance weights that make a batch with too many events unbiased: density of a draw among all over the actual one.

    :param has_event: (B,) bool, the window holds an event
    :param fraction: share of the batch that was drawn among the windows with an event, in [0, 1)
    :param event_share: share of windows with an event in a draw among all
    :return: (B,) float32 weights of expectation 1
    """
    density = np.full(has_event.shape, 1.0 - fraction)
    if event_share > 0:
        density[has_event] += fraction / event_share
    return (1.0 / density).astype(np.float32)


def time_to_event(events: np.ndarray, lasts: np.ndarray) -> np.ndarray:
    """
    Steps until the next event of the same episode.

    :param events: (B, T) bool
    :param lasts: (B, T) bool, the step is the last of its episode
    :return: (B, T) int64, 0 at an event, ``NO_EVENT`` where none follows in the window
    """
    steps = np.arange(events.shape[1])
    event, end = _next_true(events), _next_true(lasts)
    return np.where((event <= end) & (event < NO_EVENT), event - steps, NO_EVENT)


def _next_true(mask: np.ndarray) -> np.ndarray:
    """Index of the first True at or after each step; ``NO_EVENT`` if there is none."""
    indices = np.where(mask, np.arange(mask.shape[1]), NO_EVENT)
    return np.minimum.accumulate(indices[:, ::-1], axis=1)[:, ::-1]
