"""Summary of many comparisons: one table of recordings by tracks, medians and means."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from stario.fusion.compare import METRIC_WORDS, TRACKS, Comparison
from stario.sequences.sequence import FloatArray

_COLUMNS = (
    ("network_true_attitude", "ate_m", "network, true attitude"),
    ("network", "ate_m", "network, own attitude"),
    ("ekf", "ate_m", "EKF"),
    ("ekf", "nis", "EKF NIS"),
    ("ekf", "nees", "EKF NEES"),
)


def summary(comparisons: Sequence[Comparison]) -> dict[str, object]:
    """Figures of every recording with medians and means over them, as plain values."""
    recordings = {c.sequence.name: c.as_dict() for c in comparisons}
    metrics = ("ate_m", "rte_m", "pde", "aye_rad", "nees", "nis")
    over = {
        track: {
            metric: {"median": float(np.median(values)), "mean": float(np.mean(values))}
            for metric in metrics
            if len(values := _known(comparisons, track, metric))
        }
        for track in TRACKS
    }
    return {"recordings": recordings, "over_recordings": over, "conventions": METRIC_WORDS}


def summary_table(comparisons: Sequence[Comparison]) -> str:
    """The same for a person: horizontal ATE of each track, consistency of the EKF."""
    width = max([24, *(len(c.sequence.name) + 2 for c in comparisons)])
    lines = [f"{'':<{width}}" + "".join(f"{title:>24}" for _, _, title in _COLUMNS)]
    rows = [(c.sequence.name, [_value(c, t, m) for t, m, _ in _COLUMNS]) for c in comparisons]
    known = [_known(comparisons, track, metric) for track, metric, _ in _COLUMNS]
    for name, over in (("median", np.median), ("mean", np.mean)):
        rows.append((name, [float(over(values)) if len(values) else None for values in known]))
    for name, row in rows:
        lines.append(f"{name:<{width}}" + "".join(f"{_cell(value):>24}" for value in row))
    lines.append(f"ATE in m: {METRIC_WORDS['ate_m']}; NIS: {METRIC_WORDS['nis']}; ")
    lines.append(f"NEES: {METRIC_WORDS['nees']}; alignment: {METRIC_WORDS['alignment']}.")
    return "\n".join(lines)


def _known(comparisons: Sequence[Comparison], track: str, metric: str) -> FloatArray:
    values = [_value(c, track, metric) for c in comparisons]
    return np.array([value for value in values if value is not None])


def _value(comparison: Comparison, track: str, metric: str) -> float | None:
    """A figure, None where it is not known."""
    value = comparison.metrics.get(track, {}).get(metric)
    return value if value is not None and math.isfinite(value) else None


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
