"""The networks as they drive together: take in an observation, propose an action."""

from typing import NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_esad.common.actor import Actor
from sb3_esad.common.critics import CostCritic, QEnsemble
from sb3_esad.common.type_aliases import Belief, LatentState
from sb3_esad.common.world_model import WorldModel


class LatentAgent(NamedTuple):
    """
    A world model, the actor that acts on its states, and the critics that judge what it does; its memory is the caller's.

    It acts in full precision: to convert the networks to bfloat16 takes longer than that saves on a few states.

    :param world_model: filters observations
    :param actor: proposes actions
    :param critic: expects returns
    :param cost_critic: expects costs
    """

    world_model: WorldModel
    actor: Actor
    critic: QEnsemble
    cost_critic: CostCritic

    @th.no_grad()
    def observe(self, observation: PyTorchObs, state: LatentState, episode_start: th.Tensor, deterministic: bool) -> Belief:
        """
        Take in an observation, forgetting the past where an episode starts.

        :param observation: of shape (N, ...)
        :param state: the previous state and the executed action
        :param episode_start: bool, of shape (N,)
        :param deterministic: take the mean of the latent instead of a sample
        :return: the present state, and the embedding of the observation
        """
        kept = state.map(lambda field: field.masked_fill(episode_start.view(-1, *[1] * (field.dim() - 1)), 0.0))
        embedding = self.world_model.embed(observation)
        return Belief(self.world_model.rssm.filter(kept, embedding, deterministic), embedding)

    @th.no_grad()
    def act(self, state: LatentState, deterministic: bool = False) -> th.Tensor:
        """
        Choose actions.

        :param state: N states
        :param deterministic: take the mode instead of a sample
        :return: actions scaled to [-1, 1], of shape (N, A)
        """
        return self.actor(self.world_model.features(state), deterministic)
