"""Plan view of tracks: the first coloured by time, with arrows, and a scale bar."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from stario.sequences.arrays import interpolated
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
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, PositionTrack, Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

_TRUTH = "#B8B8B8"
"""Colour of the truth: below the tracks, wide and pale."""

_CROWDED = 12.0
"""Length of a path over the size of its box above which lines are drawn thinner."""

_MARKED_GAP = 1.0
"""Length of a gap [s] above which the track's next pose is marked."""


_ROUND_SECONDS = (10, 30, 60, 120, 300, 600, 1800, 3600)
"""Times between arrows, and between ticks of the colour bar [s]."""

_MOST = 10
"""Number of arrows and of ticks, unless a track is many hours long."""

_STRIDE = 1.0
"""Time before and after an arrow [s] between which it points."""

_MIN_STRIDE = 0.3
"""Distance within these [m] below which there is no arrow: the device rests."""

_WIDE, _NARROW, _COLOURS = 3.2, 1.4, 200
"""Line widths at start and end, and number of colours: where the way back covers the way out, both
show."""


def plan_view(
    tracks: Mapping[str, Trajectory],
    truth: Trajectory | None,
    title: str,
    known: PositionTrack | None = None,
) -> Figure:
    """Draw all tracks from above, on equal axes that fit the truth, the first track and those near.

    The first track is coloured by time; where the truth is known, its error and sigma are drawn
    beside. Another that drifts far beyond is cut at the frame, and the legend states how far it
    goes. Invalid poses and gaps appear as breaks; the first pose after a gap of more than a
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
    others = [name for name in boxes if name != next(iter(tracks))]
    leaves = {name for name in others if beyond[name] > 0.5 * _size_of(home)}
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
            colours, main_colour = _draw_timed_path(axes, tracks[name], line["label"], fine)
            ticks = _round_times(float(np.ptp(tracks[name].time)))
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
    _draw_scale_bar(axes, frame)
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


def _draw_timed_path(
    axes: Axes, track: Trajectory, label: str, fine: float
) -> tuple[ScalarMappable, str]:
    """Draw a track from above, dark and wide at its start, bright and narrow at its end.

    The widths have a factor `fine`. Returns its colours by time since the start [s], for a colour
    bar, and that of the legend.
    """
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.collections import LineCollection
    from matplotlib.colors import ListedColormap, Normalize

    duration = max(float(track.time[-1] - track.time[0]), 1e-3)
    # Without the brightest colours, which white paper swallows; uniform also for colour-blind eyes.
    colours = ListedColormap(colormaps["plasma"](np.linspace(0.0, 0.85, _COLOURS)))
    elapsed = track.time - track.time[0]
    scale = ScalarMappable(Normalize(0.0, duration), colours)
    rows = np.column_stack(split_at_gaps(elapsed, track.position_W[:, :2], track.valid))
    steps = np.stack([rows[:-1], rows[1:]], axis=1)
    steps = steps[np.isfinite(steps).all(axis=(1, 2))]
    middle = steps[:, :, 0].mean(axis=1)
    widths = fine * (_WIDE + (_NARROW - _WIDE) * middle / duration)
    look = {"colors": scale.to_rgba(middle), "linewidths": widths, "capstyle": "round"}
    axes.add_collection(LineCollection([*steps[:, :, 1:]], **look, zorder=3.5))
    in_legend = _colour_at(scale, 0.5 * duration)
    axes.plot([], [], color=in_legend, lw=2.0 * fine, label=label)
    _draw_arrows(axes, track, scale)
    _draw_timed_ends(axes, rows[np.isfinite(rows).all(axis=1)][[0, -1]], scale)
    return scale, in_legend


def _colour_at(scale: ScalarMappable, seconds: float) -> str:
    """Return the colour at a time since the start [s]."""
    from matplotlib.colors import to_hex

    red, green, blue, _ = scale.to_rgba(np.array([seconds]))[0]
    return to_hex((red, green, blue))


def _round_times(duration: float) -> FloatArray:
    """Return a few round times within a duration [s], from zero on."""
    step = next((s for s in _ROUND_SECONDS if duration <= s * _MOST), _ROUND_SECONDS[-1])
    return np.arange(0.0, duration, step)


def _draw_arrows(axes: Axes, track: Trajectory, scale: ScalarMappable) -> None:
    """Draw an arrow where the device moves fastest in the middle of each round time."""
    start, stop = track.time[0] + _STRIDE, track.time[-1] - _STRIDE
    time = np.arange(start, stop, 0.5 * _STRIDE)
    behind, at, ahead = (
        interpolated(time + shift, track.time, track.position_W[:, :2])
        for shift in (-_STRIDE, 0.0, _STRIDE)
    )
    known = track.covers(time - _STRIDE) & track.covers(time) & track.covers(time + _STRIDE)
    stride = np.where(known, np.linalg.norm(ahead - behind, axis=1), 0.0)
    begins = _round_times(float(track.time[-1] - track.time[0]))
    step = begins[1] - begins[0] if len(begins) > 1 else track.time[-1] - track.time[0]
    for begin in track.time[0] + begins:
        middle = (time > begin + 0.2 * step) & (time < begin + 0.8 * step) & (stride > _MIN_STRIDE)
        if not middle.any():
            continue
        k = int(np.argmax(np.where(middle, stride, 0.0)))
        tip = at[k] + 1e-3 * (ahead[k] - behind[k])
        look = {"arrowstyle": "-|>", "mutation_scale": 19, "shrinkA": 0, "shrinkB": 0}
        look |= {"fc": _colour_at(scale, time[k] - track.time[0]), "ec": "white", "lw": 0.8}
        axes.annotate("", xy=tip, xytext=at[k], arrowprops=look, zorder=5)


def _draw_timed_ends(axes: Axes, ends: FloatArray, scale: ScalarMappable) -> None:
    """Mark start and end, rows of time [s], x and y [m], with their times."""
    for (time, *place), shape, below in zip(ends, "os", (True, False), strict=True):
        colour = _colour_at(scale, time)
        filling = "white" if below else colour
        axes.plot(*place, shape, ms=9, mfc=filling, mec=colour, mew=2, zorder=6)
        axes.annotate(
            clock(time), place, (0, -9 if below else 9), textcoords="offset points", fontsize=9,
            ha="center", va="top" if below else "bottom", color=INK, zorder=7,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
        )  # fmt: skip


def _draw_scale_bar(axes: Axes, frame: FloatArray) -> None:
    """Draw a bar of a round length above the right end of a frame (2, 2) [m]."""
    width = float(np.ptp(frame[:, 0]))
    power = 10.0 ** math.floor(math.log10(0.3 * width))
    length = power * max(n for n in (1, 2, 5) if n * power <= 0.3 * width)
    ends, place = (frame[1, 0] - length, frame[1, 0]), axes.get_xaxis_transform()
    axes.plot(ends, (1.02, 1.02), color=INK, lw=3.0, clip_on=False, transform=place)
    text = distance(length) if length >= 1.0 else f"{100 * length:.0f} cm"
    axes.text(sum(ends) / 2, 1.03, text, transform=place, ha="center", va="bottom", fontsize=9,
              color=INK)  # fmt: skip


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
