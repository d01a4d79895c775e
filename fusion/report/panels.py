"""The report's panels over time: one quantity each, with its bands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import plotly.graph_objects as go

from stario.fusion.floors import FloorChange
from stario.fusion.report.series import Series
from stario.fusion.state import Innovations
from stario.sequences.arrays import evenly_spaced, interpolated
from stario.sequences.drawing.figures import (
    BROWN,
    DASHES,
    TRACK_STYLES,
    split_at_gaps,
    split_at_nan,
)
from stario.sequences.sequence import BoolArray, FloatArray

INK, GRID, FAINT = "#222222", "#E3E6EA", "#767676"
TRUTH = "truth"
_MAX_INNOVATIONS = 600
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
    tracks: Mapping[str, Series],
    truth: Series | None,
    main: str,
    floors: Sequence[FloorChange] = (),
) -> list[Panel]:
    """Return panels of height, speed and yaw, and of position error if there is ground truth.

    The main track has bands; more of them on one another would show none.

    Args:
        tracks: by name.
        truth: ground truth.
        main: name of the main track.
        floors: its changes of floor, in the time of the series.
    """
    shown = dict(tracks) if truth is None else {TRUTH: truth, **tracks}
    first = next(iter(shown.values()))
    height, speed, yaw = [], [], []
    for name, s in shown.items():
        sigmas = (s.height_sigma, s.speed_sigma, s.yaw_sigma) if name == main else (None,) * 3
        height += _curve(name, s.time, s.position[:, 2], "m", sigmas[0])
        speed += _curve(name, s.time, s.speed, "m/s", sigmas[1], lowest=0.0)
        yaw += _curve(name, s.time, s.yaw + _whole_turns(s, first), "deg", sigmas[2])
    height += _floor_lines(tracks[main], floors)
    return [
        *([] if truth is None else [_error_panel(tracks, truth)]),
        _fitted("Height [m], band: 3 sigma", height),
        _fitted("Speed [m/s], band: 3 sigma", speed),
        _fitted("Yaw, unwrapped [deg], band: 3 sigma", yaw),
    ]


def bias_panels(name: str, series: Series) -> list[Panel]:
    """Return a panel for each axis of both biases of a track; those of one bias share limits."""
    panels = []
    for title, unit, bias in (
        ("Gyroscope bias", "deg/s", series.gyro_bias),
        ("Accelerometer bias", "m/s^2", series.accel_bias),
    ):
        if bias is None:
            continue
        axes = [_curve(name, series.time, bias[0][:, k], unit, bias[1][:, k]) for k in range(3)]
        limits = _fitted("", [trace for traces in axes for trace in traces]).layout
        panels += [
            Panel(f"{title} {axis} [{unit}], band: 3 sigma", traces, limits, LOW_HEIGHT)
            for axis, traces in zip("xyz", axes, strict=True)
        ]
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
        band = _band("innovation", ticks, -3.0 * edge[:, 0], 3.0 * edge[:, 0], FAINT)
        traces = [band, *_dots(time, residual, gated, "m")]
        panel = _fitted(f"Innovation {axis} [m], band: 3 sigma", traces)
        panels.append(panel._replace(height=LOW_HEIGHT))
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
    lowest: float = -np.inf,
) -> list[go.Scatter]:
    """Return a line with hover text, and its 3-sigma band above `lowest` if there is a sigma."""
    label, colour, dash = style(name)
    rows = np.union1d(evenly_spaced(len(time), _MAX_POINTS), np.flatnonzero(np.isnan(value)))
    time, value = time[rows], value[rows]
    line = go.Scatter(
        x=numbers(time, 2),
        y=numbers(value),
        name=label,
        legendgroup=name,
        mode="lines",
        line={"color": colour, "dash": dash, "width": 1.6},
        hovertemplate=f"{label} %{{y:.3g}} {unit}<extra></extra>",
    )
    if sigma is None:
        return [line]
    line.customdata = numbers(sigma[rows])
    line.hovertemplate = (
        f"{label} %{{y:.3g}} {unit}, sigma %{{customdata:.2g}} {unit}<extra></extra>"
    )
    low = np.maximum(value - 3.0 * sigma[rows], lowest)
    return [_band(name, time, low, value + 3.0 * sigma[rows], colour), line]


def _floor_lines(series: Series, floors: Sequence[FloorChange]) -> list[go.Scatter]:
    """Return a dotted line along each stay on a floor, with its number; the first says of what."""
    if not floors:
        return []
    starts = [float(series.time[0]), *(change.stop for change in floors)]
    stops = [*(change.start for change in floors), float(series.time[-1])]
    lines: list[go.Scatter] = []
    for start, stop, floor in zip(starts, stops, [0, *(c.after for c in floors)], strict=True):
        inside = (series.time >= start) & (series.time <= stop)
        if not inside.any():
            continue
        level = float(np.nanmedian(series.position[inside, 2]))
        lines.append(
            go.Scatter(
                x=[start, stop],
                y=[level, level],
                mode="lines+text",
                text=[str(floor) if lines else f"floor {floor}"],
                textposition="top right",
                line={"color": FAINT, "dash": "dot", "width": 1},
                hoverinfo="skip",
            )
        )
    return lines


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
    group: str, time: FloatArray, low: FloatArray, high: FloatArray, colour: str
) -> go.Scatter:
    red, green, blue = (int(colour[k : k + 2], 16) for k in (1, 3, 5))
    edges = split_at_nan(np.column_stack([time, low, high]))
    edges = [part[evenly_spaced(len(part), _MAX_POINTS // 2)] for part in edges]
    outlines = [np.vstack([part[:, [0, 1]], part[::-1, [0, 2]], [[np.nan] * 2]]) for part in edges]
    x, y = np.vstack([np.empty((0, 2)), *outlines]).T
    return go.Scatter(
        x=numbers(x, 2),
        y=numbers(y),
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
            x=numbers(time[rows], 2),
            y=numbers(value[rows]),
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
        x=numbers(ends, 2),
        y=[3.0, 3.0],
        name="expected 3",
        mode="lines",
        line={"color": INK, "dash": "dot", "width": 1.2},
        hoverinfo="skip",
    )


def _fitted(title: str, traces: list[go.Scatter]) -> Panel:
    """Return a panel that fits all curves, and the bands except for brief wide parts."""
    drawn = [(t.hoverinfo == "skip", np.asarray(t.y, dtype=float)) for t in traces]
    curves = np.concatenate([y for is_band, y in drawn if not is_band])
    bands = np.concatenate([[np.nan], *(y for is_band, y in drawn if is_band)])
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


def numbers(values: FloatArray, digits: int = 4) -> list[float | None]:
    """Return values as rounded for the screen, None for NaN: as text they need little room."""
    return [value if value == value else None for value in np.round(values, digits).tolist()]
