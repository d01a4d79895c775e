"""A path coloured by time, with arrows in the direction of motion, and a map's scale bar."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from stario.sequences.arrays import interpolated
from stario.sequences.drawing.figures import INK, clock, distance, split_at_gaps
from stario.sequences.sequence import FloatArray, Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable

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


def draw_timed_path(
    axes: Axes, track: Trajectory, label: str, fine: float
) -> tuple[ScalarMappable, str]:
    """Draw a track from above, dark and wide at its start, bright and narrow at its end.

    Args:
        axes: axes in metres.
        track: the track; gaps are left out.
        label: its text in the legend.
        fine: factor on the widths.

    Returns:
        Its colours by time since the start [s], for a colour bar, and that of the legend.
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
    in_legend = _at(scale, 0.5 * duration)
    axes.plot([], [], color=in_legend, lw=2.0 * fine, label=label)
    _draw_arrows(axes, track, scale)
    _draw_ends(axes, rows[np.isfinite(rows).all(axis=1)][[0, -1]], scale)
    return scale, in_legend


def _at(scale: ScalarMappable, seconds: float) -> str:
    """Return the colour at a time since the start [s]."""
    from matplotlib.colors import to_hex

    red, green, blue, _ = scale.to_rgba(np.array([seconds]))[0]
    return to_hex((red, green, blue))


def round_times(duration: float) -> FloatArray:
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
    begins = round_times(float(track.time[-1] - track.time[0]))
    step = begins[1] - begins[0] if len(begins) > 1 else track.time[-1] - track.time[0]
    for begin in track.time[0] + begins:
        middle = (time > begin + 0.2 * step) & (time < begin + 0.8 * step) & (stride > _MIN_STRIDE)
        if not middle.any():
            continue
        k = int(np.argmax(np.where(middle, stride, 0.0)))
        tip = at[k] + 1e-3 * (ahead[k] - behind[k])
        style = {"arrowstyle": "-|>", "mutation_scale": 19, "lw": 0.8, "ec": "white",
                 "fc": _at(scale, time[k] - track.time[0]), "shrinkA": 0, "shrinkB": 0}  # fmt: skip
        axes.annotate("", xy=tip, xytext=at[k], arrowprops=style, zorder=5)


def _draw_ends(axes: Axes, ends: FloatArray, scale: ScalarMappable) -> None:
    """Mark start and end, rows of time [s], x and y [m], with their times."""
    for (time, *place), shape, below in zip(ends, "os", (True, False), strict=True):
        colour = _at(scale, time)
        filling = "white" if below else colour
        axes.plot(*place, shape, ms=9, mfc=filling, mec=colour, mew=2, zorder=6)
        axes.annotate(
            clock(time), place, (0, -9 if below else 9), textcoords="offset points", fontsize=9,
            ha="center", va="top" if below else "bottom", color=INK, zorder=7,
            bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.75},
        )  # fmt: skip


def draw_scale_bar(axes: Axes, frame: FloatArray) -> None:
    """Draw a bar of a round length above the right end of a frame (2, 2) [m]."""
    width = float(np.ptp(frame[:, 0]))
    power = 10.0 ** math.floor(math.log10(0.3 * width))
    length = power * max(n for n in (1, 2, 5) if n * power <= 0.3 * width)
    ends, place = (frame[1, 0] - length, frame[1, 0]), axes.get_xaxis_transform()
    axes.plot(ends, (1.02, 1.02), color=INK, lw=3.0, clip_on=False, transform=place)
    text = distance(length) if length >= 1.0 else f"{100 * length:.0f} cm"
    axes.text(sum(ends) / 2, 1.03, text, transform=place, ha="center", va="bottom", fontsize=9,
              color=INK)  # fmt: skip
