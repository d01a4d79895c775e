"""The report's two plotly figures: the map, and all panels over one time axis."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from stario.fusion.report.panels import FAINT, GRID, INK, TRUTH, Panel, style
from stario.fusion.report.series import Series, ellipse
from stario.sequences.arrays import evenly_spaced
from stario.sequences.sequence import FloatArray, PositionTrack

PANEL_HEIGHT = 190
"""Height of a panel over time [px]."""

_ELLIPSES = 12
"""Number of ellipses drawn along a track."""

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
    tracks: Mapping[str, Series], truth: Series | None, known: PositionTrack | None
) -> go.Figure:
    """Draw all tracks from above on equal axes, with 3-sigma ellipses where there is covariance.

    Args:
        tracks: tracks by name.
        truth: ground truth in the same frame, or None.
        known: positions or waypoints in the same frame, if there is no true track, or None.
    """
    figure, frame = go.Figure(), _frame(tracks, truth, known)
    if truth is not None:
        figure.add_trace(_path(TRUTH, truth, 3.0))
    largest = 0.4 * float(np.ptp(frame, axis=1).max())
    for name, series in tracks.items():
        if series.position_covariance is not None:
            figure.add_trace(_ellipses(name, series, series.position_covariance, largest))
    for name, series in tracks.items():
        figure.add_trace(_path(name, series, 2.0))
    for name, series in (dict(tracks) if truth is None else {TRUTH: truth, **tracks}).items():
        figure.add_trace(_ends(name, series))
    if known is not None:
        figure.add_trace(_known(known))
    figure.update_layout(
        **_LAYOUT,
        margin={"l": _LEFT, "r": 12, "t": 8, "b": 44},
        hovermode="closest",
        dragmode="pan",
    )
    figure.update_xaxes(title=_title("x [m]"), range=frame[0], **_AXIS)
    figure.update_yaxes(
        title=_title("y [m]"), range=frame[1], scaleanchor="x", scaleratio=1, **_AXIS
    )
    return figure


def time_figure(panels: Sequence[Panel]) -> go.Figure:
    """Stack all panels over one time axis."""
    count = len(panels)
    height = PANEL_HEIGHT * count + 60
    figure = make_subplots(
        rows=count,
        cols=1,
        shared_xaxes=True,
        vertical_spacing=46 / height,
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
        margin={"l": _LEFT, "r": 12, "t": 28, "b": 44},
        hovermode="x",
        dragmode="zoom",
    )
    return figure


def _title(text: str) -> dict[str, object]:
    return {"text": text, "standoff": 6, "font": {"size": 13}}


def _path(name: str, series: Series, width: float) -> go.Scatter:
    label, colour, dash = style(name)
    sigma = series.horizontal_sigma
    sigma_column = np.full(len(series.time), np.nan) if sigma is None else sigma
    sigma_text = "" if sigma is None else "<br>sigma %{customdata[1]:.2f} m"
    return go.Scatter(
        x=series.position[:, 0].round(4),
        y=series.position[:, 1].round(4),
        name=label,
        legendgroup=name,
        mode="lines",
        line={"color": colour, "dash": dash, "width": width},
        customdata=np.column_stack([series.time, sigma_column, series.speed]).round(3),
        hovertemplate=f"<b>{label}</b> at %{{customdata[0]:.1f}} s{sigma_text}"
        "<br>speed %{customdata[2]:.2f} m/s<br>x %{x:.2f} m, y %{y:.2f} m<extra></extra>",
    )


def _ellipses(name: str, series: Series, covariance: FloatArray, largest: float) -> go.Scatter:
    """Draw some outlines in one trace, separated by NaN.

    Semi-axes beyond `largest` [m] are too large for the map: they appear at the slider's time only.
    """
    valid = np.flatnonzero(np.isfinite(series.position[:, 0]))
    rows = valid[evenly_spaced(len(valid), _ELLIPSES)]
    outlines = [(k, ellipse(covariance[k])) for k in rows]
    parts = [
        np.vstack([series.position[k, :2] + outline, [[np.nan] * 2]])
        for k, outline in outlines
        if np.linalg.norm(outline, axis=1).max() <= largest
    ]
    outline = np.vstack([np.full((1, 2), np.nan), *parts]).round(3)
    return go.Scatter(
        x=outline[:, 0],
        y=outline[:, 1],
        name="3 sigma",
        legendgroup=name,
        showlegend=False,
        mode="lines",
        line={"color": style(name)[1], "width": 0.8},
        opacity=0.55,
        hoverinfo="skip",
    )


def _ends(name: str, series: Series) -> go.Scatter:
    """Mark the start with an open circle and the end with a square."""
    valid = np.flatnonzero(np.isfinite(series.position[:, 0]))
    ends = series.position[valid[[0, -1]], :2]
    return go.Scatter(
        x=ends[:, 0],
        y=ends[:, 1],
        legendgroup=name,
        mode="markers",
        marker={
            "symbol": ["circle-open", "square"],
            "size": 9,
            "color": style(name)[1],
            "line": {"width": 2},
        },
        hoverinfo="skip",
    )


def _known(known: PositionTrack) -> go.Scatter:
    """Mark known positions, such as waypoints or satellite fixes, with crosses."""
    return go.Scatter(
        x=known.position_W[:, 0].round(3),
        y=known.position_W[:, 1].round(3),
        name=known.kind,
        mode="markers",
        marker={"symbol": "x-thin-open", "color": "#000000", "size": 10, "line": {"width": 2}},
        hovertemplate=f"{known.kind}: x %{{x:.2f}} m, y %{{y:.2f}} m, fitted to the track"
        "<extra></extra>",
    )


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
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    # At least a metre, lest the millimetres of a device at rest look like a walk.
    half = 0.5 * (high - low) + 0.08 * max(1.0, float((high - low).max()))
    half = np.maximum(half, 0.5)
    return np.stack([0.5 * (low + high) - half, 0.5 * (low + high) + half], axis=1)
