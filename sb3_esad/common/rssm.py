"""Recurrent state-space model: how the latent state moves on with an action, with and without an observation."""

from typing import NamedTuple, TypeVar

import torch as th
from torch import nn

from sb3_esad.common.latents import Gaussian, LatentHead
from sb3_esad.common.torch_layers import ChannelNorm, GridShape, SameConv2d, dense_block, join, kernel_size
from sb3_esad.common.type_aliases import LatentState

Record = TypeVar("Record", LatentState, Gaussian)


class GridGRU(nn.Module):
    """
    Gated recurrent unit on a grid: each cell sees its neighbours, the mean of all cells, and the action.

    The mean carries what has no place, such as the own speed, to every cell within one step. The action has a layer of its
    own: as two numbers beside hundreds it would be learned last.

    :param memory_shape: shape of the memory (C, H, W)
    :param input_channels: channels of the input grid
    :param action_dim: length of the action
    """

    def __init__(self, memory_shape: GridShape, input_channels: int, action_dim: int) -> None:
        super().__init__()
        channels = memory_shape[0]
        hidden = 2 * channels
        self.local = SameConv2d(channels + input_channels, hidden, kernel_size(memory_shape))
        self.embed_action = dense_block(action_dim, hidden)
        self.everywhere = nn.Linear(channels + hidden, hidden)
        self.norm = ChannelNorm(hidden)
        self.gates = nn.Sequential(SameConv2d(hidden, 3 * channels, 1), ChannelNorm(3 * channels))

    def forward(self, memory: th.Tensor, inputs: th.Tensor, action: th.Tensor) -> th.Tensor:
        """
        Move the memory on by one step.

        :param memory: shape (N, C, H, W)
        :param inputs: shape (N, input_channels, H, W)
        :param action: shape (N, action_dim)
        :return: the next memory, of the shape of ``memory``
        """
        common = self.everywhere(th.cat([memory.mean((-2, -1)), self.embed_action(action)], dim=1))
        # A hidden layer, for what moves must be shifted by its speed: a product, which gates alone express badly
        hidden = nn.functional.silu(self.norm(self.local(th.cat([memory, inputs], dim=1)) + common[..., None, None]))
        gates = self.gates(hidden)
        reset, candidate, update = gates.float().chunk(3, dim=1)
        # The bias of -1 makes the memory keep what it holds until it learns what to replace (DreamerV2)
        update = th.sigmoid(update - 1)
        return update * th.tanh(th.sigmoid(reset) * candidate) + (1 - update) * memory


class Filtered(NamedTuple):
    """
    States along windows, time-major.

    :param states: state after each step, fields of shape (T, B, ...)
    :param before: state before each step's action, where an episode or a window starts it is the filtered first observation
    :param posterior: q(z | h, o) of each step
    :param prior: p(z | h) of each step
    :param embeddings: what the head made of each step's observation, withheld ones included, of shape (T, B, C, H, W)
    :param is_first: whether the model started afresh at the step, of shape (T, B)
    :param hidden: whether the step's observation was withheld, of shape (T, B)
    """

    states: LatentState
    before: LatentState
    posterior: Gaussian
    prior: Gaussian
    embeddings: th.Tensor
    is_first: th.Tensor
    hidden: th.Tensor

    def detach(self) -> "Filtered":
        """
        Cut the gradient.

        :return: the same states as constants
        """
        states, before = (state.map(th.Tensor.detach) for state in (self.states, self.before))
        posterior, prior = self.posterior.detach(), self.prior.detach()
        return Filtered(states, before, posterior, prior, self.embeddings.detach(), self.is_first, self.hidden)

    def settled(self, steps: int, episode_starts: th.Tensor) -> th.Tensor:
        """
        Tell the states before actions that know as much as they would when acting.

        Where an episode starts all of them do, within an episode only those some steps after the start of the window. A
        state whose own observation was withheld does not.

        :param steps: steps since the window started
        :param episode_starts: whether the step really opens an episode, of shape (T, B)
        :return: bool, of shape (T, B)
        """
        index = th.arange(len(self.is_first), device=self.is_first.device)[:, None]
        fresh = th.where(self.is_first, index, 0).cummax(0).values
        blind = self.hidden.roll(1, 0) & ~self.is_first
        return ((index - fresh >= steps) | episode_starts.gather(0, fresh)) & ~blind


