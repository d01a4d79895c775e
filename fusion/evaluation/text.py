"""What is printed of tracks: of one recording by `run` and `compare`, of many by `evaluate`."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from stario.fusion.evaluation.compare import (
    FULL_COVERAGE,
    METRIC_TITLES,
    METRIC_WORDS,
    METRICS,
    TRACK_TITLES,
    TRACK_WORDS,
    TRACKS,
    Comparison,
    Metrics,
)
from stario.fusion.evaluation.known_positions import position_error_words
from stario.fusion.evaluation.results import metrics_dict
from stario.fusion.evaluation.scores import Column, table
from stario.fusion.report.health import LOST_YAW_SIGMA
from stario.fusion.values.state import Track
from stario.sequences.arrays import check_type
from stario.sequences.drawing.figures import distance
from stario.sequences.drawing.text_table import aligned, figure

_UNTRACKED = 1.5
"""Time at a recording's ends without a track [s] below which all of it counts as tracked: a track
starts where the attitude is known, up to a second after the first sample."""

_SHOWN_FACTORS = {"pde": 100.0, "aye_rad": math.degrees(1.0)}
"""Factors from a figure's unit to that of its column in `METRIC_TITLES`."""


def shown_value(metrics: Metrics, key: str) -> float | None:
    """Return a figure in the unit of its column; None if it is unknown."""
    value = metrics.get(key)
    return None if value is None else _SHOWN_FACTORS.get(key, 1.0) * value


def without_unit(words: str) -> str:
    """Return the meaning of a figure without its unit in JSON, which tables do not always have."""
    return re.sub(r" \[[^]]*\]", "", words)


def track_table(found: Comparison) -> str:
    """Format a table with a row of known metrics per track; `EXPLANATION` explains it."""
    known = [key for values in found.metrics.values() for key, v in values.items() if v is not None]
    columns = {key: title for key, title in METRIC_TITLES.items() if key in known}
    rows = [
        [name, *(figure(shown_value(values, key), ".2f") for key in columns)]
        for name, values in found.metrics.items()
    ]
    return "\n".join(aligned([["", *columns.values()], *rows]))


def track_figures(track: Track) -> dict[str, float]:
    """Return a track's duration [s], length [m] and the end's distance from the start [m]."""
    time, position_W = track.time, track.trajectory.position_W
    return {
        "seconds": float(time[-1] - time[0]),
        "length_m": track.trajectory.path_length(),
        "end_m": float(np.linalg.norm(np.diff(position_W[[0, -1], :2], axis=0))),
    }


def track_words(found: Comparison) -> str:
    """Return in one line the length of the track, where it ends, and how sure that is."""
    track, recorded = found.track, found.sequence.duration
    tracked, length, ends = track_figures(track).values()
    duration = f"{recorded:.1f} s"
    if recorded - tracked >= _UNTRACKED:
        duration = f"{tracked:.1f} of {recorded:.1f} s tracked"
    words = f"{length:.1f} m in {duration}, ending {ends:.1f} m from its start"
    if sigma := track.health and track.health.final_sigma:
        lost = sigma["yaw_rad"] >= LOST_YAW_SIGMA
        yaw = "yaw lost" if lost else f"yaw {math.degrees(sigma['yaw_rad']):.1f} deg"
        there = f"sigma there {sigma['position_m']:.1f} m, height {sigma['height_m']:.1f} m"
        words += f" ({there}, {yaw})"
    return words


def place_words(found: Comparison) -> str:
    """Return in one line where on the earth the track lies and by what; empty if nothing is known.

    Positions that were used are no truth to compare with, which it says, too.
    """
    place, positions = found.georeference, found.sequence.positions
    used = " and ".join(found.used)
    words = [f"{used} are used, and so not compared with"] if used else []
    if place is None:
        words += ["not on the map, since its direction there is unknown"] if used else []
        return "; ".join(words)
    start = place.latlon_deg(found.track.trajectory.position_W[:1])[0]
    at = f"starts at {start[0]:.6f}, {start[1]:.6f}"
    if place is not found.track.georeference and positions is not None:
        at += f", fitted to {positions.kind}"
    elif (health := found.track.health) and not (
        health.fixes.get("applied") or health.bearings.get("north")
    ):
        at += ", in a direction that no fix has confirmed"
    return "; ".join([at, *words])


