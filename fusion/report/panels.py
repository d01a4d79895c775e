"""The report's panels over time: one quantity each, with its bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go

from stario.fusion.report.series import Series
from stario.fusion.state import Innovations
from stario.sequences.arrays import evenly_spaced, interpolated
from stario.sequences.drawing.figures import TRACK_STYLES, split_at_gaps, split_at_nan
from stario.sequences.sequence import BoolArray, FloatArray

INK, GRID, FAINT = "#222222", "#E3E6EA", "#767676"
_AXIS_LOOKS = (("x", "#0072B2", "solid"), ("y", "#D55E00", "dash"), ("z", "#009E73", "dot"))
TRUTH = "truth"
_DASHES = {"filtered": "dash", "network": "dot", "network_true_attitude": "dashdot"}
_MAX_INNOVATIONS = 1500
_MAX_PAUSE = 1.0
"""Longest time between updates [s] across which the innovations' band is drawn."""


class Panel(NamedTuple):
    """One row of the figure over time: title with unit, plotly traces, layout of its y axis."""

    title: str
    traces: list[go.Scatter]
    layout: dict[str, Any]


def style(name: str) -> tuple[str, str, str]:
    """Return label, colour and dash of a track."""
    if name == TRUTH:
        return TRUTH, "#000000", "solid"
    label, colour = TRACK_STYLES.get(name, (name, "#7F5539"))
    return label, colour, _DASHES.get(name, "solid")


def motion_panels(tracks: Mapping[str, Series], truth: Series | None) -> list[Panel]:
    """Return panels of height, speed and yaw, and of position error if there is ground truth."""
    shown = dict(tracks) if truth is None else {TRUTH: truth, **tracks}
    first = next(iter(shown.values()))
    height, speed, yaw = [], [], []
    for name, s in shown.items():
        height += _curve(name, s.time, s.position[:, 2], "m", s.height_sigma)
        speed += _curve(name, s.time, s.speed, "m/s", s.speed_sigma)
        yaw += _curve(name, s.time, s.yaw + _whole_turns(s, first), "deg", s.yaw_sigma)
    return [
        *([] if truth is None else [_error_panel(tracks, truth)]),
        _fitted("Height [m], band: 3 sigma", height),
        _fitted("Speed [m/s], band: 3 sigma", speed),
        _fitted("Yaw, unwrapped [deg], band: 3 sigma", yaw),
    ]


def bias_panels(name: str, series: Series) -> list[Panel]:
    """Return panels of both biases of a track by axis."""
    panels = []
    for title, unit, bias in (
        ("Gyroscope bias", "deg/s", series.gyro_bias),
        ("Accelerometer bias", "m/s^2", series.accel_bias),
    ):
        if bias is None:
            continue
        label, traces = style(name)[0], []
        for k, (axis, *look) in enumerate(_AXIS_LOOKS):
            value, sigma = bias[0][:, k], bias[1][:, k]
            traces += _curve(name, series.time, value, unit, sigma, (f"{label} {axis}", *look))
        words = f"{title} [{unit}]: x \u2014 y \u2013 \u2013 z \u00b7\u00b7\u00b7"
        panels.append(_fitted(words, traces))
    return panels


def innovation_panels(innovations: Innovations, start: float) -> list[Panel]:
    """Return panels of the innovations by axis with 3 sigma, and of their NIS.

    Args:
        innovations: innovations of an estimator's updates.
        start: time of the recording's first sample [s].
    """
    rows = evenly_spaced(len(innovations.time), _MAX_INNOVATIONS)
    rows = np.union1d(rows, np.flatnonzero(innovations.gated))  # draw all of these
    time, gated = innovations.time[rows] - start, innovations.gated[rows]
    panels = []
    for k, axis in enumerate("xyz"):
        residual, sigma = innovations.residual_W[rows, k], innovations.sigma[rows, k]
        ticks, edge = split_at_gaps(time, sigma[:, None], max_gap=_MAX_PAUSE)
        band = _band("innovation", ticks, 0.0 * edge[:, 0], edge[:, 0], FAINT)
        traces = [band, *_dots(time, residual, gated, "m")]
        panels.append(_fitted(f"Innovation {axis} [m], band: 3 sigma", traces))
    nis = np.maximum(innovations.nis[rows], 1e-2)
    traces = [*_dots(time, nis, gated, ""), _expected_nis(time[[0, -1]])]
    panels.append(Panel("NIS [1], dotted: expected 3", traces, {"type": "log", "dtick": 1}))
    return panels


