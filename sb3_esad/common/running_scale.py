"""Numbers at a common scale, however they are measured."""

import torch as th
from torch import nn

MIN_STD = 1e-4
MIN_RATE = 1e-3
CLIP = 10.0
GROWTH, SHRINKAGE = 2.0, 0.9


class RunningScale(nn.Module):
    """
    Standardise each entry of a vector by its running mean and deviation, as SB3's ``VecNormalize`` does outside of a model.

    By squared errors, what varies little is hardly learned: of a car's distance, which is below .1 where 100 m are 1, next to
    nothing (docs/experiments.md, section 22). What is ten deviations off is cut. In mean and deviation it counts no more than
    that, but twice as much with each batch in which it comes again: an entry may vary seldom, and far.

    :param size: length of the vectors
    """

    mean: th.Tensor
    variance: th.Tensor
    n_batches: th.Tensor
    bound: th.Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", th.zeros(size))
        self.register_buffer("variance", th.ones(size))
        self.register_buffer("n_batches", th.tensor(0.0))
        self.register_buffer("bound", th.full((size,), CLIP))

    @th.no_grad()
    def follow(self, vectors: th.Tensor) -> None:
        """
        Take note of a batch: the first thousand count alike, then the latest ones a little more.

        :param vectors: shape (N, size)
        """
        vectors = th.where(self.n_batches > 0, self._bounded(vectors), vectors)
        self.n_batches += 1
        rate = (1 / self.n_batches).clamp(min=MIN_RATE)
        variance, mean = th.var_mean(vectors, dim=0, correction=0)
        change = mean - self.mean
        self.mean += rate * change
        self.variance += rate * (variance + (1 - rate) * change.square() - self.variance)

    def _bounded(self, vectors: th.Tensor) -> th.Tensor:
        deviations, bound = (vectors - self.mean) / self._std, self.bound.clone()
        self.bound.copy_(th.where(deviations.abs().amax(0) > bound, GROWTH * bound, (SHRINKAGE * bound).clamp(min=CLIP)))
        return self.invert(deviations.clamp(-bound, bound))

    def forward(self, vectors: th.Tensor) -> th.Tensor:
        """
        Standardise.

        :param vectors: shape (N, size)
        :return: shape (N, size)
        """
        return ((vectors - self.mean) / self._std).clamp(-CLIP, CLIP)

    def invert(self, scaled: th.Tensor) -> th.Tensor:
        """
        Inverse of :meth:`forward`, but for what it cut.

        :param scaled: shape (N, size)
        :return: shape (N, size)
        """
        return scaled * self._std + self.mean

    @property
    def _std(self) -> th.Tensor:
        return self.variance.sqrt().clamp(min=MIN_STD)
