"""The report's two plotly figures: the map, and all panels over one time axis."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from stario.fusion.filter.corrections import Correction
from stario.fusion.report.background import INK, add_place
from stario.fusion.report.panels import FAINT, GRID, MAIN, TRUTH, Panel, marks, scatter, style
from stario.fusion.report.series import ellipse
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

_LEFT = 58
"""Left margin [px]: enough for the panels' labels, and all that a phone can spare."""

_AXIS = {
    "gridcolor": GRID,
    "zeroline": False,
    "linecolor": FAINT,
    "showline": True,
    "ticks": "outside",
    "tickcolor": FAINT,
    "ticklen": 4,
    "automargin": True,
    "title": {"standoff": 6, "font": {"size": 13}},
}
_LAYOUT = {
    "font": {"family": "system-ui, sans-serif", "size": 13, "color": INK},
    "paper_bgcolor": "white",
    "plot_bgcolor": "white",
    "showlegend": False,
    "hoverlabel": {"align": "left"},
    "template": {"layout": {"xaxis": _AXIS, "yaxis": _AXIS}},
}


def map_figure(
    tracks: Mapping[str, pd.DataFrame],
    truth: pd.DataFrame | None,
    known: PositionTrack | None,
    corrections: Sequence[Correction] = (),
    place: Georeference | None = None,
    tiles: str = "",
) -> go.Figure:
    """Draw all tracks from above on equal axes, the main one with ellipses, arrows and times.

    Args:
        tracks: tables of `series`, by name.
        truth: ground truth in the same frame, or None.
        known: positions or waypoints in the same frame, if there is no true track, or None.
        corrections: time since the first sample [s], distance [m], turn [rad] and cause of the main
            track's large corrections.
        place: where on the earth the frame lies, with x east; None where that is unknown.
        tiles: address of a map server's tiles as the background, empty for none.
    """
    main = tracks[MAIN]
    frame = _frame(tracks, truth, known)
    outlines = _outlines(main, 0.4 * float(np.ptp(frame, axis=1).max()))
    thin = {"color": style(MAIN)[1], "width": 0.8}
    traces = [
        *([] if known is None else [_known(known)]),
        *([] if truth is None else [_path(TRUTH, truth, 3.0)]),
        scatter(MAIN, *outlines.T, digits=2, name="3 sigma", line=thin, opacity=0.55),
        *(_path(name, series, 2.0, place) for name, series in tracks.items()),
        *(_ends(name, series) for name, series in tracks.items() if name != MAIN),
        *([] if truth is None else [_ends(TRUTH, truth)]),
        _arrows(main),
        _ends(MAIN, main),
        *([_corrections(main, corrections)] if corrections else []),
    ]
    x, y = _limits(np.vstack([frame.T, outlines]))
    titles = ("x [m]", "y [m]") if place is None else ("east [m]", "north [m]")
    figure = go.Figure(traces)
    figure.update_layout(
        **_LAYOUT,
        # The toolbar lies in the upper margin.
        margin={"l": _LEFT, "r": 12, "t": 34, "b": 44},
        hovermode="closest",
        dragmode="pan",
        xaxis={"title": {"text": titles[0]}, "range": x},
        yaxis={"title": {"text": titles[1]}, "range": y, "scaleanchor": "x", "scaleratio": 1},
    )
    if place is not None:
        add_place(figure, place, tiles)
    return figure


def time_figure(panels: Sequence[Panel]) -> go.Figure:
    """Stack all panels over one time axis."""
    gap, heights = 46, [panel.height for panel in panels]
    height = sum(heights) + gap * (len(panels) - 1) + 96
    figure = make_subplots(
        rows=len(panels),
        cols=1,
        shared_xaxes=True,
        row_heights=heights,
        vertical_spacing=gap / (height - 96),
        subplot_titles=[panel.title for panel in panels],
    )
    for row, panel in enumerate(panels, start=1):
        figure.add_traces(panel.traces, rows=row, cols=1)
        figure.update_yaxes(row=row, col=1, **panel.layout)
    figure.update_xaxes(showticklabels=True)
    figure.update_xaxes(title_text="time since the first sample [s]", row=len(panels))
    # Titles start at the panels' left edge: on a phone there is no room around a centred one.
    figure.update_annotations(x=0.0, xanchor="left", font={"size": 13, "color": INK})
    margin = {"l": _LEFT, "r": 12, "t": 52, "b": 44}
    figure.update_layout(**_LAYOUT, height=height, margin=margin, hovermode="x", dragmode="zoom")
    return figure


def _path(
    name: str, series: pd.DataFrame, width: float, place: Georeference | None = None
) -> go.Scatter:
    label, colour, dash = style(name)
    known = [key for key in ("speed", "sigma") if key in series]
    table = np.column_stack([series.index, series[known]]).round(2)
    text = "<br>sigma %{customdata[2]:.2f} m" if "sigma" in known else ""
    if place is not None:
        k = table.shape[1]
        text += f"<br>%{{customdata[{k}]:.6f}}, %{{customdata[{k + 1}]:.6f}}"
        latlon = place.latlon_deg(np.nan_to_num(series[["x", "y", "z"]])).round(7)
        table = np.column_stack([table, latlon])
    stroke = {"color": colour, "dash": dash, "width": width}
    hover = (
        f"<b>{label}</b> at %{{customdata[0]:.1f}} s{text}<br>speed %{{customdata[1]:.2f}} m/s"
        "<br>x %{x:.2f} m, y %{y:.2f} m<extra></extra>"
    )
    settings = {"name": label, "line": stroke, "customdata": table.tolist(), "hovertemplate": hover}
    return scatter(name, series.x, series.y, digits=2, **settings)


