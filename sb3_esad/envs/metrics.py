"""Driving metrics of the paper (section "Evaluation Metrics"): one record per episode, one row of figures per experiment."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, SupportsFloat

import gymnasium
import numpy as np
from numpy.typing import NDArray

from sb3_esad.envs.episode import Record
from sb3_esad.envs.intervals import bootstrap_interval, mean_interval, poisson_interval, wilson_interval, worst_mean
from sb3_esad.envs.stock_record import StockRecord, is_stock

Columns = Mapping[str, NDArray[np.floating]]
Figure = tuple[str, float, tuple[float, float]]

MEANS = (
    ("DS", 100.0, "driving_score"),
    ("RC", 100.0, "route_completion"),
    ("IS", 100.0, "infraction_score"),
    ("TTC", 1.0, "min_ttc"),
    ("speed", 1.0, "mean_speed"),
    ("duration", 1.0, "duration"),
    ("return", 1.0, "return"),
    ("cost", 1.0, "cost"),
)
"""Figures that are means: name, scale, key of the record."""


class DrivingMetrics(gymnasium.Wrapper[Any, Any, Any, Any]):
    """
    Keeps the records of all finished episodes in ``records``.

    :param env: a driving scenario, or another environment that puts its record into ``info["driving"]`` at an episode's end;
        those of highway-env get a :class:`StockRecord`
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        super().__init__(StockRecord(env) if is_stock(env) else env)
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
                raise KeyError(
                    f"{self.env} ended an episode without info['driving']; wrap a scenario of sb3_esad.envs or of highway-env"
                )
            self.records.append(info["driving"])
        return observation, reward, terminated, truncated, info


def summarise(records: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """
    Turn episode records into the figures of a table.

    ``DS``, ``RC``, ``IS`` (0 to 100), ``success`` and ``collision_free`` (shares), ``CO`` (collisions per 100 m), ``CR``
    (collisions per km), ``IPK`` (infractions per km), ``TTC`` and ``TTC_5`` (mean and 5th percentile of the episodes'
    smallest time to collision, s), ``speed`` (m/s), ``duration`` (s), ``return``, ``cost``, ``cost_cvar`` (mean cost of the
    worst tenth). Of the course also ``path`` (its length, m), ``curvature`` (the largest, 1/m) and ``safety`` (0 to 100: the
    share of episodes without collision times the share of the path with more than 0.5 m to what is nearest).
    ``<name>_low`` and ``<name>_high`` bound 95 % intervals: Wilson's for shares, Poisson's for events per distance,
    Student's t for means, resampling for the rest.

    :param records: of at least one episode
    :return: the figures by name
    :raises ValueError: if there are no records
    """
    if not records:
        raise ValueError("summarise() got no records; run at least one episode to its end")
    columns = {name: np.array([record[name] for record in records], dtype=np.float64) for name in records[0]}
    figures = {"episodes": float(len(records))}
    for name, value, (low, high) in (
        *_means(columns),
        *_shares(columns),
        *_rates(columns),
        *_tails(columns),
        *_of_course(columns),
    ):
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


def _of_course(columns: Columns) -> Iterator[Figure]:
    if "clear_distance" not in columns:
        return
    for name, values in (("path", columns["distance"]), ("curvature", columns["max_curvature"])):
        yield name, float(values.mean()), mean_interval(values)
    rows = np.stack([columns["collisions"] == 0, columns["clear_distance"], columns["distance"]], axis=-1)
    yield "safety", _safety(rows), bootstrap_interval(rows, _safety)


def _safety(rows: NDArray[np.floating]) -> float:
    free, clear, metres = rows.mean(0)
    return float(100 * free * clear / max(metres, 1e-9))
