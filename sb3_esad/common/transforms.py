"""Representations of numbers of any size: compressed, and as a distribution over bins."""

import torch as th


def symlog(value: th.Tensor) -> th.Tensor:
    """
    Compress a value of any size, keeping its sign (Hafner et al., DreamerV3, Eq. 9).

    :param value: any real tensor
    :return: sign(x) ln(1 + |x|)
    """
    return value.sign() * value.abs().log1p()


def symexp(value: th.Tensor) -> th.Tensor:
    """
    Inverse of :func:`symlog`.

    :param value: any real tensor
    :return: sign(x) (exp(|x|) - 1)
    """
    return value.sign() * value.abs().expm1()


def twohot_encode(value: th.Tensor, bins: th.Tensor) -> th.Tensor:
    """
    Distribution over bins whose mean is the value (Bellemare et al. 2017; DreamerV3, Eq. 11).

    :param value: (...), clipped to the range of the bins
    :param bins: (N,), ascending, N >= 2
    :return: (..., N), at most two neighbours are non-zero and all sum to 1
    """
    value = value.clamp(bins[0], bins[-1]).unsqueeze(-1)
    gaps = bins.diff()
    rising = th.nn.functional.pad((value - bins[:-1]) / gaps, (1, 0), value=1.0)
    falling = th.nn.functional.pad((bins[1:] - value) / gaps, (0, 1), value=1.0)
    return th.minimum(rising, falling).clamp(min=0.0)


def twohot_decode(probabilities: th.Tensor, bins: th.Tensor) -> th.Tensor:
    """
    Mean of a distribution over bins, the inverse of :func:`twohot_encode`.

    :param probabilities: (..., N)
    :param bins: (N,)
    :return: (...)
    """
    return (probabilities * bins).sum(dim=-1)
