"""The metrics of a comparison's tracks as a text table."""

from __future__ import annotations

from stario.fusion.evaluation.compare import FULL_COVERAGE, METRIC_TITLES, Comparison
from stario.sequences.drawing.text_table import aligned, figure

_UNTRACKED = 1.5
"""Time at a recording's ends without a track [s] below which all of it counts as tracked: a track
starts where the attitude is known, up to a second after the first sample."""

_EXPLAINED = (
    *("ate_m", "horizontal", "alignment", "ate_fit_m", "rte_m", "pde", "aye_rad"),
    *("nees_median", "nis_mean", "seconds_filter"),
)
"""Figures explained below a table, or below several."""


def track_table(found: Comparison) -> str:
    """Format a table with a row of known metrics per track; `column_words` explains it."""
    metrics, truth, columns = found.metrics, found.sequence.truth, _columns(found)
    rows = [
        [name, *(figure(values.get(key)) for key in columns)] for name, values in metrics.items()
    ]
    lines = aligned([["", *columns.values()], *rows])
    if truth is None:
        return "\n".join(lines)
    covered = float(truth.covers(found.tracks[found.main].time).mean())
    if covered < FULL_COVERAGE:
        lines.append(f"The truth covers {covered:.0%} of the track; metrics refer to that part.")
    return "\n".join(lines)


def column_words(found: Comparison) -> dict[str, str]:
    """Return the meaning of the columns of a table by their titles without units."""
    titles, words = _columns(found), found.words
    if found.sequence.truth is not None:
        titles |= {"horizontal": "horizontal", "alignment": "alignment"}
    return {titles[key].partition(" [")[0]: words[key] for key in _EXPLAINED if key in titles}


def _columns(found: Comparison) -> dict[str, str]:
    """Return the titles of the figures that are known of any track."""
    known = {
        key
        for values in found.metrics.values()
        for key, value in values.items()
        if value is not None
    }
    return {key: title for key, title in METRIC_TITLES.items() if key in known}


def tracked_words(found: Comparison) -> str:
    """Return how much of a recording is tracked: less where a sensor stopped, for example."""
    time = found.tracks[found.main].time
    recorded, tracked = found.sequence.duration, float(time[-1] - time[0])
    if recorded - tracked < _UNTRACKED:
        return f"{recorded:.1f} s"
    return f"{tracked:.1f} of {recorded:.1f} s tracked"
