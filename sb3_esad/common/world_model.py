"""The world model: a recurrent state-space model with heads for observation, reward, cost and continuation."""

from collections.abc import Callable, ItemsView
from typing import cast

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_esad.common.checks import require
from sb3_esad.common.decoders import ImageHead, ObservationHead, VectorHead
from sb3_esad.common.extractors import grid_shape
from sb3_esad.common.heads import PredictionHeads
from sb3_esad.common.precision import working_dtype
from sb3_esad.common.preprocessing import Observations, Preprocessing, by_key, map_observations
from sb3_esad.common.rssm import RSSM, Filtered
from sb3_esad.common.torch_layers import LearningModule, join
from sb3_esad.common.type_aliases import Imagination, LatentState, Predictions, SequenceSamples, TensorLogs


class WorldModel(LearningModule):
    """
    Latent world model.

    :param observation_space: space of the observations, images channel-first
    :param features_extractor: encodes preprocessed observations
    :param rssm: dynamics of the latent state
    :param normalize_images: whether images are bytes to be divided by 255
    :param units: units of the heads' hidden layers
    :param cost_weight: weight of a cost event in the loss of the cost head
    :param sparsity_weight: price of each cell of a grid that the heads of cost and end look at
    :param foreground_weight: additional weight of the pixels that differ from the background
    :param vector_weight: weight of what is no image in the reconstruction; more where much of it must be remembered
    :param open_loop_length: longest stretch without observation that the model is trained to bridge, in steps
    :raises ValueError: if a weight or the length is out of its range
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        features_extractor: BaseFeaturesExtractor,
        rssm: RSSM,
        normalize_images: bool = True,
        units: int = 256,
        cost_weight: float = 10.0,
        sparsity_weight: float = 0.03,
        foreground_weight: float = 10.0,
        vector_weight: float = 1.0,
        open_loop_length: int = 8,
    ) -> None:
        super().__init__()
        require(cost_weight > 0, "cost_weight", cost_weight, "a weight > 0")
        require(sparsity_weight >= 0, "sparsity_weight", sparsity_weight, "a weight >= 0")
        require(foreground_weight >= 0, "foreground_weight", foreground_weight, "a weight >= 0")
        require(vector_weight >= 0, "vector_weight", vector_weight, "a weight >= 0")
        require(open_loop_length >= 1, "open_loop_length", open_loop_length, "a number of steps >= 1")
        self.preprocessing = Preprocessing(observation_space, normalize_images)
        self.open_loop_length = open_loop_length
        self.features_extractor = features_extractor
        self.embedding_shape = grid_shape(features_extractor)
        self.rssm = rssm
        channels = rssm.memory_shape[0] + rssm.latent_shape[0]
        grid = (channels, *rssm.memory_shape[1:])
        self.predictions = PredictionHeads(grid, units, cost_weight, sparsity_weight)
        self.observations = nn.ModuleDict(
            {
                key: ImageHead(grid, cast(tuple[int, ...], space.shape), foreground_weight)
                if key in self.preprocessing.image_keys
                else VectorHead(grid, get_flattened_obs_dim(space), vector_weight)
                for key, space in self.preprocessing.spaces.items()
            }
        )

    def initial(self, n: int) -> LatentState:
        """
        Give the state before anything was seen.

        :param n: number of states
        :return: zeros
        """
        return self.rssm.initial(n)

    def embed(self, observations: Observations) -> th.Tensor:
        """
        Encode observations.

        :param observations: as stored, of shape (N, ...)
        :return: embeddings for the posterior, of shape (N, C, H, W)
        """
        features = self.features_extractor(self.preprocessing(observations))
        return self.rssm.head.embed(features.unflatten(1, self.embedding_shape))

    def filter(
        self,
        state: LatentState,
        observations: Observations,
        deterministic: bool = False,
        generator: th.Generator | None = None,
    ) -> LatentState:
        """
        Take in one observation.

        :param state: the previous state and the executed action, or :meth:`initial`
        :param observations: as stored, of shape (N, ...)
        :param deterministic: take the mean of the latent instead of a sample
        :param generator: of the sample; torch's global one if there is none
        :return: the next state
        """
        return self.rssm.filter(state, self.embed(observations), deterministic, generator)

    def observe(self, samples: SequenceSamples, hidden: th.Tensor, generator: th.Generator | None = None) -> Filtered:
        """
        Filter windows of recorded steps.

        :param samples: windows, batch-major
        :param hidden: steps whose observation is withheld, of shape (T, B)
        :param generator: of the samples; torch's global one if there is none
        :return: states and distributions, time-major
        """
        actions = samples.actions.transpose(0, 1)
        is_first = samples.is_first.transpose(0, 1).clone()
        is_first[0] = True  # the model starts afresh at the start of a window too
        opening = map_observations(samples.observations, lambda x: x.transpose(0, 1)[is_first])
        embeddings = self.embed(map_observations(samples.next_observations, lambda x: x.transpose(0, 1).flatten(0, 1)))
        first = self.filter(self.initial(int(is_first.sum())), opening, generator=generator)
        return self.rssm.scan(first, is_first, actions, embeddings.unflatten(0, actions.shape[:2]), hidden, generator)

    def imagine(self, start: LatentState, policy: Callable[[th.Tensor], th.Tensor], horizon: int, gamma: float) -> Imagination:
        """
        Roll the policy out in the latent space, differentiably: later states depend on earlier actions.

        :param start: N states and the first actions to take
        :param policy: draws the actions that follow, of shape (N, A), for features of states
        :param horizon: number of steps
        :param gamma: discount in the weights
        :return: the trajectories
        """
        grids, actions, state = [self.features(start)], [start.action], start
        for _ in range(horizon):
            state = self.rssm.imagine(state)
            grids.append(self.features(state))
            state = state._replace(action=policy(grids[-1]))
            actions.append(state.action)
        trajectory = join(grids)
        predictions = self.predict(trajectory[1:])
        alive = th.cat([th.ones_like(predictions.continues[:1]), gamma * predictions.continues[:-1]])
        return Imagination(trajectory, join(actions), predictions, alive.cumprod(0))

    def features(self, state: LatentState) -> th.Tensor:
        """
        Give what actor and critics see of a state.

        :param state: N states
        :return: memory and latent side by side, of shape (N, C, H, W)
        """
        return state.grid.to(working_dtype(state.memory.device)).contiguous(memory_format=th.channels_last)

    def predict(self, grids: th.Tensor) -> Predictions:
        """
        Predict reward, cost and continuation.

        :param grids: features of the states reached, of shape (T, N, C, H, W)
        :return: fields of shape (T, N)
        """
        return Predictions(*(field.unflatten(0, grids.shape[:2]) for field in self.predictions(grids.flatten(0, 1))))

    def reconstruct(self, states: LatentState) -> dict[str, th.Tensor]:
        """
        Show what the states look like.

        :param states: N states
        :return: observations by key as SB3 preprocesses them, vectors flat; the key of a single observation is "observation"
        """
        return self.decode(self.features(states))

    def decode(self, grids: th.Tensor) -> dict[str, th.Tensor]:
        """
        Show what features of states look like.

        :param grids: features, of shape (N, C, H, W)
        :return: see :meth:`reconstruct`
        """
        return self.preprocessing.invert({key: head(grids) for key, head in self._observation_heads()})

    def loss(self, samples: SequenceSamples, generator: th.Generator | None = None) -> tuple[th.Tensor, Filtered, TensorLogs]:
        """
        Fit the model to windows of recorded steps, and take note of the scale of vectors.

        :param samples: windows, batch-major
        :param generator: of all that is drawn; torch's global one if there is none
        :return: scalar loss, the filtered states, and what to log
        """
        steps = samples.rewards.T
        self.preprocessing.follow(map_observations(samples.next_observations, lambda x: x.flatten(0, 1)))
        filtered = self.observe(samples, self._withhold(steps, generator), generator)
        grid = self.features(filtered.states.map(lambda field: field.flatten(0, 1)))
        targets = Predictions(*(field.T.flatten() for field in (samples.rewards, samples.costs, samples.continues)))
        weights = samples.event_weights.expand_as(steps).flatten()
        prediction_loss, logs = self.predictions.loss(grid, targets, weights)
        # Decoding is the dearest part, and half of the frames say as much about the other half
        some = th.randperm(len(grid), device=grid.device, generator=generator)[: (len(grid) + 1) // 2]
        distributions = (filtered.posterior, filtered.prior)
        head_loss, head_logs = self.rssm.head.loss(*distributions, filtered.states.memory, filtered.embeddings, generator)
        shown = map_observations(samples.next_observations, lambda x: x.transpose(0, 1).flatten(0, 1)[some])
        seen = by_key(self.preprocessing(shown))
        observation_losses = [head.loss(grid[some], seen[key]) for key, head in self._observation_heads()]
        observation_loss = th.stack(observation_losses).sum()
        loss = observation_loss + prediction_loss + head_loss
        return loss, filtered, {**logs, **head_logs, "observation_loss": observation_loss.detach()}

    def _withhold(self, steps: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        # Every window hides one stretch, so that the prior is trained on what it will be used for: going on alone
        length, n = steps.shape
        index = th.arange(length, device=steps.device)[:, None]
        start = th.randint(1, max(2, length), (n,), device=steps.device, generator=generator)
        stretch = th.randint(1, self.open_loop_length + 1, (n,), device=steps.device, generator=generator)
        return (index >= start) & (index < start + stretch)

    def _observation_heads(self) -> ItemsView[str, ObservationHead]:
        return cast(ItemsView[str, ObservationHead], self.observations.items())
