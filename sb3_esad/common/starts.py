"""Where imagination starts: from states that are known well, and often from those in which it matters."""

import torch as th

from sb3_esad.common.rssm import Filtered
from sb3_esad.common.type_aliases import LatentState, SequenceSamples

SETTLING_STEPS = 3
"""Steps after the start of a window before its states are trusted: speeds are not visible in a single frame."""
EVENT_HORIZON = 8
"""Imagination also starts from states at most this many steps before a recorded cost."""


def choose_starts(samples: SequenceSamples, filtered: Filtered, n: int) -> LatentState:
    """
    Draw half of the starts from windows that were drawn among all, half from shortly before a cost.

    :param samples: recorded windows
    :param filtered: their states
    :param n: number of starts
    :return: n states, those from the former first
    """
    eligible = filtered.settled(SETTLING_STEPS, samples.is_first.T)
    usual = (eligible & samples.among_all).float().flatten()
    dangerous = (eligible & (samples.time_to_event.T < EVENT_HORIZON)).float().flatten()
    chosen = th.cat([_draw(usual, n // 2), _draw(th.where(dangerous.any(), dangerous, usual), n - n // 2)])
    return filtered.before.map(lambda field: field.flatten(0, 1)[chosen])


def _draw(weights: th.Tensor, n: int) -> th.Tensor:
    # A batch of very short windows may hold no eligible state at all; any is then better than none
    return th.multinomial(th.where(weights.any(), weights, 1.0), n, replacement=True)
