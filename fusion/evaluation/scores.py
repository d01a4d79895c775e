"""One table of scores: a row for every figure of every track of every recording.

It is a pandas frame with the columns `COLUMNS`, and with labels, such as network or person, where
there is more to tell apart. Everything printed, drawn or concluded is a group-by of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.sequence import FloatArray

COLUMNS = ("recording", "group", "track", "metric", "value")

POOLED = "all"
"""Name of the row over all groups; a group may have this name, too."""

Figures = Mapping[str, float | None]
"""Figures of a track by metric; None where unknown."""


def scored(
    recording: str, figures: Mapping[str, Figures], group: str = "", **labels: object
) -> pd.DataFrame:
    """Return the rows of a recording from its figures by track; labels are columns of their own."""
    rows = [
        (recording, group, track, metric, np.nan if value is None else float(value))
        for track, found in figures.items()
        for metric, value in found.items()
    ]
    table = pd.DataFrame(rows, columns=list(COLUMNS)).astype({"value": float})
    return table.assign(**labels)


def joined(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of several tables, of which there is at least one."""
    return pd.concat(tables, ignore_index=True)


def wide(scores: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each track, with a column for each metric in place of metric and value."""
    labels = [name for name in scores.columns if name not in ("metric", "value")]
    table = scores.set_index([*labels, "metric"])["value"].unstack("metric", sort=False)
    return table.reset_index().rename_axis(columns=None)


def records(scores: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of `wide` as plain values."""
    found: list[dict[str, Any]] = wide(scores).to_dict("records")
    return found


def by_name(scores: pd.DataFrame, label: str) -> dict[str, dict[str, float]]:
    """Return the values by a label, such as the track, and by metric."""
    found = scores.groupby(label, sort=False)
    return {str(n): dict(zip(part["metric"], part["value"], strict=True)) for n, part in found}


def parts(scores: pd.DataFrame, by: str = "group") -> list[tuple[str, pd.DataFrame]]:
    """Return the groups, sorted by name; then all rows, `POOLED`, if there are several."""
    found = [(str(name), part) for name, part in scores.groupby(by)]
    return [*found, (POOLED, scores)] if len(found) > 1 else found


def by_track(scores: pd.DataFrame) -> list[tuple[tuple[str, str], pd.DataFrame]]:
    """Return the tracks of each of `parts`, named by both."""
    return [
        ((group, str(track)), part)
        for group, found in parts(scores)
        for track, part in found.groupby("track", sort=False)
    ]


def values(scores: pd.DataFrame, metric: str, **where: str) -> FloatArray:
    """Return the known values (n,) of a metric, of the rows with these labels."""
    chosen = scores["metric"] == metric
    for label, name in where.items():
        chosen &= scores[label] == name
    found = scores.loc[chosen, "value"].to_numpy()
    return np.asarray(found[np.isfinite(found)])


@dataclass(frozen=True)
class Column:
    """A column of a printed table: a metric of some rows, in one number.

    Attributes:
        title: title.
        metric: metric.
        form: format of the number.
        over: function of the known values (n,), of which there is at least one.
        where: labels of the rows, such as `{"track": "filtered"}`.
    """

    title: str
    metric: str
    form: str = ".2f"
    over: Callable[[FloatArray], Any] = np.median
    where: Mapping[str, str] = field(default_factory=dict)

    def value(self, scores: pd.DataFrame) -> float:
        """Return the number; NaN if no value is known."""
        known = values(scores, self.metric, **self.where)
        return float(self.over(known)) if len(known) else float("nan")

    def text(self, scores: pd.DataFrame) -> str:
        """Return the number as text, "-" if no value is known."""
        return figure(self.value(scores), self.form)


def over_seeds(scores: pd.DataFrame) -> pd.DataFrame:
    """Return `mean`, deviation (`std`) and standard error (`sem`) over the seeds of networks.

    They are of means over recordings, by network, track and metric; those of one seed are NaN.
    """
    labels = ["network", "track", "metric"]
    by_seed = scores.groupby([*labels, "seed"], sort=False)["value"].mean().dropna()
    return by_seed.groupby(labels, sort=False).agg(["mean", "std", "sem"])


def geometric_mean(known: FloatArray) -> float:
    """Return the geometric mean of ratios (n,)."""
    return float(np.exp(np.log(known).mean()))


def quantile(share: float) -> Callable[[FloatArray], float]:
    """Return a function of values (n,): the value below which a share of them lies."""
    return lambda known: float(np.quantile(known, share))


def median_degrees(angles: FloatArray) -> float:
    """Return the median size of angles (n,) [rad] in degrees."""
    return math.degrees(np.median(np.abs(angles)))


def rows_of(
    parts: Iterable[tuple[str | tuple[str, ...], pd.DataFrame]],
    columns: Sequence[Column],
    *corner: str,
) -> list[list[str]]:
    """Return the cells of a table, its titles first: a row for each part of the scores.

    Parts are named by one label or by several, whose titles are `corner`.
    """
    rows = [[*corner, *(column.title for column in columns)]]
    for name, part in parts:
        names = (name,) if isinstance(name, str) else name
        rows.append([*names, *(column.text(part) for column in columns)])
    return rows


def table(
    parts: Iterable[tuple[str | tuple[str, ...], pd.DataFrame]],
    columns: Sequence[Column],
    corner: tuple[str, ...] = ("group",),
    notes: Sequence[str] = (),
) -> str:
    """Return a table with a row for each part of the scores, and notes below it."""
    return "\n".join([*aligned(rows_of(parts, columns, *corner)), *notes])
