"""The records that travel between the stages of training."""

from collections.abc import Callable
from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import TensorDict

Logs = dict[str, float]
TensorLogs = dict[str, th.Tensor]
"""Scalars without gradient on the device of the networks: to read one in the midst of an update is to wait for a GPU."""

NO_EVENT = 2**31 - 1
"""In ``SequenceSamples.time_to_event``: no cost follows."""


class CostReplaySamples(NamedTuple):
    """
    A batch of single steps, as SB3's ``ReplayBufferSamples`` holds them, with their costs; B steps, A action dimensions.

    :param observations: (B, ...), one tensor or one for each key of a Dict space
    :param actions: (B, A), as executed, in [-1, 1]
    :param next_observations: (B, ...), the last frame of an episode included
    :param dones: (B, 1), 1 where the step ended in a terminal state (a time limit is not terminal)
    :param rewards: (B, 1)
    :param costs: (B, 1), never normalised
    """

    observations: th.Tensor | TensorDict
    actions: th.Tensor
    next_observations: th.Tensor | TensorDict
    dones: th.Tensor
    rewards: th.Tensor
    costs: th.Tensor


class SequenceSamples(NamedTuple):
    """
    A batch of windows of consecutive steps; B windows, T steps, A action dimensions.

    Reward, cost and continuation belong to the observation *arrived at*, see :class:`SequenceReplayBuffer`.

    :param observations: (B, T, ...), one tensor or one for each key of a Dict space
    :param next_observations: (B, T, ...), the last frame of an episode included
    :param actions: (B, T, A), as executed, in [-1, 1]
    :param rewards: (B, T)
    :param costs: (B, T), never normalised
    :param continues: (B, T), 0 where the step ended in a terminal state, 1 elsewhere (a time limit is not terminal)
    :param is_first: (B, T) bool, the observation opens an episode; False at a window start inside an episode
    :param event_weights: (B,), corrects the over-representation of windows with a cost, and not that of what is new; its
        expectation is 1
    :param among_all: (B,) bool, the window was drawn among all and not for its cost
    :param time_to_event: (B, T) int, steps until the next cost of the same episode and window; 0 if the step itself
        costs, ``NO_EVENT`` if there is none
    """

    observations: th.Tensor | TensorDict
    next_observations: th.Tensor | TensorDict
    actions: th.Tensor
    rewards: th.Tensor
    costs: th.Tensor
    continues: th.Tensor
    is_first: th.Tensor
    event_weights: th.Tensor
    among_all: th.Tensor
    time_to_event: th.Tensor


class LatentState(NamedTuple):
    """
    What the agent knows: N states, each a grid of H x W cells (one cell for vectors).

    :param memory: h, deterministic, of shape (N, C, H, W)
    :param latent: z, stochastic, of shape (N, C', H, W)
    :param action: the action executed in this state, scaled to [-1, 1], of shape (N, A); zeros as long as there is none
    """

    memory: th.Tensor
    latent: th.Tensor
    action: th.Tensor

    @property
    def grid(self) -> th.Tensor:
        """Memory and latent side by side, of shape (N, C + C', H, W)."""
        return th.cat([self.memory, self.latent], dim=-3)

    def map(self, function: Callable[[th.Tensor], th.Tensor]) -> "LatentState":
        """
        Apply a function to every field.

        :param function: from tensor to tensor
        :return: the state of the results
        """
        return LatentState(*map(function, self))


class Belief(NamedTuple):
    """
    What is known once an observation has been taken in.

    :param state: N states, the latent drawn from the posterior or its mean
    :param embedding: what the latent head made of the observation, of shape (N, C, H, W)
    """

    state: LatentState
    embedding: th.Tensor


class Predictions(NamedTuple):
    """
    What a state is expected to have brought when it was reached.

    :param rewards: expected reward, of shape (...)
    :param costs: expected cost in [0, 1], of shape (...)
    :param continues: probability that the episode goes on, of shape (...)
    """

    rewards: th.Tensor
    costs: th.Tensor
    continues: th.Tensor


class Imagination(NamedTuple):
    """
    Trajectories in the latent space under the policy; N starts, H steps.

    :param grids: features of the starts and of the states reached, of shape (H + 1, N, C, height, width)
    :param actions: chosen in these states, the last of them not executed, of shape (H + 1, N, A)
    :param predictions: of the states reached, fields of shape (H, N)
    :param weights: discounted probability that the state is reached at all, of shape (H, N)
    """

    grids: th.Tensor
    actions: th.Tensor
    predictions: Predictions
    weights: th.Tensor

    def detach(self) -> "Imagination":
        """
        Cut the gradient.

        :return: the same trajectories as constants
        """
        predictions = Predictions(*(field.detach() for field in self.predictions))
        return Imagination(self.grids.detach(), self.actions.detach(), predictions, self.weights.detach())
