"""The report's two plotly figures: the map, and all panels over one time axis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from stario.fusion.filter.corrections import Correction
from stario.fusion.report.background import add_north, add_tiles
from stario.fusion.report.panels import FAINT, GRID, INK, TRUTH, Panel, numbers, style
from stario.fusion.report.series import Series, ellipse
from stario.sequences.arrays import evenly_spaced, interpolated
from stario.sequences.drawing.figures import clock
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import FloatArray, PositionTrack

_ELLIPSES = 8
"""Number of ellipses drawn along the main track."""

_ARROW_SECONDS, _MAX_ARROWS = 30.0, 24
"""Time between the main track's arrows [s], and their maximum number."""

_MIN_ARROW_STEP = 0.2
"""Distance walked in the two seconds around an arrow [m] below which there is no direction."""

_FEW_POSITIONS = 30
"""Number of known positions above which they are drawn small: each is then of little interest."""

_LAYOUT = {
    "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "showlegend": False,
}
_AXIS = {
    "gridcolor": GRID,
    "zeroline": False,
    "linecolor": FAINT,
    "showline": True,
    "ticks": "outside",
    "tickcolor": FAINT,
    "ticklen": 4,
}
_LEFT = 58
"""Left margin [px]: enough for the panels' labels, and all that a phone can spare."""


def map_figure(
    tracks: Mapping[str, Series],
    truth: Series | None,
    known: PositionTrack | None,
    main: str,
    corrections: Sequence[Correction] = (),
    place: Georeference | None = None,
    tiles: str = "",
) -> go.Figure:
    """Draw all tracks from above on equal axes.

    Args:
        tracks: tracks by name.
        truth: ground truth in the same frame, or None.
        known: positions or waypoints in the same frame, if there is no true track, or None.
        main: name of the track drawn with 3-sigma ellipses, arrows and times.
        corrections: time since the first sample [s], distance [m], turn [rad] and cause of the main
            track's large corrections.
        place: where on the earth the frame lies, with x east; None where that is unknown.
        tiles: address of a map server's tiles as the background, empty for none.
    """
    frame = _frame(tracks, truth, known)
    outlines = _outlines(tracks[main], 0.4 * float(np.ptp(frame, axis=1).max()))
    traces = [
        *([] if known is None else [_known(known)]),
        *([] if truth is None else [_path(TRUTH, truth, 3.0)]),
        _ellipses(main, outlines),
        *(_path(name, series, 2.0, place) for name, series in tracks.items()),
        *(_ends(name, series) for name, series in tracks.items() if name != main),
        *([] if truth is None else [_ends(TRUTH, truth)]),
        _arrows(main, tracks[main]),
        _ends(main, tracks[main], timed=True),
        *([_corrections(main, tracks[main], corrections)] if corrections else []),
    ]
    figure = go.Figure(traces)
    figure.update_layout(
        **_LAYOUT,
        # The toolbar lies in the upper margin.
        margin={"l": _LEFT, "r": 12, "t": 34, "b": 44},
        hovermode="closest",
        dragmode="pan",
    )
    x, y = _limits(np.vstack([frame.T, outlines]))
    titles = ("x [m]", "y [m]") if place is None else ("east [m]", "north [m]")
    figure.update_xaxes(title=_title(titles[0]), range=x, **_AXIS)
    figure.update_yaxes(title=_title(titles[1]), range=y, scaleanchor="x", scaleratio=1, **_AXIS)
    if place is not None:
        add_north(figure)
        if tiles:
            add_tiles(figure, place, tiles)
    return figure