class RSSM(nn.Module):
    """
    Recurrent state-space model (PlaNet, arXiv 1811.04551) on a grid of cells, or on a single one for vectors.

    :param memory_shape: shape of the memory (C, H, W)
    :param latent_channels: channels of the stochastic latent in each cell
    :param action_dim: length of the action
    :param head: distribution of the latent given the memory
    """

    def __init__(self, memory_shape: GridShape, latent_channels: int, action_dim: int, head: LatentHead) -> None:
        super().__init__()
        self.memory_shape = memory_shape
        self.latent_shape: GridShape = (latent_channels, *memory_shape[1:])
        self.action_dim = action_dim
        self.cell = GridGRU(memory_shape, latent_channels, action_dim)
        self.head = head

    def initial(self, n: int) -> LatentState:
        """
        Give the state before anything was seen.

        :param n: number of states
        :return: zeros
        """
        reference = self.cell.everywhere.weight
        return LatentState(
            reference.new_zeros(n, *self.memory_shape),
            reference.new_zeros(n, *self.latent_shape),
            reference.new_zeros(n, self.action_dim),
        )

    def advance(self, state: LatentState) -> th.Tensor:
        """
        Remember the state and the action taken in it.

        :param state: the state and the executed action
        :return: the next memory h, of shape (N, C, H, W)
        """
        return self.cell(state.memory, state.latent, state.action)

    def imagine(self, state: LatentState) -> LatentState:
        """
        Move on by one step without an observation.

        :param state: the state and the action taken in it
        :return: the next state, its action still zero
        """
        memory = self.advance(state)
        return LatentState(memory, self.head.sample(memory), th.zeros_like(state.action))

    def filter(
        self,
        state: LatentState,
        embedding: th.Tensor,
        deterministic: bool = False,
        generator: th.Generator | None = None,
    ) -> LatentState:
        """
        Move on by one step with an observation.

        :param state: the previous state and the executed action
        :param embedding: features prepared by the head, of shape (N, C', H, W)
        :param deterministic: take the mean of the latent instead of a sample
        :param generator: of the sample; torch's global one if there is none
        :return: the next state, its action still zero
        """
        memory = self.advance(state)
        posterior = self.head.posterior(memory, embedding)
        latent = posterior.mean if deterministic else posterior.sample(generator)
        return LatentState(memory, latent, th.zeros_like(state.action))

    def scan(
        self,
        first: LatentState,
        is_first: th.Tensor,
        actions: th.Tensor,
        embeddings: th.Tensor,
        hidden: th.Tensor,
        generator: th.Generator | None = None,
    ) -> Filtered:
        """
        Filter whole windows.

        :param first: reset states in the order of ``is_first``'s true entries, time-major
        :param is_first: whether the step starts from a reset state, of shape (T, B); all of its first row is true
        :param actions: executed actions, of shape (T, B, A)
        :param embeddings: of the observation after each action, of shape (T, B, C', H, W)
        :param hidden: steps whose observation is withheld, so that the prior learns to go on alone, of shape (T, B)
        :param generator: of the samples; torch's global one if there is none
        :return: all states and distributions
        """
        resets = is_first.sum(1).tolist()
        firsts = [LatentState(*fields) for fields in zip(*(field.split(resets) for field in first), strict=True)]
        places = is_first.nonzero()[:, 1].split(resets)  # not masks, for each makes the host wait for a GPU
        befores, states, posteriors, priors = [], [], [], []
        state = firsts[0]
        for t, (action, embedding) in enumerate(zip(actions.unbind(), embeddings.unbind(), strict=True)):
            if t > 0 and resets[t] > 0:
                state = _replace(state, places[t], firsts[t])
            state = state._replace(action=action)
            befores.append(state)
            memory = self.advance(state)
            prior, posterior = self.head.prior(memory), self.head.posterior(memory, embedding)
            blind = hidden[t, :, None, None, None]
            latent = Gaussian(*(th.where(blind, p, q) for p, q in zip(prior, posterior, strict=True))).sample(generator)
            state = LatentState(memory, latent, th.zeros_like(action))
            states.append(state)
            posteriors.append(posterior)
            priors.append(prior)
        steps = (_stack(states), _stack(befores), _stack(posteriors), _stack(priors))
        return Filtered(*steps, embeddings, is_first, hidden)


def _stack(items: list[Record]) -> Record:
    return type(items[0])(*(join(fields) for fields in zip(*items, strict=True)))


def _replace(state: LatentState, places: th.Tensor, values: LatentState) -> LatentState:
    return LatentState(*(field.index_put((places,), value) for field, value in zip(state, values, strict=True)))
