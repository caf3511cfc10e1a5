"""Driving metrics of the paper (section "Evaluation Metrics"): one record per episode, one row of figures per experiment."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

Record = dict[str, float]
Columns = Mapping[str, NDArray[np.floating]]
Figure = tuple[str, float, tuple[float, float]]

PENALTIES = {"person": 0.50, "vehicle": 0.60, "static": 0.65, "red_light": 0.70}
COLLISIONS = ("person", "vehicle", "static")
LONGEST_TTC = 20.0  # a time to collision above this is no risk worth telling apart [s]
Z_95 = 1.959964
WORST_SHARE = 0.1
RESAMPLES = 1000
MEANS = (
    ("DS", 100.0, "driving_score"),
    ("RC", 100.0, "route_completion"),
    ("IS", 100.0, "infraction_score"),
    ("TTC", 1.0, "min_ttc"),
    ("speed", 1.0, "mean_speed"),
    ("return", 1.0, "return"),
    ("cost", 1.0, "cost"),
)
"""Figures that are means: name, scale, key of the record."""


class Episode:
    """
    Adds up what happens in one episode.

    :param route_length: [m]
    """

    def __init__(self, route_length: float) -> None:
        self.route_length = route_length
        self.infractions = dict.fromkeys(PENALTIES, 0)
        self.steps = 0
        self.time = self.distance = self.off_route = self.furthest = 0.0
        self.total_reward = self.total_cost = 0.0
        self.min_ttc = LONGEST_TTC

    def add_motion(self, duration: float, metres: float, progress: float, on_route: bool) -> None:
        """
        Note how far the vehicle came in a step.

        :param duration: of the step [s]
        :param metres: driven [m]
        :param progress: position along the route at the end of the step [m]
        :param on_route: whether the step counts as driven on the route
        """
        self.steps += 1
        self.time += duration
        self.distance += metres
        self.off_route += 0.0 if on_route else metres
        self.furthest = max(self.furthest, progress)

    def add_outcome(self, reward: float, cost: float, ttc: float) -> None:
        """
        Note what a step was worth.

        :param reward: of the step
        :param cost: of the step
        :param ttc: time to collision at its end; infinite if nothing is being approached [s]
        """
        self.total_reward += reward
        self.total_cost += cost
        self.min_ttc = min(self.min_ttc, ttc)

    def add_infraction(self, name: str) -> None:
        """
        Note an infraction.

        :param name: a key of ``PENALTIES``
        """
        self.infractions[name] += 1

    def record(self, success: bool) -> Record:
        """
        The episode as a flat dictionary of plain floats.

        :param success: whether the route's end was reached
        :return: route completion R, infraction score P and driving score R P within [0, 1], counts, metres, seconds
        """
        completion = min(max(self.furthest - self.off_route, 0.0) / self.route_length, 1.0)
        score = math.prod(PENALTIES[name] ** count for name, count in self.infractions.items())
        return {
            "route_completion": completion,
            "infraction_score": score,
            "driving_score": completion * score,
            "success": float(success),
            "collisions": float(sum(self.infractions[name] for name in COLLISIONS)),
            "infractions": float(sum(self.infractions.values())),
            **{f"infractions_{name}": float(count) for name, count in self.infractions.items()},
            "distance": self.distance,
            "off_route": self.off_route,
            "duration": self.time,
            "steps": float(self.steps),
            "mean_speed": self.distance / self.time if self.time > 0 else 0.0,
            "min_ttc": self.min_ttc,
            "return": self.total_reward,
            "cost": self.total_cost,
        }


class DrivingMetrics(gymnasium.Wrapper[Any, Any, Any, Any]):
    """
    Keeps the records of all finished episodes of a driving scenario in ``records``.

    :param env: an environment that puts its record into ``info["driving"]`` when an episode ends
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(env)
        self.records: list[Record] = []

    def step(self, action: Any) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        """
        Step the environment, and file the record of the episode if it is over.

        :param action: passed on
        :return: what the environment returns
        :raises KeyError: if an episode ends without a record
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            if "driving" not in info:
                raise KeyError(f"{self.env} ended an episode without info['driving']; wrap a scenario of sb3_esad.envs")
            self.records.append(info["driving"])
        return observation, reward, terminated, truncated, info


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

    :param values: independent, shape ``(n,)``
    :param statistic: from values to the figure
    :return: lower and upper bound, the same for the same values; both the figure itself if there is one value only
    """
    from scipy.stats import bootstrap

    if len(values) < 2:
        return statistic(values), statistic(values)
    drawn = bootstrap((values,), statistic, n_resamples=RESAMPLES, vectorized=False, method="percentile", rng=0)
    return float(drawn.confidence_interval.low), float(drawn.confidence_interval.high)


def summarise(records: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """
    Turn episode records into the figures of a table.

    ``DS``, ``RC``, ``IS`` (0 to 100), ``success`` and ``collision_free`` (shares), ``CO`` (collisions per 100 m), ``CR``
    (collisions per km), ``IPK`` (infractions per km), ``TTC`` and ``TTC_5`` (mean and 5th percentile of the episodes'
    smallest time to collision, s), ``speed`` (m/s), ``return``, ``cost`` and ``cost_cvar`` (mean cost of the worst tenth).
    ``<name>_low`` and ``<name>_high`` bound 95 % intervals: Wilson's for shares, Poisson's for events per distance,
    Student's t for means, resampling for ``TTC_5`` and ``cost_cvar``.

    :param records: of at least one episode
    :return: the figures by name
    :raises ValueError: if there are no records
    """
    if not records:
        raise ValueError("summarise() got no records; run at least one episode to its end")
    columns = {name: np.array([record[name] for record in records], dtype=np.float64) for name in records[0]}
    figures = {"episodes": float(len(records))}
    for name, value, (low, high) in (*_means(columns), *_shares(columns), *_rates(columns), *_tails(columns)):
        figures |= {name: value, f"{name}_low": low, f"{name}_high": high}
    return figures


def _means(columns: Columns) -> Iterator[Figure]:
    for name, scale, key in MEANS:
        values = scale * columns[key]
        yield name, float(values.mean()), mean_interval(values)


def _shares(columns: Columns) -> Iterator[Figure]:
    for name, values in (("success", columns["success"]), ("collision_free", columns["collisions"] == 0)):
        yield name, float(values.mean()), wilson_interval(float(values.sum()), len(values))


def _rates(columns: Columns) -> Iterator[Figure]:
    kilometres = max(columns["distance"].sum() / 1000, 1e-9)
    for name, key, distance in (
        ("CO", "collisions", 10 * kilometres),
        ("CR", "collisions", kilometres),
        ("IPK", "infractions", kilometres),
    ):
        count = float(columns[key].sum())
        low, high = poisson_interval(count)
        yield name, count / distance, (low / distance, high / distance)


def _tails(columns: Columns) -> Iterator[Figure]:
    for name, values, statistic in (
        ("TTC_5", columns["min_ttc"], lambda values: float(np.percentile(values, 5))),
        ("cost_cvar", columns["cost"], worst_mean),
    ):
        yield name, statistic(values), bootstrap_interval(values, statistic)