def error_words(found: Comparison, name: str = "track") -> str:
    """Return in one line how far a track is from the truth or the known positions.

    Empty if nothing is known.
    """
    metrics, path = found.metrics[name], found.path_m
    if metrics["ate_m"] is None or metrics["ate_fit_m"] is None or path is None:
        positions = found.sequence.positions
        if found.sequence.truth is not None or positions is None:
            return ""
        return position_error_words(found.tracks[name], positions)
    share = 100.0 * metrics["ate_m"] / max(path, 1e-9)
    if share >= 100.0:
        return f"{distance(metrics['ate_m'])} rms from the truth"
    fitted = 100.0 * metrics["ate_fit_m"] / path
    words = (
        f"{metrics['ate_m']:.2f} m rms from the truth ({share:.1f} % of its {path:.1f} m), "
        f"{metrics['ate_fit_m']:.2f} m ({fitted:.1f} %) after the best shift and turn"
    )
    covariance = found.tracks[name].trajectory.position_covariance_W
    if covariance is not None:
        sigma = math.sqrt(float(np.mean(covariance[:, 0, 0] + covariance[:, 1, 1])))
        words += f"; its sigma says {sigma:.2f} m"
    if (metrics["coverage"] or 0.0) < FULL_COVERAGE:
        words += f"; the truth covers {metrics['coverage']:.0%} of it"
    return words


EXPLANATION = "\n".join(
    [
        *(f"{name}: {words}." for name, words in TRACK_WORDS.items()),
        "length: along chords of one second, so that neither sway nor noise adds to it.",
        "sigma: one standard deviation, horizontal unless said.",
        *(f"{title}: {without_unit(METRIC_WORDS[key])}." for key, title in METRIC_TITLES.items()),
        *(f"{key}: {METRIC_WORDS[key]}." for key in ("horizontal", "alignment")),
    ]
)
"""Definitions of all that `run` and `compare` print."""


@dataclass(frozen=True)
class _WithFit(Column):
    """A column of ATEs, with those after a yaw fit in parentheses."""

    def text(self, scores: pd.DataFrame) -> str:
        fitted = replace(self, metric="ate_fit_m").value(scores)
        return f"{super().text(scores)} ({figure(fitted, self.form)})"


_COLUMNS = [
    *(_WithFit(title, "ate_m", track=track) for track, title in TRACK_TITLES.items()),
    Column("NIS", "nis_mean", track="filtered"),
    Column("filtered NEES", "nees_median", track="filtered"),
    Column("track NEES", "nees_median", track="track"),
]
"""Columns of a summary, of rows that have each track once."""

_MIN_COVERAGE = 0.5
"""Share of a track at which the truth is known below which a recording does not count in medians
and means."""


def summary(scores: pd.DataFrame) -> dict[str, object]:
    """Return figures of every recording, with medians and means over them, as plain values.

    Medians and means leave out recordings whose truth is known for less than half of the track.
    """
    figures = [name for name in METRICS if not name.startswith("seconds_")]
    over = _counted(scores).groupby("track")[figures].agg(["median", "mean"]).reindex([*TRACKS])
    known = {track: row.unstack(sort=False).dropna() for track, row in over.iterrows()}
    means = {track: table.to_dict("index") for track, table in known.items()}
    return metrics_dict(scores) | {"over_recordings": means}


def summary_table(scores: pd.DataFrame) -> str:
    """Return the summary as text: horizontal ATE of each track, consistency of the back ends.

    Args:
        scores: the `Comparison.scores` of several recordings, concatenated.

    Raises:
        InputError: they are of another type.
    """
    check_type("scores", scores, pd.DataFrame, "pandas.concat of `Comparison.scores` returns one")
    rows = []
    for name, part in scores.groupby("recording", sort=False):
        coverage = part["coverage"].min()
        known = f" (truth of {coverage:.0%})" if coverage < FULL_COVERAGE else ""
        rows.append((f"{name}{known}", part))
    counted = _counted(scores)
    over = counted.groupby("track")[[*METRICS]]
    rows += [(name, over.agg(name).reset_index()) for name in ("median", "mean")]
    least, words = f"{_MIN_COVERAGE:.0%}", METRIC_WORDS
    left_out = f"median and mean without recordings whose truth covers less than {least};"
    notes = [
        *([left_out] if len(counted) < len(scores) else []),
        f"ATE in m: {words['ate_m']};",
        f"in parentheses {words['ate_fit_m']};",
        f"horizontal: {words['horizontal']};",
        f"NIS: {words['nis_mean']};",
        f"NEES: {words['nees_median']}; alignment: {words['alignment']}.",
    ]
    return table(rows, _COLUMNS, ("",), notes)


def _counted(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the figures of the recordings that count in medians and means."""
    coverage = scores.groupby("recording")["coverage"].transform("min")
    return scores[~(coverage < _MIN_COVERAGE)]