def time_figure(panels: Sequence[Panel]) -> go.Figure:
    """Stack all panels over one time axis."""
    count, gap = len(panels), 46
    heights = [panel.height for panel in panels]
    height = sum(heights) + gap * (count - 1) + 96
    figure = make_subplots(
        rows=count,
        cols=1,
        shared_xaxes=True,
        row_heights=heights,
        vertical_spacing=gap / (height - 96),
        subplot_titles=[panel.title for panel in panels],
    )
    for row, panel in enumerate(panels, start=1):
        for trace in panel.traces:
            figure.add_trace(trace, row=row, col=1)
        figure.update_yaxes(row=row, col=1, **panel.layout)
    figure.update_xaxes(showticklabels=True, **_AXIS)
    figure.update_yaxes(**_AXIS)
    figure.update_xaxes(title=_title("time since the first sample [s]"), row=count)
    # Titles start at the panels' left edge: on a phone there is no room around a centred one.
    figure.update_annotations(x=0.0, xanchor="left", font={"size": 13, "color": INK})
    figure.update_layout(
        **_LAYOUT,
        height=height,
        margin={"l": _LEFT, "r": 12, "t": 52, "b": 44},
        hovermode="x",
        dragmode="zoom",
    )
    return figure


def _title(text: str) -> dict[str, object]:
    return {"text": text, "standoff": 6, "font": {"size": 13}}


def _path(name: str, series: Series, width: float, place: Georeference | None = None) -> go.Scatter:
    label, colour, dash = style(name)
    sigma = series.horizontal_sigma
    columns = [series.time, series.speed, *([] if sigma is None else [sigma])]
    text = "" if sigma is None else "<br>sigma %{customdata[2]:.2f} m"
    table = np.column_stack(columns).round(2)
    if place is not None:
        k = table.shape[1]
        text += f"<br>%{{customdata[{k}]:.6f}}, %{{customdata[{k + 1}]:.6f}}"
        latlon = place.latlon_deg(np.nan_to_num(series.position)).round(7)
        table = np.column_stack([table, latlon])
    return go.Scatter(
        x=numbers(series.position[:, 0], 2),
        y=numbers(series.position[:, 1], 2),
        name=label,
        legendgroup=name,
        mode="lines",
        line={"color": colour, "dash": dash, "width": width},
        customdata=table.tolist(),
        hovertemplate=f"<b>{label}</b> at %{{customdata[0]:.1f}} s{text}"
        "<br>speed %{customdata[1]:.2f} m/s<br>x %{x:.2f} m, y %{y:.2f} m<extra></extra>",
    )


def _outlines(series: Series, largest: float) -> FloatArray:
    """Return some outlines (n, 2) [m], separated by NaN, of ellipses along a track.

    Semi-axes beyond `largest` [m] are too large for the map: they appear at the slider's time only.
    """
    parts = [np.full((1, 2), np.nan)]
    if series.position_covariance is not None:
        for k in _shown_rows(series, _ELLIPSES):
            outline = ellipse(series.position_covariance[k])
            if np.linalg.norm(outline, axis=1).max() <= largest:
                parts += [series.position[k, :2] + outline, parts[0]]
    return np.vstack(parts)


def _ellipses(name: str, outlines: FloatArray) -> go.Scatter:
    return go.Scatter(
        x=numbers(outlines[:, 0], 2),
        y=numbers(outlines[:, 1], 2),
        name="3 sigma",
        legendgroup=name,
        mode="lines",
        line={"color": style(name)[1], "width": 0.8},
        opacity=0.55,
        hoverinfo="skip",
    )


def _arrows(name: str, series: Series) -> go.Scatter:
    """Draw arrowheads along a track where it moves."""
    duration = float(series.time[-1] - series.time[0])
    rows = _shown_rows(series, min(_MAX_ARROWS, int(duration / _ARROW_SECONDS)) + 2)[1:-1]
    behind, ahead = (
        interpolated(series.time[rows] + seconds, series.time, series.position[:, :2])
        for seconds in (-1.0, 1.0)
    )
    step = ahead - behind
    moving = np.linalg.norm(step, axis=1) > _MIN_ARROW_STEP
    rows, step = rows[moving], step[moving]
    return go.Scatter(
        x=numbers(series.position[rows, 0], 3),
        y=numbers(series.position[rows, 1], 3),
        legendgroup=name,
        mode="markers",
        marker={
            "symbol": "arrow",
            "size": 13,
            "angle": np.degrees(np.arctan2(step[:, 0], step[:, 1])).round(1).tolist(),
            "color": style(name)[1],
            "line": {"color": "white", "width": 1},
        },
        hoverinfo="skip",
    )


