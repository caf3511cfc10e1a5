"""95 % intervals of means, shares, rates and tails."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Z_95 = 1.959964
WORST_SHARE = 0.1
RESAMPLES = 1000


def wilson_interval(successes: float, count: int) -> tuple[float, float]:
    """
    95 % interval of a share (Wilson, 1927); sensible also at 0 and 1.

    :param successes: how often it happened
    :param count: of how many
    :return: lower and upper bound within [0, 1]
    """
    share, square = successes / count, Z_95**2 / count
    centre = (share + square / 2) / (1 + square)
    half = Z_95 * math.sqrt(share * (1 - share) / count + square / (4 * count)) / (1 + square)
    return max(centre - half, 0.0), min(centre + half, 1.0)


def mean_interval(values: NDArray[np.floating]) -> tuple[float, float]:
    """
    95 % interval of a mean, by Student's t.

    :param values: independent, shape ``(n,)``
    :return: lower and upper bound; both the mean itself if there is one value only
    """
    from scipy.stats import t

    mean, count = float(np.mean(values)), len(values)
    if count < 2:
        return mean, mean
    half = float(t.ppf(0.975, count - 1)) * float(np.std(values, ddof=1)) / math.sqrt(count)
    return mean - half, mean + half


def poisson_interval(count: float) -> tuple[float, float]:
    """
    95 % interval of the expected number of independent events (Garwood, 1936); sensible also at 0.

    :param count: how many there were
    :return: lower and upper bound
    """
    from scipy.stats import chi2

    low = float(chi2.ppf(0.025, 2 * count)) / 2 if count > 0 else 0.0
    return low, float(chi2.ppf(0.975, 2 * count + 2)) / 2


def worst_mean(values: NDArray[np.floating], share: float = WORST_SHARE) -> float:
    """
    Mean of the highest values: the empirical conditional value at risk.

    :param values: shape ``(n,)``
    :param share: of the values that count as the worst, (0, 1]; at least one value does
    :return: their mean
    """
    count = max(math.ceil(share * len(values) - 1e-9), 1)
    return float(np.sort(values)[-count:].mean())


def bootstrap_interval(
    values: NDArray[np.floating], statistic: Callable[[NDArray[np.floating]], float]
) -> tuple[float, float]:
    """
    95 % interval of any figure (Efron, 1979: percentiles over resamples), for those that have none in closed form.

    :param values: independent, shape ``(n,)`` or, with several values each, ``(n, k)``
    :param statistic: from values to the figure
    :return: lower and upper bound, the same for the same values; both the figure itself if there is one value only
    """
    if len(values) < 2:
        return statistic(values), statistic(values)
    random = np.random.default_rng(0)
    drawn = [statistic(values[random.integers(len(values), size=len(values))]) for _ in range(RESAMPLES)]
    low, high = np.percentile(drawn, [2.5, 97.5])
    return float(low), float(high)
