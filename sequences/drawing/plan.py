"""Plan view of tracks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from stario.sequences.drawing.figures import (
    GREY,
    INK,
    LEGEND,
    RED,
    apply_style,
    clock,
    distance,
    indices_after_gaps,
    line_of,
    new_figure,
    split_at_gaps,
)
from stario.sequences.drawing.plots import draw_error
from stario.sequences.drawing.timed_path import draw_scale_bar, draw_timed_path, round_times
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, PositionTrack, Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TRUTH = "#B8B8B8"
"""Colour of the truth: below the tracks, wide and pale."""

_CROWDED = 12.0
"""Length of a path over the size of its box above which lines are drawn thinner."""

_MARKED_GAP = 1.0
"""Length of a gap [s] above which the track's next pose is marked."""


def plan_view(
    tracks: Mapping[str, Trajectory],
    truth: Trajectory | None,
    title: str,
    known: PositionTrack | None = None,
) -> Figure:
    """Draw all tracks from above, on equal axes that fit the ground truth and the tracks near it.

    The first track is coloured by time; where the truth is known, its error and sigma are drawn
    beside. A track that drifts far beyond the others is cut at the frame, and the legend states how
    far it goes. Invalid poses and gaps appear as breaks; the first pose after a gap of more than a
    second is marked. Tracks are drawn as given: align them first.

    Args:
        tracks: tracks by name, the most important one first; those of `TRACK_STYLES` have fixed
            colours.
        truth: the true track in the same frame, or None.
        title: title of the figure.
        known: positions or waypoints (n, 2) in the same frame, if there is no true track.

    Raises:
        InputError: there is nothing to draw.
    """
    paths = {name: _path_of(track) for name, track in tracks.items()}
    true_path = np.empty((0, 2)) if truth is None else _path_of(truth)
    boxes = {name: _box_of(path) for name, path in paths.items() if np.isfinite(path).any()}
    has_truth = truth is not None and bool(np.isfinite(true_path).any())
    if has_truth:
        typical = true_path
    elif boxes:
        # Drift only makes a track larger, so the lower median is a track without large drift.
        by_size = sorted(boxes, key=lambda name: _size_of(boxes[name]))
        typical = paths[by_size[(len(boxes) - 1) // 2]]
    else:
        raise InputError("tracks", "no valid pose", "at least one track to draw")
    home = _box_of(typical)
    beyond = {name: _excess(box, home) for name, box in boxes.items()}
    leaves = {name for name in boxes if beyond[name] > 0.5 * _size_of(home)}
    near = [boxes[name] for name in boxes if name not in leaves]
    if known is not None:
        near.append(_box_of(known.position_W))
    frame = _frame_around(np.array([home, *near]))
    fig, axes, beside = _new_plan(frame, title, with_error=has_truth and bool(boxes))
    length = float(np.nansum(np.linalg.norm(np.diff(typical, axis=0), axis=1)))
    fine = 0.6 if length / _size_of(home) > _CROWDED else 1.0
    if has_truth:
        axes.plot(*true_path.T, color=_TRUTH, lw=6.0 * fine, label="truth", zorder=2)
        end = true_path[np.isfinite(true_path).all(axis=1)][-1]
        axes.plot(*end, "s", ms=11, mfc=_TRUTH, mec=INK, mew=1.0, zorder=3.2)
    for k, name in enumerate(boxes):
        line = line_of(name, k)
        if name in leaves:
            line["label"] += f" (leaves the figure by {distance(beyond[name])})"
        if k == 0:
            colours, main_colour = draw_timed_path(axes, tracks[name], line["label"], fine)
            ticks = round_times(float(np.ptp(tracks[name].time)))
            bar = fig.colorbar(colours, ax=axes, shrink=0.5, aspect=30, pad=0.02, ticks=ticks)
            bar.ax.set_yticklabels([clock(tick) for tick in ticks])
            bar.set_label("time [min:s]", fontsize=9)
            bar.ax.tick_params(labelsize=8)
        else:
            axes.plot(*paths[name].T, **line, lw=1.3 * fine, zorder=3)
    _mark_gaps(axes, tracks, frame)
    if known is not None:
        _draw_known(axes, known)
    axes.set(xlim=frame[:, 0], ylim=frame[:, 1], xlabel="x [m]", ylabel="y [m]", aspect="equal")
    draw_scale_bar(axes, frame)
    axes.plot([], [], "o", mfc="white", mec=INK, label="start")
    axes.plot([], [], "s", mfc=INK, mec="white", label="end")
    _add_legend(fig, axes)
    if beside is not None and truth is not None:
        draw_error(beside, tracks, truth, main_colour)
    return fig


def _new_plan(frame: FloatArray, title: str, with_error: bool) -> tuple[Figure, Axes, Axes | None]:
    """Return a figure with axes that fit the frame, and axes beside them for the error."""
    width, height = 7.0 * np.ptp(frame, axis=0) / np.ptp(frame, axis=0).max()
    beside = [5.0] if with_error else []
    fig = new_figure(width + 1.8 + sum(beside), height + 1.0, title)
    panels = list(fig.subplots(1, 1 + len(beside), squeeze=False, width_ratios=[width, *beside])[0])
    for panel in panels:
        apply_style(panel)
    return fig, panels[0], panels[1] if with_error else None


def _path_of(track: Trajectory) -> FloatArray:
    return split_at_gaps(track.time, track.position_W[:, :2], track.valid)[1]


def _draw_known(axes: Axes, known: PositionTrack) -> None:
    """Mark waypoints with crosses, and positions, of which there are many, below the tracks."""
    x, y = known.position_W.T
    label = f"{known.kind}, fitted"
    if known.kind == "waypoints":
        axes.plot(x, y, "x", color="black", ms=7.0, mew=1.6, label=label, zorder=4)
    else:
        axes.plot(x, y, "o", color=GREY, mfc="none", ms=4.0, mew=0.8, label=label, zorder=1.9)


def _mark_gaps(axes: Axes, tracks: Mapping[str, Trajectory], frame: FloatArray) -> None:
    """Mark where each track continues after a gap, during which its direction is unknown."""
    label = "after a gap"
    for name, track in tracks.items():
        if name == "pdr":  # it has no poses while the person stands
            continue
        time, position = track.time[track.valid], track.position_W[track.valid, :2]
        marks = position[indices_after_gaps(time, _MARKED_GAP)]
        marks = marks[((marks >= frame[0]) & (marks <= frame[1])).all(axis=1)]
        if len(marks):
            axes.plot(*marks.T, "D", mfc="none", mec=RED, ms=7, label=label, zorder=4)
            label = ""


def _add_legend(fig: Figure, axes: Axes) -> None:
    """Add a legend below the axes, in as many columns as fit the width; the figure grows by it."""
    handles = axes.get_legend_handles_labels()
    for columns in (3, 2, 1):
        legend = fig.legend(*handles, loc="outside lower center", ncols=columns, **LEGEND)
        extent = legend.get_window_extent()
        if columns == 1 or extent.width < fig.bbox.width:
            fig.set_figheight(fig.get_figheight() + extent.height / fig.dpi)
            return
        legend.remove()


def _box_of(path: FloatArray) -> FloatArray:
    """Return the corners (2, 2), lower left and upper right, of a path (n, 2)."""
    return np.array([np.nanmin(path, axis=0), np.nanmax(path, axis=0)])


def _size_of(box: FloatArray) -> float:
    """Return the longer side of a box, at least 1 [m]."""
    return max(float(np.ptp(box, axis=0).max()), 1.0)


def _excess(box: FloatArray, home: FloatArray) -> float:
    """Return how far [m] a box extends beyond another, in x or y."""
    return float(max((home[0] - box[0]).max(), (box[1] - home[1]).max(), 0.0))


def _frame_around(boxes: FloatArray) -> FloatArray:
    """Return the corners (2, 2), lower left and upper right, of a frame around boxes (n, 2, 2)."""
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    half = np.maximum(0.5 * (high - low), 0.5) * 1.08
    half = np.maximum(half, 0.6 * half.max())  # even a straight path gets a frame of some width
    center = 0.5 * (low + high)
    return np.array([center - half, center + half])
