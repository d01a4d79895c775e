"""The report as one self-contained HTML file: figures, time cursor, health in words, table."""

from __future__ import annotations

import base64
import gzip
import html
import importlib.resources
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from plotly.offline import get_plotlyjs

from stario.fusion.evaluation.compare import METRIC_TITLES, Comparison
from stario.fusion.evaluation.known_positions import shown_positions
from stario.fusion.evaluation.text import shown_value
from stario.fusion.report.figures import map_figure, time_figure
from stario.fusion.report.panels import (
    bias_panels,
    innovation_panels,
    motion_panels,
    numbers,
    style,
)
from stario.fusion.report.series import Series, track_series, trajectory_series
from stario.fusion.state import Track
from stario.sequences.accuracy.metrics import moved
from stario.sequences.drawing.figures import clock
from stario.sequences.drawing.text_table import figure
from stario.sequences.files import atomic_write
from stario.sequences.findings import Finding
from stario.sequences.geodesy import turned
from stario.sequences.sequence import ImuSequence, PositionTrack

_LEVEL_WORDS = {"warning": "To do", "good": "Good", "note": "Note"}
_DIGITS = {"ate_m": 2, "ate_fit_m": 2, "rte_m": 2, "aye_rad": 1, "nees_median": 1, "nis_mean": 1}
"""Decimals of the table's columns."""


def write_report(path: Path, found: Comparison, tiles: str = "") -> Path:
    """Write the report of one recording's tracks, completely or not at all.

    Where it is known where on the earth the tracks lie, they are drawn with x east and y north.

    Args:
        path: the HTML file; its folder must exist.
        found: tracks and metrics of `compare` or of a run; the ground truth is drawn if the
            recording has one.
        tiles: address of a map server's tiles, with {z}, {x} and {y}, as the map's background; the
            browser asks it. Empty for none.

    Returns:
        The path.

    Raises:
        InputError: the folder does not exist.
    """
    sequence, tracks = found.sequence, found.tracks
    start = float(sequence.time[np.isfinite(sequence.time)][0])
    truth = sequence.truth
    # Beside a true track, those are drawn in its frame, whose place is not known.
    place = found.georeference if truth is None else None
    yaw = 0.0 if place is None else place.yaw
    series = {
        name: track_series(tracks[name], moved(aligned, yaw, np.zeros(3), np.zeros(3)), start)
        for name, aligned in found.aligned().items()
    }
    true_series = None if truth is None else trajectory_series(truth, start)
    main = "track"
    # Dead reckoning is kilometres off within a minute: no axis fits it and the others.
    drawn = {name: s for name, s in series.items() if name != "dead_reckoning"}
    health = tracks[main].health
    floors = [
        change._replace(start=change.start - start, stop=change.stop - start)
        for change in (health.floors if health else [])
    ]
    panels = motion_panels(drawn, true_series, main, floors)
    panels += bias_panels(main, series[main])
    innovations = tracks[main].innovations
    if innovations is not None and len(innovations.time):
        panels += innovation_panels(innovations, start)
    mapped = drawn if truth is None else series
    known = shown_positions(sequence, tracks[main])
    if known is not None:
        known = replace(known, position_W=turned(known.position_W, yaw))
    corrections = [
        (time - start, metres, turn, cause)
        for time, metres, turn, cause in (health.corrections if health else [])
    ]
    data = {
        "map": json.loads(
            map_figure(
                mapped,
                true_series,
                known,
                main,
                corrections,
                place and replace(place, yaw=0.0),
                tiles,
            ).to_json()
        ),
        "time": json.loads(time_figure(panels).to_json()),
        "cursors": _cursors(drawn, main),
    }
    parts = {
        "TITLE": html.escape(sequence.name),
        "SUMMARY": html.escape(sequence.summary().removeprefix(f"{sequence.name}: ")),
        "FACTS": _facts(sequence, tracks[main], series[main]),
        "LEGEND": _legend(
            [*([] if truth is None else ["truth"]), *mapped], known, len(corrections)
        ),
        "HEALTH": _health(found.verdict),
        "TABLE": "" if truth is None else _table(found),
        "STYLE": _asset("report.css"),
        "SCRIPT": _asset("report.js"),
        "DATA": _packed(json.dumps(data, separators=(",", ":"))),
        "PLOTLY": _packed_plotly(),
    }
    with atomic_write(path) as file:
        file.write(_filled(parts))
    return path


def _asset(name: str) -> str:
    """Read a text file of this package."""
    return importlib.resources.files("stario.fusion.report").joinpath(name).read_text("utf-8")


def _filled(parts: Mapping[str, str]) -> str:
    """Fill the template; it is split first, so that a part may contain anything."""
    pieces = _asset("report.html").split("%%")
    return "".join(piece if k % 2 == 0 else parts[piece] for k, piece in enumerate(pieces))


@cache
def _packed_plotly() -> str:
    return _packed(get_plotlyjs())