def _curve(
    name: str,
    time: FloatArray,
    value: FloatArray,
    unit: str,
    sigma: FloatArray | None = None,
    look: tuple[str, ...] = (),
) -> list[go.Scatter]:
    """Return a line with hover text, and its 3-sigma band if there is a sigma."""
    label, colour, dash = look or style(name)
    line = go.Scatter(
        x=_rounded(time),
        y=_rounded(value),
        name=label,
        legendgroup=name,
        mode="lines",
        line={"color": colour, "dash": dash, "width": 1.6},
        customdata=None if sigma is None else _rounded(sigma),
        hovertemplate=f"{label} %{{y:.3g}} {unit}"
        + ("" if sigma is None else f", sigma %{{customdata:.2g}} {unit}")
        + "<extra></extra>",
    )
    return [line] if sigma is None else [_band(name, time, value, sigma, colour), line]


def _error_panel(tracks: Mapping[str, Series], truth: Series) -> Panel:
    traces = []
    for name, series in tracks.items():
        # Not a number in the truth's gaps, and beyond its ends.
        true_position = interpolated(series.time, truth.time, truth.position[:, :2])
        error = np.linalg.norm(series.position[:, :2] - true_position, axis=1)
        inside = (series.time >= truth.time[0]) & (series.time <= truth.time[-1])
        traces += _curve(name, series.time, np.where(inside, error, np.nan), "m")
    return Panel("Horizontal position error [m]", traces, {"rangemode": "tozero"})


def _band(
    group: str, time: FloatArray, value: FloatArray, sigma: FloatArray, colour: str
) -> go.Scatter:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    edges = split_at_nan(np.column_stack([time, value - 3.0 * sigma, value + 3.0 * sigma]))
    outlines = [np.vstack([part[:, [0, 1]], part[::-1, [0, 2]], [[np.nan] * 2]]) for part in edges]
    x, y = np.vstack([np.empty((0, 2)), *outlines]).T
    return go.Scatter(
        x=_rounded(x),
        y=_rounded(y),
        mode="lines",
        line={"width": 0},
        hoverinfo="skip",
        legendgroup=group,
        fill="toself",  # each stretch between gaps on its own; "tonexty" would fill the gaps
        fillcolor=f"rgba({red},{green},{blue},0.16)",
    )


def _dots(time: FloatArray, value: FloatArray, gated: BoolArray, unit: str) -> list[go.Scatter]:
    marker_styles: Sequence[tuple[Any, str, dict[str, Any]]] = (
        (~gated, "used", {"color": "#0072B2", "size": 3}),
        (gated, "gated", {"color": "#D55E00", "size": 7, "symbol": "x-thin-open"}),
    )
    return [
        go.Scatter(
            x=_rounded(time[rows]),
            y=_rounded(value[rows]),
            name=name,
            mode="markers",
            marker=marker,
            hovertemplate=f"{name} %{{y:.3g}} {unit}<extra></extra>",
        )
        for rows, name, marker in marker_styles
        if rows.any()
    ]


def _expected_nis(ends: FloatArray) -> go.Scatter:
    return go.Scatter(
        x=_rounded(ends),
        y=[3.0, 3.0],
        name="expected 3",
        mode="lines",
        line={"color": INK, "dash": "dot", "width": 1.2},
        hoverinfo="skip",
    )


def _fitted(title: str, traces: list[go.Scatter]) -> Panel:
    """Return a panel that fits all curves, and the bands except for brief wide parts."""
    curves = np.concatenate([t.y for t in traces if t.hoverinfo != "skip"])
    bands = np.concatenate([[np.nan], *(t.y for t in traces if t.hoverinfo == "skip")])
    low, high = np.nanmin(curves), np.nanmax(curves)
    if np.isfinite(bands).any():
        inner = np.nanpercentile(bands, [2.5, 97.5])
        low, high = min(low, inner[0]), max(high, inner[1])
    margin = 0.06 * max(float(high - low), 1e-3)
    return Panel(title, traces, {"range": [float(low - margin), float(high + margin)]})


def _whole_turns(series: Series, reference: Series) -> float:
    """Return the whole turns [deg] that bring a yaw nearest to a reference at common times."""
    expected = np.interp(series.time, reference.time, reference.yaw, np.nan, np.nan)
    off = series.yaw - expected
    known = off[np.isfinite(off)]
    return -360.0 * float(np.round(np.median(known) / 360.0)) if len(known) else 0.0


def _rounded(values: FloatArray) -> FloatArray:
    """Return values rounded to screen precision, to keep the file small."""
    return np.round(values, 5).astype(np.float32)
