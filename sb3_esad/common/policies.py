"""The policy of all latent algorithms: it owns every network, and acts with a memory that the caller carries."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, get_actor_critic_arch
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_esad.common.actor import Actor
from sb3_esad.common.agent import LatentAgent
from sb3_esad.common.checks import require
from sb3_esad.common.critics import CostCritic, QEnsemble
from sb3_esad.common.extractors import CombinedExtractor, SpatialCnn, VectorExtractor, grid_shape
from sb3_esad.common.latents import GaussianHead, LatentHead
from sb3_esad.common.numpy_state import NumpyState, from_numpy, to_numpy
from sb3_esad.common.optimizers import MuonWithAdam
from sb3_esad.common.rssm import RSSM
from sb3_esad.common.selection import ActionFilter, NoFilter, Selection
from sb3_esad.common.target_networks import make_target
from sb3_esad.common.torch_layers import GridReadout
from sb3_esad.common.type_aliases import Belief, LatentState
from sb3_esad.common.world_model import WorldModel


class LatentPolicy(BasePolicy):
    """
    World model, actor and critics, with ``predict`` as SB3's recurrent policies have it.

    Each network has a target, its average over the last updates. ``predict`` uses the targets, for what is learned last swings
    between driving too fast and crawling, and its average does not. Training collects steps by the networks that learn, for
    an average learns too late of its mistakes (docs/experiments.md, section 6).

    :param observation_space: space of the observations
    :param action_space: box of the actions
    :param lr_schedule: learning rate of all networks
    :param net_arch: hidden layers of actor and critics, or of each in a dictionary with ``pi`` and ``qf``; at least one
    :param n_critics: size of the ensembles of critics, for the return and for the mean of the cost
    :param memory_channels: channels of the memory in each cell; None for 32 on a grid and 256 for vectors
    :param latent_channels: channels of the stochastic latent in each cell; None for 8 on a grid and 32 for vectors
    :param world_model_kwargs: further arguments of the world model
    :param head_kwargs: further arguments of the latent head
    :param features_extractor_class: encoder of the observations, whose features become a grid if it has a ``grid_shape``;
        None for the ``extractor_class`` of the policy
    :param features_extractor_kwargs: arguments of the encoder
    :param normalize_images: whether images are bytes to be divided by 255
    :param optimizer_class: optimiser of each network
    :param optimizer_kwargs: arguments of the optimisers
    """

    make_head: ClassVar[Callable[..., LatentHead]] = GaussianHead
    extractor_class: ClassVar[type[BaseFeaturesExtractor]] = VectorExtractor
    cost_critic_class: ClassVar[type[CostCritic]] = CostCritic
    action_space: spaces.Box

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        n_critics: int = 2,
        memory_channels: int | None = None,
        latent_channels: int | None = None,
        world_model_kwargs: dict[str, Any] | None = None,
        head_kwargs: dict[str, Any] | None = None,
        features_extractor_class: type[BaseFeaturesExtractor] | None = None,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = MuonWithAdam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        features_extractor_class = features_extractor_class or self.extractor_class
        if not normalize_images and issubclass(features_extractor_class, SpatialCnn | CombinedExtractor):
            features_extractor_kwargs = {"normalized_image": True, **(features_extractor_kwargs or {})}
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            normalize_images=normalize_images,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
        )
        self.net_arch = [256, 256] if net_arch is None else net_arch
        self.actor_arch, self.critic_arch = get_actor_critic_arch(self.net_arch)
        complete = len(self.actor_arch) > 0 and len(self.critic_arch) > 0
        require(complete, "net_arch", net_arch, "at least one hidden layer for the actor and for the critics")
        require(n_critics >= 1, "n_critics", n_critics, "a number >= 1")
        for name, channels in (("memory_channels", memory_channels), ("latent_channels", latent_channels)):
            require(channels is None or channels >= 1, name, channels, "a number >= 1, or None for the usual one")
        self.n_critics = n_critics
        self.memory_channels = memory_channels
        self.latent_channels = latent_channels
        self.world_model_kwargs = world_model_kwargs or {}
        self.head_kwargs = head_kwargs or {}
        self.action_filter: ActionFilter = NoFilter()
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        self.world_model = self._make_world_model()
        rssm = self.world_model.rssm
        grid = (rssm.memory_shape[0] + rssm.latent_shape[0], *rssm.memory_shape[1:])
        self.actor = Actor(grid, rssm.action_dim, self.actor_arch)
        critics = (rssm.action_dim, self.critic_arch, self.n_critics)
        self.critic = QEnsemble(GridReadout(grid, self.critic_arch[0]), *critics)
        self.cost_critic = self.cost_critic_class(GridReadout(grid, self.critic_arch[0]), *critics)
        self.world_model_target, self.actor_target = make_target(self.world_model), make_target(self.actor)
        self.critic_target, self.cost_critic_target = make_target(self.critic), make_target(self.cost_critic)
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]  # torch's stub does not know the keyword
        for network in (self.world_model, self.actor, self.critic, self.cost_critic):
            network.optimizer = self.optimizer_class(
                network.parameters(),
                lr=lr_schedule(1),  # type: ignore[call-arg]
                **self.optimizer_kwargs,
            )

    def _make_world_model(self) -> WorldModel:
        extractor = self.make_features_extractor()
        embedding_channels, height, width = grid_shape(extractor)
        spatial = height * width > 1
        memory_channels, latent_channels = (32, 8) if spatial else (256, 32)
        memory_channels = memory_channels if self.memory_channels is None else self.memory_channels
        latent_channels = latent_channels if self.latent_channels is None else self.latent_channels
        memory_shape = (memory_channels, height, width)
        head = self.make_head(
            memory_shape, embedding_channels, latent_channels, hidden_channels=memory_shape[0], **self.head_kwargs
        )
        rssm = RSSM(memory_shape, latent_channels, get_action_dim(self.action_space), head)
        return WorldModel(
            self.observation_space,
            extractor,
            rssm,
            normalize_images=self.normalize_images,
            **{"units": self.critic_arch[0], **self.world_model_kwargs},
        )

    def set_training_mode(self, mode: bool) -> None:
        """
        Tell layers such as dropout whether the policy learns; the targets never do.

        :param mode: whether it learns
        """
        for network in (self.world_model, self.actor, self.critic, self.cost_critic):
            if network.training != mode:  # to go through all layers takes as long as all else that is done for a step
                network.train(mode)
        self.training = mode

    @property
    def learner(self) -> LatentAgent:
        """World model and actor that learn, as they act together; they are judged by the averages of the critics."""
        return LatentAgent(self.world_model, self.actor, self.critic_target, self.cost_critic_target)

    @property
    def average(self) -> LatentAgent:
        """The averages of the networks, as they act together."""
        return LatentAgent(self.world_model_target, self.actor_target, self.critic_target, self.cost_critic_target)

    def initial_state(self, n_envs: int) -> LatentState:
        """
        Give the memory that an episode starts with.

        :param n_envs: number of environments
        :return: zeros
        """
        return self.world_model.initial(n_envs)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: NumpyState | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, NumpyState]:
        """
        Get the action for an observation and the memory of the episode so far.

        :param observation: one observation, or one for each of N environments
        :param state: what the last call returned; None where the episodes start
        :param episode_start: which environments were just reset, of shape (N,); None for none
        :param deterministic: take means instead of samples
        :return: the action, and the memory to hand in next time, arrays of shape (1, N, size)
        :raises ValueError: if ``state`` or ``episode_start`` belong to another number of environments
        """
        self.set_training_mode(False)
        self._refuse_gym_reset(observation)
        tensor, vectorized = self.obs_to_tensor(observation)
        n_envs = len(next(iter(tensor.values())) if isinstance(tensor, dict) else tensor)
        start = np.zeros(n_envs, dtype=bool) if episode_start is None else np.asarray(episode_start, dtype=bool).reshape(-1)
        if len(start) != n_envs:
            remedy = "give one for each environment, or None for none"
            raise ValueError(
                f"predict() was given {n_envs} observation(s) with {len(start)} values of episode_start: {remedy}."
            )
        starts = th.as_tensor(start, device=self.device)
        belief, selection = self.decide(tensor, from_numpy(state, self.initial_state(n_envs)), starts, deterministic)
        actions = selection.actions
        new_state = to_numpy(belief.state._replace(action=actions))
        unscaled = self.unscale_action(actions.cpu().numpy().reshape(-1, *self.action_space.shape))
        unscaled = unscaled.astype(self.action_space.dtype, copy=False)
        return (unscaled if vectorized else unscaled[0]), new_state

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        n = len(next(iter(observation.values())) if isinstance(observation, dict) else observation)
        start = th.ones(n, dtype=th.bool, device=self.device)
        return self.decide(observation, self.initial_state(n), start, deterministic)[1].actions

    def decide(
        self, observation: PyTorchObs, state: LatentState, episode_start: th.Tensor, deterministic: bool
    ) -> tuple[Belief, Selection]:
        """
        Take in an observation and choose the action to execute.

        :param observation: of shape (N, ...)
        :param state: the previous state and the executed action
        :param episode_start: bool, of shape (N,)
        :param deterministic: take means instead of samples, and the same noise each time where the filter needs some
        :return: what is known now, and what shall be executed
        """
        belief = self.average.observe(observation, state, episode_start, deterministic)
        select = self.action_filter.select_alone if deterministic else self.action_filter.select
        return belief, select(self.average, belief, self.average.act(belief.state, deterministic))

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """
        Choose the first actions of episodes.

        :param observation: of shape (N, ...)
        :param deterministic: take means instead of samples
        :return: actions scaled to [-1, 1], of shape (N, A)
        """
        return self._predict(observation, deterministic)

    @staticmethod
    def _refuse_gym_reset(observation: Any) -> None:
        if isinstance(observation, tuple):
            hint = "that is what Gym's reset() returns (you are mixing Gym API with SB3 VecEnv API)"
            raise ValueError(f"predict() was given a tuple, {hint}: pass the observation alone.")

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            **super()._get_constructor_parameters(),
            "lr_schedule": self._dummy_schedule,
            "net_arch": self.net_arch,
            "n_critics": self.n_critics,
            "memory_channels": self.memory_channels,
            "latent_channels": self.latent_channels,
            "world_model_kwargs": self.world_model_kwargs,
            "head_kwargs": self.head_kwargs,
            "features_extractor_class": self.features_extractor_class,
            "features_extractor_kwargs": self.features_extractor_kwargs,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
        }


class LatentCnnPolicy(LatentPolicy):
    """:class:`LatentPolicy` for images; the memory keeps the picture's geometry."""

    extractor_class = SpatialCnn


class LatentMultiInputPolicy(LatentPolicy):
    """:class:`LatentPolicy` for dictionaries of images and vectors."""

    extractor_class = CombinedExtractor