def _ends(name: str, series: Series, timed: bool = False) -> go.Scatter:
    """Mark the start with an open circle and the end with a square, on request with their times."""
    rows = _shown_rows(series, 2)[[0, -1]]
    ends = series.position[rows, :2]
    return go.Scatter(
        x=numbers(ends[:, 0], 3),
        y=numbers(ends[:, 1], 3),
        legendgroup=name,
        mode="markers+text" if timed else "markers",
        text=[clock(time) for time in series.time[rows]],
        textposition=["bottom right", "top left"],
        marker={
            "symbol": ["circle-open", "square"],
            "size": 9,
            "color": style(name)[1],
            "line": {"width": 2},
        },
        hoverinfo="skip",
    )


def _corrections(name: str, series: Series, corrections: Sequence[Correction]) -> go.Scatter:
    """Mark where a track was corrected, with time, size and cause."""
    times = np.array([time for time, *_ in corrections])
    position = interpolated(times, series.time, series.position[:, :2])
    words = [
        f"{time:.1f} s: corrected by {metres:.1f} m, {math.degrees(turn):.0f} deg<br>{cause}"
        for time, metres, turn, cause in corrections
    ]
    return go.Scatter(
        x=numbers(position[:, 0], 2),
        y=numbers(position[:, 1], 2),
        legendgroup=name,
        name="corrected",
        mode="markers",
        marker={
            "symbol": "triangle-up",
            "size": 12,
            "color": "#F0E442",
            "line": {"color": "black", "width": 1.5},
        },
        text=words,
        hovertemplate="%{text}<extra></extra>",
    )


def _known(known: PositionTrack) -> go.Scatter:
    """Mark known positions, such as waypoints or satellite fixes, with crosses."""
    few = len(known) <= _FEW_POSITIONS
    return go.Scatter(
        x=numbers(known.position_W[:, 0], 3),
        y=numbers(known.position_W[:, 1], 3),
        name=known.kind,
        mode="markers",
        marker={
            "symbol": "x-thin-open",
            "color": INK if few else FAINT,
            "size": 10 if few else 5,
            "line": {"width": 2 if few else 1},
        },
        hovertemplate=f"{known.kind}: x %{{x:.2f}} m, y %{{y:.2f}} m, fitted to the track"
        "<extra></extra>",
    )


def _shown_rows(series: Series, most: int) -> NDArray[np.intp]:
    """Return up to `most` evenly spaced rows of those that are shown."""
    shown = np.flatnonzero(np.isfinite(series.position[:, 0]))
    return shown[evenly_spaced(len(shown), most)]


def _frame(
    tracks: Mapping[str, Series], truth: Series | None, known: PositionTrack | None
) -> FloatArray:
    """Return limits (2, 2) of x and y that fit known positions and all but dead reckoning."""
    bounded = [s for name, s in tracks.items() if name != "dead_reckoning"]
    points = np.vstack([s.position[:, :2] for s in ([truth] if truth else []) + bounded])
    if truth is not None:  # a diverged track must not shrink the truth to a dot
        low, high = np.nanmin(truth.position, axis=0)[:2], np.nanmax(truth.position, axis=0)[:2]
        points = np.clip(points, low - (high - low).max(), high + (high - low).max())
    if known is not None:
        points = np.vstack([points, known.position_W[:, :2]])
    return np.stack([np.nanmin(points, axis=0), np.nanmax(points, axis=0)], axis=1)


def _limits(points: FloatArray) -> FloatArray:
    """Return limits (2, 2) of x and y with room around the points (n, 2) [m]."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    # At least a metre, lest the millimetres of a device at rest look like a walk.
    half = 0.5 * (high - low) + 0.06 * max(1.0, float((high - low).max()))
    half = np.maximum(half, 0.5)
    return np.stack([0.5 * (low + high) - half, 0.5 * (low + high) + half], axis=1)
