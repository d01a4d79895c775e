"""The metrics of a comparison's tracks as a text table."""

from __future__ import annotations

from stario.fusion.evaluation.compare import METRIC_TITLES, Comparison
from stario.sequences.drawing.text_table import aligned, figure

_FULL_COVERAGE = 0.98
"""Share of a track below which the coverage by ground truth is reported as partial."""

_UNTRACKED = 1.5
"""Time at a recording's ends without a track [s] below which all of it counts as tracked: a track
starts where the attitude is known, up to a second after the first sample."""

_EXPLAINED = (
    *("ate_m", "horizontal", "alignment", "ate_fit_m", "rte_m", "pde", "aye_rad"),
    *("nees_median", "nis_mean"),
)
"""Metrics explained below a table."""


def track_table(found: Comparison) -> str:
    """Format a table with a row of known metrics per track, and the meaning of its columns."""
    metrics, truth, words = found.metrics, found.sequence.truth, found.words
    known = {
        key for values in metrics.values() for key, value in values.items() if value is not None
    }
    columns = {key: title for key, title in METRIC_TITLES.items() if key in known}
    rows = [
        [name, *(figure(values.get(key)) for key in columns)] for name, values in metrics.items()
    ]
    lines = aligned([["", *columns.values()], *rows])
    general = () if truth is None else ("horizontal", "alignment")
    explained = [key for key in _EXPLAINED if key in (*columns, *general)]
    lines += [f"{key}: {words[key]}." for key in explained]
    if truth is None:
        return "\n".join(lines)
    covered = float(truth.covers(found.tracks[found.main].time).mean())
    if covered < _FULL_COVERAGE:
        lines.append(f"The truth covers {covered:.0%} of the track; metrics refer to that part.")
    return "\n".join(lines)


def tracked_words(found: Comparison) -> str:
    """Return how much of a recording is tracked: less where a sensor stopped, for example."""
    time = found.tracks[found.main].time
    recorded, tracked = found.sequence.duration, float(time[-1] - time[0])
    if recorded - tracked < _UNTRACKED:
        return f"{recorded:.1f} s"
    return f"{tracked:.1f} of {recorded:.1f} s tracked"
