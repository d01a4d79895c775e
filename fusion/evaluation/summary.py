"""Summary of many comparisons: one table of recordings by tracks, with medians and means."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from stario.fusion.evaluation.compare import (
    FULL_COVERAGE,
    METRIC_WORDS,
    METRICS,
    TRACKS,
    Comparison,
)
from stario.fusion.evaluation.results import metrics_dict
from stario.fusion.evaluation.scores import Column, joined, rows_of, scored, values
from stario.sequences.arrays import check_type
from stario.sequences.drawing.text_table import aligned, figure


@dataclass(frozen=True)
class _WithFit(Column):
    """A column of ATEs, with those after a yaw fit in parentheses."""

    def text(self, scores: pd.DataFrame) -> str:
        fitted = replace(self, metric="ate_fit_m").value(scores)
        return f"{super().text(scores)} ({figure(fitted, self.form)})"


def _columns(over: Callable[..., Any]) -> list[Column]:
    errors = {
        "pdr": "steps (PDR)",
        "network_true_attitude": "network, true attitude",
        "network": "network, own attitude",
        "filtered": "filtered",
        "track": "track",
    }
    others = {
        "NIS": ("filtered", "nis_mean"),
        "filtered NEES": ("filtered", "nees_median"),
        "track NEES": ("track", "nees_median"),
    }
    return [
        *(_WithFit(title, "ate_m", over=over, where={"track": t}) for t, title in errors.items()),
        *(Column(title, m, over=over, where={"track": t}) for title, (t, m) in others.items()),
    ]


_MIN_COVERAGE = 0.5
"""Share of a track at which the truth is known below which a recording does not count in medians
and means."""


@dataclass(frozen=True)
class Scores:
    """Figures of one recording, kept after a comparison's arrays are released.

    Attributes:
        name: name of the recording.
        record: its entry in `metrics.json`.
    """

    name: str
    record: dict[str, Any]

    @property
    def table(self) -> pd.DataFrame:
        """The figures as rows of recording, group, track, metric and value."""
        return scored(self.name, self.record["tracks"])

    @property
    def coverage(self) -> float:
        """Smallest share of a track at which the truth is known; 1 without truth."""
        return float(min(values(self.table, "coverage"), default=1.0))


def scores_of(comparison: Comparison) -> Scores:
    """Return the figures of a comparison."""
    return Scores(comparison.sequence.name, comparison.as_dict())


def summary(recordings: Sequence[Scores]) -> dict[str, object]:
    """Return figures of every recording, with medians and means over them, as plain values.

    Medians and means leave out recordings whose truth is known for less than half of the track.
    """
    counted = _together(_counted(recordings))
    over = {
        track: {
            metric: {"median": float(np.median(known)), "mean": float(np.mean(known))}
            for metric in METRICS
            if not metric.startswith("seconds_")
            and len(known := values(counted, metric, track=track))
        }
        for track in TRACKS
    }
    return metrics_dict({r.name: r.record for r in recordings}) | {"over_recordings": over}


def summary_table(recordings: Sequence[Scores]) -> str:
    """Return the summary as text: horizontal ATE of each track, consistency of the back ends.

    Raises:
        InputError: a recording's figures are of another type.
    """
    for scores in recordings:
        check_type("recordings", scores, Scores, "scores_of(comparison) returns one")
    rows = rows_of(((_name_with_coverage(r), r.table) for r in recordings), _columns(np.mean), "")
    counted = _counted(recordings)
    for name, over in (("median", np.median), ("mean", np.mean)):
        rows += rows_of([(name, _together(counted))], _columns(over), "")[1:]
    lines = aligned(rows)
    if len(counted) < len(recordings):
        least = f"{_MIN_COVERAGE:.0%}"
        lines.append(f"median and mean without recordings whose truth covers less than {least};")
    lines.append(f"ATE in m: {METRIC_WORDS['ate_m']};")
    lines.append(f"in parentheses {METRIC_WORDS['ate_fit_m']};")
    lines.append(f"horizontal: {METRIC_WORDS['horizontal']};")
    lines.append(f"NIS: {METRIC_WORDS['nis_mean']};")
    lines.append(f"NEES: {METRIC_WORDS['nees_median']}; alignment: {METRIC_WORDS['alignment']}.")
    return "\n".join(lines)


def _name_with_coverage(scores: Scores) -> str:
    share = scores.coverage
    return scores.name + (f" (truth of {share:.0%})" if share < FULL_COVERAGE else "")


def _counted(recordings: Sequence[Scores]) -> list[Scores]:
    return [scores for scores in recordings if scores.coverage >= _MIN_COVERAGE]


def _together(recordings: Sequence[Scores]) -> pd.DataFrame:
    return joined([scored("", {}), *(scores.table for scores in recordings)])
