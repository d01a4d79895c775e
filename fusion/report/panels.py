"""The report's panels over time: one quantity each, with its bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from numpy.typing import ArrayLike

from stario.fusion.report.background import INK
from stario.fusion.values.floors import FloorChange
from stario.fusion.values.state import Innovations
from stario.sequences.arrays import evenly_spaced, interpolated
from stario.sequences.drawing.figures import (
    BLUE,
    BROWN,
    DASHES,
    RED,
    TRACK_STYLES,
    split_at_gaps,
    split_at_nan,
)
from stario.sequences.sequence import BoolArray, FloatArray

GRID, FAINT = "#E3E6EA", "#767676"
MAIN, TRUTH = "track", "truth"
"""Names of the track that has bands and ellipses, and of the ground truth."""

INNOVATION = "innovation"
_SILENT = {"mode": "lines", "hoverinfo": "skip"}
_MAX_POINTS = 600
"""Maximum number of points of a curve: a panel is as many pixels wide, and the file stays small."""

PANEL_HEIGHT, LOW_HEIGHT = 144, 84
"""Heights of a panel [px]: of its own, and of one of three axes."""

_MAX_PAUSE = 1.0
"""Longest time between updates [s] across which the innovations' band is drawn."""


class Panel(NamedTuple):
    """A row of the figure over time: title with unit, traces, y axis and height [px]."""

    title: str
    traces: list[go.Scatter]
    layout: dict[str, Any]
    height: int = PANEL_HEIGHT


def style(name: str) -> tuple[str, str, str]:
    """Return label, colour and dash of a track, as lengths of line and gap."""
    if name == TRUTH:
        return TRUTH, "#000000", "solid"
    label, colour, dash = TRACK_STYLES.get(name, (name, BROWN, "dash"))
    return label, colour, ",".join(f"{2.0 * length:g}px" for length in DASHES[dash]) or "solid"


def motion_panels(
    tracks: Mapping[str, pd.DataFrame],
    truth: pd.DataFrame | None,
    floors: Sequence[FloorChange] = (),
) -> list[Panel]:
    """Return panels of height, speed and yaw, and of position error if there is ground truth.

    The main track has bands, more of which on one another would show none, and its floors.
    """
    shown = dict(tracks) if truth is None else {TRUTH: truth, **tracks}
    first = next(iter(shown.values()))
    height, speed, yaw = [], [], []
    for name, s in shown.items():
        sigma = s if name == MAIN else {}
        height += _curve(name, s.z, "m", sigma.get("sigma z"))
        speed += _curve(name, s.speed, "m/s", sigma.get("sigma speed"), lowest=0.0)
        yaw += _curve(name, s.yaw + _whole_turns(s, first), "deg", sigma.get("sigma yaw"))
    height += _floor_lines(tracks[MAIN].z, floors)
    return [
        *([] if truth is None else [_error_panel(tracks, truth)]),
        _fitted("Height [m], band: 3 sigma", height),
        _fitted("Speed [m/s], band: 3 sigma", speed),
        _fitted("Yaw, unwrapped [deg], band: 3 sigma", yaw),
    ]


def bias_panels(series: pd.DataFrame) -> list[Panel]:
    """Return a panel per axis of the main track's biases; those of one bias share limits."""
    panels = []
    biases = ("Gyroscope bias", "gyro", "deg/s"), ("Accelerometer bias", "accel", "m/s^2")
    for title, name, unit in biases:
        if f"{name} x" not in series:
            continue
        curves = [
            _curve(MAIN, series[f"{name} {axis}"], unit, series[f"sigma {name} {axis}"])
            for axis in "xyz"
        ]
        limits = _fitted("", [*chain(*curves)]).layout
        panels += [
            Panel(f"{title} {axis} [{unit}], band: 3 sigma", traces, limits, LOW_HEIGHT)
            for axis, traces in zip("xyz", curves, strict=True)
        ]
    return panels


