"""One table of scores: a row for every track of every recording, a column for every figure.

It is a pandas frame with the columns `recording`, `group` and `track`, labels, such as network or
person, where there is more to tell apart, and the figures, NaN where unknown. Everything printed,
drawn or concluded is a group-by of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.sequence import FloatArray

LABELS = ("recording", "group", "track")
"""Labels that all rows have."""

POOLED = "all"
"""Name of the row over all groups; a group may have this name, too."""

Parts = Iterable[tuple[str | tuple[str, ...], pd.DataFrame]]
"""Scores of the rows of a table, each with its name, or names."""


def scored(
    recording: str,
    figures: Mapping[str, Mapping[str, float | None]],
    group: str = "",
    **labels: object,
) -> pd.DataFrame:
    """Return the rows of a recording from its figures by track, None where unknown, and labels."""
    names = {"recording": recording, "group": group, "track": [*figures], **labels}
    table = pd.DataFrame([*figures.values()], dtype=float)
    return pd.concat([pd.DataFrame(names), table], axis=1)


def joined(tables: Iterable[pd.DataFrame]) -> pd.DataFrame:
    """Return the rows of several tables, of which there is at least one."""
    return pd.concat(tables, ignore_index=True)


def values(scores: pd.DataFrame, metric: str, **where: str) -> FloatArray:
    """Return the known values (n,) of a metric, of the rows with these labels."""
    for label, name in where.items():
        scores = scores[scores[label] == name]
    found = scores[metric] if metric in scores else pd.Series(dtype=float)
    return np.asarray(found.dropna())


def over_seeds(scores: pd.DataFrame) -> pd.DataFrame:
    """Return `mean`, deviation (`std`) and standard error (`sem`) over the seeds of networks.

    They are of means over recordings, by network, track and metric; those of one seed are NaN.
    """
    labels = ["network", "track", "metric"]
    by_seed = scores.groupby([*labels[:2], "seed"], sort=False).mean(numeric_only=True)
    known = by_seed.rename_axis(columns="metric").stack().dropna()
    return known.groupby(labels, sort=False).agg(["mean", "std", "sem"])


def parts(scores: pd.DataFrame, by: str = "group") -> list[tuple[str, pd.DataFrame]]:
    """Return the groups, sorted by name; then all rows, `POOLED`, if there are several."""
    found = [(str(name), part) for name, part in scores.groupby(by)]
    return [*found, (POOLED, scores)] if len(found) > 1 else found


def by_track(scores: pd.DataFrame) -> Parts:
    """Return the tracks of each of `parts`, named by both."""
    return [
        ((group, str(track)), part)
        for group, found in parts(scores)
        for track, part in found.groupby("track", sort=False)
    ]


@dataclass(frozen=True)
class Column:
    """A column of a printed table: a metric of some rows, in one number.

    Attributes:
        title: title.
        metric: metric.
        form: format of the number.
        over: function of the known values (n,), of which there is at least one.
        track: the only track whose rows count; empty for all.
    """

    title: str
    metric: str
    form: str = ".2f"
    over: Callable[[FloatArray], Any] = np.median
    track: str = ""

    def value(self, scores: pd.DataFrame) -> float:
        """Return the number; NaN if no value is known."""
        known = values(scores, self.metric, **({"track": self.track} if self.track else {}))
        return float(self.over(known)) if len(known) else math.nan

    def text(self, scores: pd.DataFrame) -> str:
        """Return the number as text, "-" if no value is known."""
        return figure(self.value(scores), self.form)


def median_degrees(angles: FloatArray) -> float:
    """Return the median size of angles (n,) [rad] in degrees."""
    return math.degrees(np.median(np.abs(angles)))


def table(
    parts: Parts,
    columns: Sequence[Column],
    corner: Sequence[str] = ("group",),
    notes: Iterable[str] = (),
) -> str:
    """Return a table with a row for each part of the scores, and notes below it.

    The titles of the parts' names are `corner`.
    """
    rows = [[*corner, *(column.title for column in columns)]]
    for name, part in parts:
        names = (name,) if isinstance(name, str) else name
        rows.append([*names, *(column.text(part) for column in columns)])
    return "\n".join([*aligned(rows), *notes])
