"""Common parts of figures: colours, panels, lines broken at gaps, curves of many samples."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stario.sequences.arrays import runs
from stario.sequences.files import atomic_write
from stario.sequences.sequence import MAX_TRUTH_GAP, BoolArray, FloatArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette: most of it can be told apart by the colour-blind, not all, and little in
# grey. Tracks therefore also differ in dash.
BLUE, ORANGE, GREEN, PINK = "#0072B2", "#E69F00", "#009E73", "#CC79A7"
RED, SKY, GREY, INK, BROWN = "#D55E00", "#56B4E9", "#999999", "#333333", "#7F5539"
TRACK_STYLES = {
    "track": ("StarIO", BLUE, "solid"),
    "filtered": ("filter, as in a stream", PINK, "dash"),
    "network": ("network alone", ORANGE, "dot"),
    "network_true_attitude": ("network, true attitude", GREEN, "dashdot"),
    "pdr": ("steps (PDR)", BROWN, "longdash"),
    "dead_reckoning": ("dead reckoning (IMU alone)", GREY, "longdashdot"),
}
"""Label, colour and dash of tracks."""

DASHES = {
    "solid": (),
    "dash": (3.7, 1.6),
    "dot": (1.0, 1.4),
    "dashdot": (5.0, 1.5, 1.0, 1.5),
    "longdash": (8.0, 2.5),
    "longdashdot": (8.0, 2.0, 1.0, 2.0),
}
"""Dashes: lengths of line and gap, in widths of the line."""

_SPARES = ((RED, "dash"), (SKY, "dot"), ("#6A4C93", "dashdot"))
LEGEND: dict[str, Any] = {"frameon": False, "fontsize": 9}
ABOVE_LEFT = {**LEGEND, "loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "ncols": 3}
ABOVE_RIGHT = {**LEGEND, "loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "ncols": 4}
_DPI = 150
_MAX_SAMPLES = 3000
_BLOCKS = 600


def save_figure(fig: Figure, path: Path | str) -> None:
    """Write a figure as PNG, atomically.

    Raises:
        InputError: the folder does not exist.
    """
    with atomic_write(path, "wb") as file:
        fig.savefig(file, format="png", dpi=_DPI)


def new_figure(width: float, height: float, title: str) -> Figure:
    """Return an empty figure with a title; width and height are in inches."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    fig = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(fig)
    fig.suptitle(title, fontsize=13, color=INK, x=0.02, ha="left")
    return fig


def panels_of(fig: Figure, *heights: float) -> list[Axes]:
    """Return stacked panels of these relative heights that share the x axis; one by default."""
    ratios = heights or (1,)
    panels = fig.subplots(len(ratios), 1, sharex=True, height_ratios=ratios, squeeze=False)[:, 0]
    for axes in panels:
        apply_style(axes)
        axes.margins(x=0.01)
    return list(panels)


def apply_style(axes: Axes) -> None:
    """Style axes as in all figures."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)
    axes.tick_params(colors=INK, labelsize=9)
    axes.grid(color="#E6E6E6", lw=0.7)
    axes.set_axisbelow(True)


def line_of(name: str, index: int) -> dict[str, Any]:
    """Return label, colour and dash of a track's line; unknown names take spare ones by index."""
    label, colour, dash = TRACK_STYLES.get(name, (name, *_SPARES[index % len(_SPARES)]))
    style = (0.0, DASHES[dash]) if dash != "solid" else "-"
    return {"label": label, "color": colour, "linestyle": style}


def split_at_gaps(
    time: FloatArray,
    values: FloatArray,
    valid: BoolArray | None = None,
    max_gap: float = MAX_TRUTH_GAP,
) -> tuple[FloatArray, FloatArray]:
    """Return the valid rows of time (N,) and values (N,) or (N, k), with a row of NaN in each gap.

    Gaps are those of `indices_after_gaps`.
    """
    if valid is not None:
        time, values = time[valid], values[valid]
    gaps = indices_after_gaps(time, max_gap)
    return (
        np.insert(time, gaps, 0.5 * (time[gaps] + time[gaps - 1])),
        np.insert(values, gaps, np.nan, axis=0),
    )


def split_at_nan(values: FloatArray) -> list[FloatArray]:
    """Return the stretches (n, k) of values (N, k) between rows with a NaN."""
    known = np.asarray(np.isfinite(values).all(axis=1))
    return [values[a:b] for a, b in runs(known)]


def indices_after_gaps(time: FloatArray, max_gap: float) -> NDArray[np.intp]:
    """Return the indices of the times (N,) [s] that follow a gap.

    A gap is longer than `max_gap` [s] and than three median steps.
    """
    steps = np.diff(time)
    longest = max(max_gap, 3 * float(np.median(steps))) if len(steps) else max_gap
    return np.flatnonzero(steps > longest) + 1


def distance(metres: float) -> str:
    """Format a distance in metres, or in kilometres from 1000 m on."""
    if metres >= 1000:
        return f"{metres / 1000:.1f} km"
    return f"{metres:.0f} m" if metres >= 10 else f"{metres:.3g} m"


def clock(seconds: float) -> str:
    """Format a time as minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02d}"


def draw_samples(axes: Axes, time: FloatArray, value: FloatArray, label: str, colour: str) -> None:
    """Draw a curve through samples; if they are many, through block means within the extremes."""
    block = 1 if len(time) <= _MAX_SAMPLES else -(-len(time) // _BLOCKS)
    starts = np.arange(0, len(time), block)
    total, low, high = (each.reduceat(value, starts) for each in (np.add, np.minimum, np.maximum))
    mean = total / np.diff(np.append(starts, len(time)))
    ticks, curves = split_at_gaps(time[starts], np.column_stack([mean, low, high]))
    axes.plot(ticks, curves[:, 0], color=colour, lw=0.8, label=label)
    if block > 1:
        axes.fill_between(ticks, *curves[:, 1:].T, color=colour, alpha=0.3, lw=0.4)


def reach_of(*values: FloatArray) -> float:
    """Return 1.1 times the largest finite magnitude; 1 if that is 0."""
    finite = np.abs(np.concatenate([value[np.isfinite(value)] for value in values]))
    return 1.1 * float(finite.max(initial=0.0)) or 1.0