def innovation_panels(innovations: Innovations, start: float) -> list[Panel]:
    """Return panels of the innovations by axis with 3 sigma, and of their NIS, from `start` [s]."""
    rows = evenly_spaced(len(innovations.time), _MAX_POINTS)
    rows = np.union1d(rows, np.flatnonzero(innovations.gated))  # draw all of these
    time, gated = innovations.time[rows] - start, innovations.gated[rows]
    panels = []
    for k, axis in enumerate("xyz"):
        residual, sigma = innovations.residual_W[rows, k], innovations.sigma[rows, k]
        ticks, edge = split_at_gaps(time, 3.0 * sigma, max_gap=_MAX_PAUSE)
        traces = [_band(INNOVATION, ticks, -edge, edge, FAINT)]
        traces += _dots(time, residual, gated, "m")
        panel = _fitted(f"Innovation {axis} [m], band: 3 sigma", traces)
        panels.append(panel._replace(height=LOW_HEIGHT))
    nis = np.maximum(innovations.nis[rows], 1e-2)
    dotted = {"color": INK, "dash": "dot", "width": 1.2}
    expected = scatter(INNOVATION, time[[0, -1]], np.full(2, 3.0), name="expected 3", line=dotted)
    traces = [*_dots(time, nis, gated, ""), expected]
    panels.append(Panel("NIS [1], dotted: expected 3", traces, {"type": "log", "dtick": 1}))
    return panels


def scatter(
    group: str, x: ArrayLike, y: ArrayLike, *, digits: int = 4, **settings: Any
) -> go.Scatter:
    """Return a trace of a track's group: a line without hover text, but for other settings.

    Its x are rounded to two digits, its y as asked: as text short numbers need little room.
    """
    usual = {"mode": "lines"} if "hovertemplate" in settings else _SILENT
    xy = {"x": numbers(x, 2), "y": numbers(y, digits)}
    return go.Scatter(legendgroup=group, **xy, **usual | settings)


def marks(
    group: str, xy: ArrayLike, marker: Mapping[str, Any], digits: int = 2, **settings: Any
) -> go.Scatter:
    """Return markers of a track's group at x and y (2, n), rounded as in `scatter`."""
    x, y = np.asarray(xy)
    return scatter(group, x, y, digits=digits, **{"mode": "markers", "marker": marker, **settings})


def _curve(
    name: str,
    values: pd.Series,
    unit: str,
    sigma: pd.Series | None = None,
    lowest: float = -np.inf,
) -> list[go.Scatter]:
    """Return a line with hover text, and its 3-sigma band above `lowest` if there is a sigma."""
    label, colour, dash = style(name)
    rows = np.union1d(evenly_spaced(len(values), _MAX_POINTS), np.flatnonzero(values.isna()))
    time, value = values.index.to_numpy()[rows], values.to_numpy()[rows]
    stroke = {"color": colour, "dash": dash, "width": 1.6}
    line = scatter(name, time, value, name=label, line=stroke, hovertemplate="")
    hover = f"{label} %{{y:.3g}} {unit}"
    if sigma is None:
        return [line.update(hovertemplate=f"{hover}<extra></extra>")]
    one = sigma.to_numpy()[rows]
    hover = f"{hover}, sigma %{{customdata:.2g}} {unit}<extra></extra>"
    line.update(hovertemplate=hover, customdata=numbers(one))
    low, high = np.maximum(value - 3.0 * one, lowest), value + 3.0 * one
    return [_band(name, time, low, high, colour), line]


def _floor_lines(height: pd.Series, floors: Sequence[FloorChange]) -> list[go.Scatter]:
    """Return a dotted line along each stay on a floor, with its number; the first says of what."""
    if not floors:
        return []
    starts = [height.index[0], *(change.stop for change in floors)]
    stops = [*(change.start for change in floors), height.index[-1]]
    lines: list[go.Scatter] = []
    for start, stop, floor in zip(starts, stops, [0, *(c.after for c in floors)], strict=True):
        inside = height[(height.index >= start) & (height.index <= stop)]
        if inside.empty:
            continue
        text = [str(floor) if lines else f"floor {floor}"]
        words: dict[str, Any] = {"mode": "lines+text", "text": text, "textposition": "top right"}
        words["line"] = {"color": FAINT, "dash": "dot", "width": 1}
        lines.append(scatter(MAIN, [start, stop], [inside.median()] * 2, **words))
    return lines


