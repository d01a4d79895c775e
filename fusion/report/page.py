"""The report as one self-contained HTML file: figures, time cursor, health in words, table."""

from __future__ import annotations

import base64
import gzip
import json
import logging
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from jinja2 import Environment, FileSystemLoader
from plotly.offline import get_plotlyjs

from stario.fusion.evaluation.compare import METRIC_TITLES, Comparison, Metrics
from stario.fusion.evaluation.known_positions import shown_positions
from stario.fusion.evaluation.text import shown_value, without_unit
from stario.fusion.report.figures import map_figure, time_figure
from stario.fusion.report.panels import (
    MAIN,
    TRUTH,
    bias_panels,
    innovation_panels,
    motion_panels,
    numbers,
    style,
)
from stario.fusion.report.series import track_series
from stario.fusion.values.health import Health
from stario.fusion.values.state import Track
from stario.sequences.accuracy.metrics import moved
from stario.sequences.drawing.figures import clock, distance
from stario.sequences.drawing.text_table import figure
from stario.sequences.files import atomic_write
from stario.sequences.geodesy import turned
from stario.sequences.sequence import ImuSequence

log = logging.getLogger(__name__)

_DIGITS = {"ate_m": 2, "ate_fit_m": 2, "rte_m": 2, "aye_rad": 1, "nees_median": 1, "nis_mean": 1}
"""Decimals of the table's columns."""

_TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent), autoescape=True, trim_blocks=True
)


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
    sequence, track, truth = found.sequence, found.tracks[MAIN], found.sequence.truth
    start = float(sequence.time[np.isfinite(sequence.time)][0])
    # Beside a true track, those are drawn in its frame, whose place is not known.
    place = found.georeference if truth is None else None
    if tiles and place is None:
        why = (
            "beside a true track" if truth else "where on the earth it lies is not known: --origin"
        )
        log.warning("%s: no tiles in the report (%s)", sequence.name, why)
    yaw = 0.0 if place is None else place.yaw
    series = {
        name: track_series(moved(aligned, yaw, np.zeros(3), np.zeros(3)), start, found.tracks[name])
        for name, aligned in found.aligned().items()
    }
    true_series = None if truth is None else track_series(truth, start)
    # Dead reckoning is kilometres off within a minute: no axis fits it and the others.
    drawn = {name: s for name, s in series.items() if name != "dead_reckoning"}
    mapped = drawn if truth is None else series
    health, innovations = track.health or Health(), track.innovations
    floors = [c._replace(start=c.start - start, stop=c.stop - start) for c in health.floors]
    panels = motion_panels(drawn, true_series, floors) + bias_panels(series[MAIN])
    if innovations is not None and len(innovations.time):
        panels += innovation_panels(innovations, start)
    known = shown_positions(sequence, track)
    if known is not None:
        known = replace(known, position_W=turned(known.position_W, yaw))
    corrections = [(t - start, m, turn, why) for t, m, turn, why in health.corrections]
    north_up = place and replace(place, yaw=0.0)
    seen_from_above = map_figure(mapped, true_series, known, corrections, north_up, tiles)
    data = {
        "map": json.loads(seen_from_above.to_json()),
        "time": json.loads(time_figure(panels).to_json()),
        "cursors": [_cursor(name, drawn[name]) for name in sorted(drawn, key=MAIN.__ne__)],
    }
    page = _TEMPLATES.get_template("report.html").render(
        title=sequence.name,
        summary=sequence.summary().removeprefix(f"{sequence.name}: "),
        facts=_facts(sequence, track, series[MAIN]),
        legend={name: style(name) for name in ([] if truth is None else [TRUTH]) + [*mapped]},
        known=known and known.kind,
        corrections=len(corrections),
        verdict=found.verdict,
        titles={key: METRIC_TITLES[key] for key in ([] if truth is None else _DIGITS)},
        metrics={style(name)[0]: [*_cells(m)] for name, m in found.metrics.items()},
        words={key: without_unit(words) for key, words in found.words.items()},
        data=_packed(json.dumps(data, separators=(",", ":"))),
        plotly=_packed_plotly(),
    )
    with atomic_write(path) as file:
        file.write(page)
    return path


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


def _facts(sequence: ImuSequence, track: Track, series: pd.DataFrame) -> Iterator[tuple[str, str]]:
    """Yield what heads the page: figures with their units, and what they are."""
    yield clock(sequence.duration), "recorded (min:s)"
    yield clock(track.time[-1] - track.time[0]), "tracked (min:s)"
    yield distance(track.trajectory.path_length()), "estimated path length"
    yield f"{len(sequence) / max(sequence.duration, 1e-9):.0f} Hz", "sampling rate"
    if "sigma yaw" in series:
        yield f"{series.sigma.iloc[-1]:.2f} m", "final position, 1 sigma"
        yield f"{series['sigma yaw'].iloc[-1]:.1f} deg", "final yaw, 1 sigma"
    end = track.trajectory.position_W[-1] - track.trajectory.position_W[0]
    yield f"{float(np.hypot(*end[:2])):.1f} m", "between start and end"


def _cells(metrics: Metrics) -> Iterator[str]:
    """Yield a track's figures; of a large one the decimals say nothing, and a phone is narrow."""
    for key, digits in _DIGITS.items():
        value = shown_value(metrics, key)
        yield figure(value, f".{0 if abs(value or 0.0) >= 100.0 else digits}f")


def _cursor(name: str, series: pd.DataFrame) -> dict[str, Any]:
    """Return what the slider moves: a track's position, ellipse and values."""
    label, colour, _ = style(name)
    columns = [key for key in ("x", "y", "speed", "yaw", "xx", "xy", "yy") if key in series]
    shown = {key: numbers(series[key], 3 if len(key) == 2 else 2) for key in columns}
    times = numbers(series.index, 2)
    return {"name": name, "label": label, "colour": colour, "t": times, **shown}
