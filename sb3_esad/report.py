"""What an evaluation found: figures from records, as a table that reads well as plain text and as Markdown, and as JSON."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_esad.common.save_util import whole_file
from sb3_esad.envs.episode import Record
from sb3_esad.envs.intervals import mean_interval
from sb3_esad.envs.metrics import summarise

Figures = dict[str, float]


class Row(NamedTuple):
    """
    A row of the table.

    :param name: key of the figure
    :param label: what people read, with the unit
    :param decimals: digits after the point
    :param scale: factor from the figure to the unit
    """

    name: str
    label: str
    decimals: int
    scale: float = 1.0


ROWS = (
    Row("DS", "driving score DS [%] ↑", 1),
    Row("RC", "route completion RC [%] ↑", 1),
    Row("IS", "infraction score IS [%] ↑", 1),
    Row("success", "episodes that reach the end [%] ↑", 1, 100.0),
    Row("collision_free", "episodes without collision [%] ↑", 1, 100.0),
    Row("CO", "collisions per 100 m CO ↓", 3),
    Row("CR", "collisions per km CR ↓", 2),
    Row("IPK", "infractions per km IPK ↓", 2),
    Row("TTC", "smallest time to collision TTC [s] ↑", 2),
    Row("TTC_5", "TTC, 5th percentile [s] ↑", 2),
    Row("speed", "mean speed [m/s] ↑", 1),
    Row("path", "length of the path [m]", 1),
    Row("curvature", "largest curvature of the path [1/m] ↓", 3),
    Row("duration", "time taken [s]", 1),
    Row("safety", "safety: free of collisions x share of the path with 0.5 m of room [%] ↑", 1),
    Row("return", "return ↑", 1),
    Row("cost", "cost per episode ↓", 3),
    Row("cost_cvar", "cost, worst tenth of the episodes ↓", 2),
    Row("steps", "steps per episode", 0),
)


def summarise_any(records: Sequence[Record]) -> Figures:
    """
    Turn records into figures, driving metrics where they are known.

    :param records: of at least one episode, see :class:`SeededEpisodes`
    :return: the figures by name; ``<name>_low`` and ``<name>_high`` bound 95 % intervals
    """
    figures: Figures = {"episodes": float(len(records))}
    for name in ("return", "cost", "steps"):
        values = np.array([record[name] for record in records])
        figures[name] = float(values.mean())
        figures[f"{name}_low"], figures[f"{name}_high"] = mean_interval(values)
    return figures | (summarise(records) if "driving_score" in records[0] else {})


def format_table(columns: Mapping[str, Figures]) -> str:
    """
    Set out the figures of several drivers side by side, with 95 % intervals in brackets.

    :param columns: figures by the name of the driver
    :return: a Markdown table, padded so that it can be read as it is
    """
    shown = [row for row in ROWS if all(row.name in figures for figures in columns.values())]
    lines = [["", *columns], *([row.label, *(_cell(row, figures) for figures in columns.values())] for row in shown)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    padded = ["| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in lines]
    rule = "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    return "\n".join([padded[0], rule, *padded[1:]])


def _cell(row: Row, figures: Figures) -> str:
    def show(name: str) -> str:
        return f"{row.scale * figures[name]:.{row.decimals}f}"

    low, high = f"{row.name}_low", f"{row.name}_high"
    return show(row.name) + (f" [{show(low)}, {show(high)}]" if low in figures else "")


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """
    Write a JSON file as a whole.

    :param path: where to
    :param content: what JSON can hold
    """
    with whole_file(path) as target:
        target.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
