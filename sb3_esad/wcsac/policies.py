"""Policies of WCSAC: those of SB3's SAC, with a critic of the cost."""

from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_action_dim, preprocess_obs
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.sac import policies as sac_policies

from sb3_esad.common.checks import require
from sb3_esad.common.critics import CostCritic
from sb3_esad.common.target_networks import make_target
from sb3_esad.common.torch_layers import Readout, dense_block


class ObservationReadout(Readout):
    """
    Summary of an observation.

    :param observation_space: space of the observations
    :param features_extractor: extracts features from preprocessed observations
    :param features_dim: length of the summary
    :param normalize_images: whether images are bytes to be divided by 255
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        normalize_images: bool,
    ) -> None:
        super().__init__()
        self.observation_space = observation_space
        self.features_extractor = features_extractor
        self.features_dim = features_dim
        self.normalize_images = normalize_images
        self.mix = dense_block(features_extractor.features_dim, features_dim)

    def forward(self, observation: PyTorchObs) -> th.Tensor:
        """
        Summarise observations.

        :param observation: of shape (N, ...), one tensor or one for each key of a Dict space
        :return: summaries, of shape (N, features_dim)
        """
        preprocessed = preprocess_obs(observation, self.observation_space, normalize_images=self.normalize_images)
        return self.mix(self.features_extractor(preprocessed))


class WCSACPolicy(sac_policies.SACPolicy):
    """
    SB3's policy of SAC with a critic of the cost, whose features extractor is never shared.

    The cost critic has the hidden layers of the reward critics, but its own normalisation and activation. See SB3's
    ``SACPolicy`` for the parameters.

    :raises ValueError: if the critics have no hidden layer
    """

    cost_critic: CostCritic
    cost_critic_target: CostCritic

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        # Without a limit the same seed shall give the actions of SAC: the cost critic draws its numbers from a fork
        with th.random.fork_rng(devices=()):
            self.cost_critic = self._make_cost_critic()
        self.cost_critic_target = make_target(self.cost_critic)
        self.cost_critic.optimizer = self.optimizer_class(
            self.cost_critic.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    def _make_cost_critic(self) -> CostCritic:
        settings: dict[str, Any] = self.critic_kwargs
        net_arch: list[int] = settings["net_arch"]
        require(len(net_arch) > 0, "net_arch", self.net_arch, "at least one hidden layer for the critics")
        readout = ObservationReadout(
            self.observation_space, self.make_features_extractor(), net_arch[0], self.normalize_images
        )
        return CostCritic(readout, get_action_dim(self.action_space), net_arch, settings["n_critics"]).to(self.device)

    def set_training_mode(self, mode: bool) -> None:
        """
        Tell layers such as dropout whether the policy learns; the targets never do.

        :param mode: whether it learns
        """
        super().set_training_mode(mode)
        self.cost_critic.train(mode)


class CnnPolicy(WCSACPolicy, sac_policies.CnnPolicy):
    """:class:`WCSACPolicy` for images."""


class MultiInputPolicy(WCSACPolicy, sac_policies.MultiInputPolicy):
    """:class:`WCSACPolicy` for dictionaries of images and vectors."""


MlpPolicy = WCSACPolicy
