"""What a model makes of an episode while it drives: what it remembers, what it dreams, and what risk it expects."""

from typing import Any

import numpy as np
import torch as th
from numpy.typing import NDArray

from sb3_esad.common.type_aliases import LatentState
from sb3_esad.esad_lend import ESADLEND


class DreamingDriver:
    """
    Drives one episode; beside the filtered state it keeps a dream, which starts from it and goes on without observations.

    The dream is given the actions that are really executed, so that it can be compared with what really happens.

    :param model: trained model
    :param dream_length: steps after which the dream starts afresh from the filtered state
    :param deterministic: take the best action, not a sampled one
    """

    def __init__(self, model: ESADLEND, dream_length: int = 10, deterministic: bool = True) -> None:
        self.model = model
        self.dream_length = dream_length
        self.deterministic = deterministic
        self.blind_steps = -1
        self._memory: Any = None
        self._state = self._dream = model.policy.initial_state(1)

    @th.no_grad()
    def __call__(self, observation: Any) -> NDArray[np.float32]:
        """
        Take in an observation and choose an action.

        :param observation: of the environment, the first one of an episode at first
        :return: the action
        """
        action, self._memory = self.model.predict(observation, state=self._memory, deterministic=self.deterministic)
        policy = self.model.policy
        arrays = zip(self._memory, policy.initial_state(1), strict=True)
        self._state = LatentState(*(th.as_tensor(array[0], device=policy.device).view_as(zeros) for array, zeros in arrays))
        self.blind_steps = (self.blind_steps + 1) % self.dream_length
        dream = policy.world_model_target.rssm.imagine(self._dream) if self.blind_steps else self._state
        self._dream = dream._replace(action=self._state.action)
        return action

    @th.no_grad()
    def reconstruction(self) -> dict[str, th.Tensor]:
        """
        Show the filtered state.

        :return: preprocessed observations by key, of shape (1, ...)
        """
        return self.model.policy.world_model_target.reconstruct(self._state)

    @th.no_grad()
    def dream(self) -> dict[str, th.Tensor]:
        """
        Show the dreamed state; ``blind_steps`` tells how many observations it has done without.

        :return: preprocessed observations by key, of shape (1, ...)
        """
        return self.model.policy.world_model_target.reconstruct(self._dream)

    @th.no_grad()
    def risk(self) -> float:
        """
        Give the risk that the model expects of the action it chose.

        :return: Gamma, to be compared with ``model.penalty.budget``
        """
        return self.model.risk(self.model.policy.world_model_target.features(self._state), self._state.action).item()
