"""How a world model and an actor drive: take in an observation, choose an action."""

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_esad.common.actor import Actor
from sb3_esad.common.precision import autocast
from sb3_esad.common.type_aliases import LatentState
from sb3_esad.common.world_model import WorldModel


class LatentAgent(NamedTuple):
    """
    A world model, and the actor that acts on its states; its memory is the caller's.

    :param world_model: filters observations
    :param actor: chooses actions
    """

    world_model: WorldModel
    actor: Actor

    @th.no_grad()
    def filter(
        self, observation: PyTorchObs, state: LatentState, episode_start: th.Tensor, deterministic: bool
    ) -> LatentState:
        """
        Take in an observation, forgetting the past where an episode starts.

        :param observation: of shape (N, ...)
        :param state: the previous state and the executed action
        :param episode_start: bool, of shape (N,)
        :param deterministic: take the mean of the latent instead of a sample
        :return: the present state
        """
        kept = state.map(lambda field: field.masked_fill(episode_start.view(-1, *[1] * (field.dim() - 1)), 0.0))
        with autocast(episode_start.device):
            return self.world_model.filter(kept, observation, deterministic)

    @th.no_grad()
    def act(self, state: LatentState, deterministic: bool = False) -> th.Tensor:
        """
        Choose actions.

        :param state: N states
        :param deterministic: take the mode instead of a sample
        :return: actions scaled to [-1, 1], of shape (N, A)
        """
        with autocast(state.action.device):
            return self.actor(self.world_model.features(state), deterministic)