def _outlines(series: pd.DataFrame, largest: float) -> FloatArray:
    """Return some outlines (n, 2) [m], separated by NaN, of ellipses along a track.

    Semi-axes beyond `largest` [m] are too large for the map: they appear at the slider's time only.
    """
    parts = [np.full((1, 2), np.nan)]
    for _, row in _shown(series, _ELLIPSES).iterrows() if "xx" in series else ():
        outline = ellipse(row.xx, row.xy, row.yy)
        if np.linalg.norm(outline, axis=1).max() <= largest:
            parts += [row[["x", "y"]].to_numpy() + outline, parts[0]]
    return np.vstack(parts)


def _arrows(series: pd.DataFrame) -> go.Scatter:
    """Draw arrowheads along the main track where it moves."""
    count = min(_MAX_ARROWS, int((series.index[-1] - series.index[0]) / _ARROW_SECONDS))
    at = _shown(series, count + 2)[["x", "y"]].iloc[1:-1]
    behind, ahead = (
        interpolated(at.index + seconds, series.index, series[["x", "y"]].to_numpy())
        for seconds in (-1.0, 1.0)
    )
    step = ahead - behind
    moving = np.linalg.norm(step, axis=1) > _MIN_ARROW_STEP
    marker = {
        "symbol": "arrow",
        "size": 13,
        "angle": np.degrees(np.arctan2(step[moving, 0], step[moving, 1])).round(1).tolist(),
        "color": style(MAIN)[1],
        "line": {"color": "white", "width": 1},
    }
    return marks(MAIN, at[moving].to_numpy().T, marker)


def _ends(name: str, series: pd.DataFrame) -> go.Scatter:
    """Mark the start with an open circle, the end with a square; those of the main have times."""
    ends = _shown(series, 2).iloc[[0, -1]]
    marker: dict[str, Any] = {"symbol": ["circle-open", "square"], "size": 9, "line": {"width": 2}}
    marker["color"] = style(name)[1]
    mode, text = "markers+text" if name == MAIN else "markers", [*map(clock, ends.index)]
    sides = ["bottom right", "top left"]
    return marks(
        name, ends[["x", "y"]].to_numpy().T, marker, mode=mode, text=text, textposition=sides
    )


def _corrections(series: pd.DataFrame, corrections: Sequence[Correction]) -> go.Scatter:
    """Mark where the main track was corrected, with time, size and cause."""
    times = np.array([time for time, *_ in corrections])
    xy = interpolated(times, series.index, series[["x", "y"]].to_numpy()).T
    words = [
        f"{time:.1f} s: corrected by {metres:.1f} m, {math.degrees(turn):.0f} deg<br>{cause}"
        for time, metres, turn, cause in corrections
    ]
    edge = {"color": "black", "width": 1.5}
    marker = {"symbol": "triangle-up", "size": 12, "color": "#F0E442", "line": edge}
    hover = "%{text}<extra></extra>"
    return marks(MAIN, xy, marker, name="corrected", text=words, hovertemplate=hover)


def _known(known: PositionTrack) -> go.Scatter:
    """Mark known positions, such as waypoints or satellite fixes, with crosses."""
    few = len(known) <= _FEW_POSITIONS
    colour, size, width = (INK, 10, 2) if few else (FAINT, 5, 1)
    marker = {"symbol": "x-thin-open", "color": colour, "size": size, "line": {"width": width}}
    hover = f"{known.kind}: x %{{x:.2f}} m, y %{{y:.2f}} m, fitted to the track<extra></extra>"
    return marks("known", known.position_W[:, :2].T, marker, name=known.kind, hovertemplate=hover)


def _shown(series: pd.DataFrame, most: int) -> pd.DataFrame:
    """Return up to `most` evenly spaced rows of those that are shown."""
    shown = series[series.x.notna()]
    return shown.iloc[evenly_spaced(len(shown), most)]


def _frame(
    tracks: Mapping[str, pd.DataFrame], truth: pd.DataFrame | None, known: PositionTrack | None
) -> FloatArray:
    """Return limits (2, 2) of x and y that fit known positions and all but dead reckoning."""
    bounded = [series for name, series in tracks.items() if name != "dead_reckoning"]
    points = pd.concat([truth, *bounded])[["x", "y"]].to_numpy()
    if truth is not None:  # a diverged track must not shrink the truth to a dot
        low, high = truth[["x", "y", "z"]].agg(["min", "max"]).to_numpy()
        most = (high - low).max()
        points = np.clip(points, low[:2] - most, high[:2] + most)
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
