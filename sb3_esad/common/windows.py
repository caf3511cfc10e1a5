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

    The starts whose window reaches the event at ``p`` are p - length + 1 ... p. Cut where the previous event of the same
    environment reaches them too, these ranges are disjoint, so a uniform draw needs the events only, not all steps.

    :param events: (size, n_envs) bool, oldest step first
    :param length: steps in a window, at most ``size``
    """

    def __init__(self, events: np.ndarray, length: int) -> None:
        size, self.n_envs = events.shape
        self.n_starts = size - length + 1
        self._envs, steps = np.nonzero(events.T)
        previous = np.where(np.diff(self._envs, prepend=-1) == 0, np.roll(steps, 1), -1)
        self._first = np.maximum(steps - length, previous) + 1
        self._first = np.maximum(self._first, 0)
        counts = np.minimum(steps, self.n_starts - 1) - self._first + 1
        self._ends = np.cumsum(np.maximum(counts, 0))

    @property
    def n_windows(self) -> int:
        """Number of windows, all environments together."""
        return self.n_starts * self.n_envs

    @property
    def n_event_windows(self) -> int:
        """Number of windows with at least one event."""
        return int(self._ends[-1]) if len(self._ends) else 0

    def draw(self, n: int) -> Starts:
        """
        :param n: number of windows, all equally likely
        :return: their starts
        """
        return Starts(np.random.randint(self.n_starts, size=n), np.random.randint(self.n_envs, size=n))

    def draw_events(self, n: int) -> Starts:
        """
        :param n: number of windows with an event, all of these equally likely; there must be one unless ``n`` is 0
        :return: their starts
        """
        ranks = np.random.randint(max(self.n_event_windows, 1), size=n)
        ranges = np.searchsorted(self._ends, ranks, side="right")
        offsets = ranks - np.concatenate([[0], self._ends])[ranges]
        return Starts(self._first[ranges] + offsets, self._envs[ranges])


def event_weights(has_event: np.ndarray, fraction: float, n_windows: int, n_event_windows: int) -> np.ndarray:
    """
    Importance weights that make a batch with too many events unbiased: density of a uniform draw over the actual one.

    :param has_event: (B,) bool, the window holds an event
    :param fraction: share of the batch that was drawn among the windows with an event, in [0, 1)
    :param n_windows: number of all windows
    :param n_event_windows: number of windows with an event
    :return: (B,) float32 weights of expectation 1
    """
    density = np.full(has_event.shape, 1.0 - fraction)
    if n_event_windows > 0:
        density[has_event] += fraction * n_windows / n_event_windows
    return (1.0 / density).astype(np.float32)


def recency_weights(places: np.ndarray, recency: float) -> np.ndarray:
    """
    Importance weights by which what is newer counts for more: exponential in the age, of expectation 1 over all ages.

    :param places: from 0 for the oldest to 1 for the newest, any shape
    :param recency: >= 0, logarithm of the newest's weight over that of the oldest; 0 for equal weights
    :return: float32, of the shape of ``places``
    """
    scale = recency / -np.expm1(-recency) if recency > 0 else 1.0
    return (scale * np.exp(recency * (places - 1.0))).astype(np.float32)


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