def _error_panel(tracks: Mapping[str, pd.DataFrame], truth: pd.DataFrame) -> Panel:
    traces = []
    for name, series in tracks.items():
        # Not a number in the truth's gaps, and beyond its ends.
        true_xy = interpolated(series.index, truth.index, truth[["x", "y"]].to_numpy())
        error = np.hypot(*(series[["x", "y"]] - true_xy).to_numpy().T)
        inside = (series.index >= truth.index[0]) & (series.index <= truth.index[-1])
        traces += _curve(name, pd.Series(error, series.index).where(inside), "m")
    return Panel("Horizontal position error [m]", traces, {"rangemode": "tozero"})


def _band(
    group: str, time: FloatArray, low: FloatArray, high: FloatArray, colour: str
) -> go.Scatter:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    edges = split_at_nan(np.column_stack([time, low, high]))
    edges = [part[evenly_spaced(len(part), _MAX_POINTS // 2)] for part in edges]
    outlines = [np.vstack([part[:, [0, 1]], part[::-1, [0, 2]], [[np.nan] * 2]]) for part in edges]
    x, y = np.vstack([np.empty((0, 2)), *outlines]).T
    # Each stretch between gaps is filled on its own; "tonexty" would fill the gaps.
    filling: dict[str, Any] = {"fill": "toself", "fillcolor": f"rgba({red},{green},{blue},0.16)"}
    return scatter(group, x, y, line={"width": 0}, **filling)


def _dots(time: FloatArray, value: FloatArray, gated: BoolArray, unit: str) -> list[go.Scatter]:
    used, weakened = {"color": BLUE, "size": 3}, {"color": RED, "size": 7, "symbol": "x-thin-open"}
    traces = []
    for rows, name, marker in ((~gated, "used", used), (gated, "gated", weakened)):
        if rows.any():
            hover = f"{name} %{{y:.3g}} {unit}<extra></extra>"
            xy = time[rows], value[rows]
            traces.append(marks(INNOVATION, xy, marker, 4, name=name, hovertemplate=hover))
    return traces


def _fitted(title: str, traces: list[go.Scatter]) -> Panel:
    """Return a panel that fits all curves, and the bands except for brief wide parts."""
    drawn = [(t.hoverinfo == "skip", np.asarray(t.y, dtype=float)) for t in traces]
    curves = np.concatenate([y for is_band, y in drawn if not is_band])
    bands = np.concatenate([[np.nan], *(y for is_band, y in drawn if is_band)])
    ends = [float(np.nanmin(curves)), float(np.nanmax(curves))]
    if np.isfinite(bands).any():
        ends += np.nanpercentile(bands, [2.5, 97.5]).tolist()
    margin = 0.06 * max(max(ends) - min(ends), 1e-3)
    return Panel(title, traces, {"range": [min(ends) - margin, max(ends) + margin]})


def _whole_turns(series: pd.DataFrame, reference: pd.DataFrame) -> float:
    """Return the whole turns [deg] that bring a yaw nearest to a reference at common times."""
    expected = np.interp(series.index, reference.index, reference.yaw, np.nan, np.nan)
    off = (series.yaw - expected).median()
    return 0.0 if np.isnan(off) else -360.0 * float(np.round(off / 360.0))


def numbers(values: ArrayLike, digits: int = 4) -> list[float | None]:
    """Return values as rounded for the screen, None for NaN: as text they need little room."""
    rounded = np.round(np.asarray(values, dtype=np.float64), digits).tolist()
    return [value if value == value else None for value in rounded]
