"""Summary of many comparisons: one table of recordings by tracks, with medians and means."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.evaluation.compare import (
    FULL_COVERAGE,
    METRIC_WORDS,
    METRICS,
    RECORDING_WORDS,
    TRACKS,
    Comparison,
    Metrics,
)
from stario.sequences.arrays import check_type
from stario.sequences.drawing.text_table import aligned, figure
from stario.sequences.sequence import FloatArray

_COLUMNS = (
    ("pdr", "ate_m", "steps (PDR)"),
    ("network_true_attitude", "ate_m", "network, true attitude"),
    ("network", "ate_m", "network, own attitude"),
    ("ekf", "ate_m", "EKF"),
    ("graph", "ate_m", "graph"),
    ("ekf", "nis_mean", "EKF NIS"),
    ("ekf", "nees_median", "EKF NEES"),
    ("graph", "nees_median", "graph NEES"),
)


_MIN_COVERAGE = 0.5
"""Share of a track at which the truth is known below which a recording does not count in medians
and means."""


@dataclass(frozen=True)
class Scores:
    """Figures of one recording, kept after a comparison's arrays are released.

    Attributes:
        name: name of the recording.
        metrics: metrics by track name.
        record: entry of the recording in `metrics.json`.
        words: meaning of the figures.
    """

    name: str
    metrics: dict[str, Metrics]
    record: dict[str, object]
    words: dict[str, str]

    @property
    def coverage(self) -> float:
        """Smallest share of a track at which the truth is known; 1 without truth."""
        shares = [track.get("coverage") for track in self.metrics.values()]
        return min((share for share in shares if share is not None), default=1.0)


def scores_of(comparison: Comparison) -> Scores:
    """Return the figures of a comparison."""
    name, record = comparison.sequence.name, comparison.as_dict()
    return Scores(name, comparison.metrics, record, comparison.words)


def summary(recordings: Sequence[Scores]) -> dict[str, object]:
    """Return figures of every recording, with medians and means over them, as plain values.

    Medians and means leave out recordings whose truth is known for less than half of the track.
    """
    records = {scores.name: scores.record for scores in recordings}
    metrics = [metric for metric in METRICS if not metric.startswith("seconds_")]
    counted = _counted(recordings)
    over = {
        track: {
            metric: {"median": float(np.median(values)), "mean": float(np.mean(values))}
            for metric in metrics
            if len(values := _known_values(counted, track, metric))
        }
        for track in TRACKS
    }
    words = RECORDING_WORDS | METRIC_WORDS
    return {"recordings": records, "over_recordings": over, "conventions": words}


def summary_table(recordings: Sequence[Scores]) -> str:
    """Return the summary as text: horizontal ATE of each track, consistency of the back ends.

    Raises:
        InputError: a recording's figures are of another type.
    """
    for scores in recordings:
        check_type("recordings", scores, Scores, "scores_of(comparison) returns one")
    rows = [
        [_name_with_coverage(r), *(_cell([r], t, m, np.mean) for t, m, _ in _COLUMNS)]
        for r in recordings
    ]
    counted = _counted(recordings)
    for name, over in (("median", np.median), ("mean", np.mean)):
        rows.append([name, *(_cell(counted, t, m, over) for t, m, _ in _COLUMNS)])
    lines = aligned([["", *(title for _, _, title in _COLUMNS)], *rows])
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


def _cell(
    recordings: Sequence[Scores], track: str, metric: str, over: Callable[[FloatArray], float]
) -> str:
    """Return a figure over recordings; an ATE with that after a yaw fit in parentheses."""
    names = ("ate_m", "ate_fit_m") if metric == "ate_m" else (metric,)
    columns = [_known_values(recordings, track, name) for name in names]
    texts = [figure(float(over(values)) if len(values) else None, ".2f") for values in columns]
    return texts[0] + "".join(f" ({text})" for text in texts[1:])


def _known_values(recordings: Sequence[Scores], track: str, metric: str) -> FloatArray:
    values = [scores.metrics.get(track, {}).get(metric) for scores in recordings]
    return np.array([value for value in values if value is not None and math.isfinite(value)])