def _packed(text: str) -> str:
    """Return a text compressed for a script element, a quarter to a third as long.

    Base 85 is shorter than 64 by a sixteenth, which keeps the file below 2 MB. Its `<`, which
    could begin a tag or a comment, is written as a comma.
    """
    packed = base64.b85encode(gzip.compress(text.encode(), mtime=0))
    return packed.decode("ascii").replace("<", ",")


def _facts(sequence: ImuSequence, track: Track, series: Series) -> str:
    duration = sequence.duration
    facts = [
        (clock(duration), "recorded (min:s)"),
        (clock(track.time[-1] - track.time[0]), "tracked (min:s)"),
        (f"{track.trajectory.path_length():.0f} m", "estimated path length"),
        (f"{len(sequence) / max(duration, 1e-9):.0f} Hz", "sampling rate"),
    ]
    if series.horizontal_sigma is not None and series.yaw_sigma is not None:
        facts.append((f"{series.horizontal_sigma[-1]:.2f} m", "final position, 1 sigma"))
        facts.append((f"{series.yaw_sigma[-1]:.1f} deg", "final yaw, 1 sigma"))
    end = track.trajectory.position_W[-1] - track.trajectory.position_W[0]
    facts.append((f"{float(np.hypot(*end[:2])):.1f} m", "between start and end"))
    return "".join(f"<div><b>{value}</b><span>{label}</span></div>" for value, label in facts)


def _legend(names: Sequence[str], known: PositionTrack | None, corrections: int) -> str:
    """Return a button for each track, with its line, that hides and shows it everywhere.

    Known positions and corrections have words only.
    """
    buttons = []
    for name in names:
        label, colour, dash = style(name)
        lengths = "none" if dash == "solid" else dash
        line = (
            '<svg width="28" height="8" aria-hidden="true"><line x1="0" y1="4" x2="28" y2="4" '
            f'stroke="{colour}" stroke-width="3" stroke-dasharray="{lengths}"/></svg>'
        )
        buttons.append(
            f'<button type="button" aria-pressed="true" data-track="{html.escape(name)}">'
            f"{line}{html.escape(label)}</button>"
        )
    if known is not None:
        buttons.append(f"<span>&#10005; {known.kind}, fitted to the track</span>")
    if corrections:
        buttons.append(f"<span>&#9650; corrected at once ({corrections})</span>")
    return "".join(buttons)


def _health(found: Sequence[Finding]) -> str:
    rows = []
    for finding in found:
        advice = f"<p>{html.escape(finding.advice)}</p>" if finding.advice else ""
        word = _LEVEL_WORDS[finding.level]
        text = f"<b>{word}</b><div>{html.escape(finding.text)}{advice}</div>"
        rows.append(f'<li class="{finding.level}">{text}</li>')
    return f"<ul>{''.join(rows)}</ul>"


def _table(found: Comparison) -> str:
    head = "".join(f"<th>{METRIC_TITLES[key].replace(' ', '<br>')}</th>" for key in _DIGITS)
    rows = []
    for name, figures in found.metrics.items():
        shown = {key: shown_value(figures, key) for key in _DIGITS}
        cells = (_cell(shown[key], digits) for key, digits in _DIGITS.items())
        row = "".join(f"<td>{cell}</td>" for cell in cells)
        rows.append(f"<tr><th>{html.escape(style(name)[0])}</th>{row}</tr>")
    words = found.words
    explanations = "".join(
        f"<li><b>{METRIC_TITLES[key].split()[0]}</b> {html.escape(words[key])}.</li>"
        for key in _DIGITS
    )
    explanations += "".join(
        f"<li><b>{key.capitalize()}</b> {html.escape(words[key])}.</li>"
        for key in ("horizontal", "alignment")
    )
    return (
        f"<h2>Accuracy against ground truth</h2><table><tr><th></th>{head}</tr>{''.join(rows)}"
        "</table><details class='words'><summary>What the figures mean</summary>"
        f"<ul>{explanations}</ul></details>"
    )


def _cell(value: float | None, digits: int) -> str:
    """Format a figure; of a large one the decimals say nothing, and a phone is narrow."""
    return figure(value, ".0f" if value is not None and abs(value) >= 100.0 else f".{digits}f")


def _cursors(tracks: Mapping[str, Series], main: str) -> list[dict[str, Any]]:
    """Return what the slider moves: position, ellipse and values of each track, the main first."""
    cursors = []
    for name in sorted(tracks, key=lambda name: name != main):
        series = tracks[name]
        label, colour, _ = style(name)
        columns = {
            "t": series.time,
            "x": series.position[:, 0],
            "y": series.position[:, 1],
            "speed": series.speed,
            "yaw": series.yaw,
        }
        P = series.position_covariance
        if P is not None:
            columns |= {"xx": P[:, 0, 0], "xy": P[:, 0, 1], "yy": P[:, 1, 1]}
        rounded = {
            key: numbers(column, 3 if key in ("xx", "xy", "yy") else 2)
            for key, column in columns.items()
        }
        cursors.append({"name": name, "label": label, "colour": colour, **rounded})
    return cursors
