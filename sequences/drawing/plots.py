"""Figures of errors over time, innovations and the IMU's samples.

Functions return a `matplotlib.figure.Figure` drawn by Agg, without pyplot and its global state,
so that they work headless and in threads. matplotlib is imported where it is used, because it is
slow to import.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.accuracy.metrics import PoseErrors, pose_errors
from stario.sequences.clean_samples import finite_samples
from stario.sequences.drawing.figures import (
    ABOVE_LEFT,
    ABOVE_RIGHT,
    BLUE,
    GREEN,
    GREY,
    INK,
    LEGEND,
    ORANGE,
    RED,
    SKY,
    distance,
    draw_samples,
    line_of,
    new_figure,
    panels_of,
    reach_of,
    split_at_gaps,
)
from stario.sequences.errors import InputError
from stario.sequences.sequence import (
    MAX_TRUTH_GAP,
    STANDARD_GRAVITY,
    BoolArray,
    FloatArray,
    ImuSequence,
    Trajectory,
    is_gap,
    whole_seconds,
)
from stario.sequences.time_order import MAX_IMU_GAP

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_AXIS_COLOURS = (BLUE, ORANGE, GREEN)
_CLIP_FACTOR = 3.0

_SETTLED_S, _MOST_PERCENT = 3.0, 99.0
"""Time after a filter's first update [s] from which the axes of its innovations fit them, and how
many of them: the first sigmas are ten times the later ones."""


def error_over_time(
    tracks: Mapping[str, Trajectory], truth: Trajectory, title: str = "Position error"
) -> Figure:
    """Draw all tracks' horizontal error, and the error per axis with 3 sigma if available.

    The axes fit the better tracks; a track is cut if its largest error is over three times the
    lower median of all. Per axis only tracks with `position_covariance_W` are drawn, or, if none
    has one, the better tracks. Tracks are compared as given: align them first.

    Raises:
        InputError: there is no track, or one has no time in common with the truth.
    """
    if not tracks:
        raise InputError("tracks", "none", "at least one track")
    errors = {name: pose_errors(track, truth) for name, track in tracks.items()}
    norms = {name: np.linalg.norm(e.position_W[:, :2], axis=1) for name, e in errors.items()}
    largest = {name: float(norm.max()) for name, norm in norms.items()}
    typical = sorted(largest.values())[(len(largest) - 1) // 2]
    good = [name for name in tracks if largest[name] <= _CLIP_FACTOR * max(typical, 0.1)]
    fig = new_figure(9.0, 9.0, title)
    panels = panels_of(fig, 1.7, 1, 1, 1)
    for k, name in enumerate(tracks):
        line = line_of(name, k)
        if name not in good:
            line["label"] += f" (leaves the figure, up to {distance(largest[name])})"
        panels[0].plot(*split_at_gaps(errors[name].estimate.time, norms[name]), **line, lw=1.3)
    panels[0].set_ylim(0, 1.08 * max(largest[name] for name in good) or 1.0)
    panels[0].set_ylabel("horizontal error [m]")
    with_covariance = [n for n in tracks if errors[n].estimate.position_covariance_W is not None]
    for k, name in enumerate(tracks):
        if name in (with_covariance or good):
            _draw_axis_errors(panels[1:], errors[name], line_of(name, k))
    panels[-1].set_xlabel("time [s]")
    fig.align_ylabels()
    panels[0].legend(**ABOVE_LEFT)
    if with_covariance:
        panels[1].legend(**ABOVE_LEFT)
    return fig


def draw_error(
    axes: Axes, tracks: Mapping[str, Trajectory], truth: Trajectory, colour: str
) -> None:
    """Draw the horizontal error of tracks over time, and the sigma of the first one.

    The sigma is that of the distance, (P_xx + P_yy)^1/2. The axes fit the first track, which has
    the colour; another may leave them.
    """
    reach = 0.0
    for k, (name, track) in enumerate(tracks.items()):
        errors = pose_errors(track, truth)
        elapsed, P = errors.estimate.time - truth.time[0], errors.estimate.position_covariance_W
        norm = np.linalg.norm(errors.position_W[:, :2], axis=1)
        if k == 0:
            reach = float(norm.max())
            if P is not None:
                sigma = np.sqrt(P[:, 0, 0] + P[:, 1, 1])
                reach = max(reach, float(sigma.max()))
                axes.plot(
                    *split_at_gaps(elapsed, sigma), "--", color=INK, lw=1.2, label="its sigma"
                )
        own = {"color": colour, "lw": 2.0} if k == 0 else {**line_of(name, k), "lw": 1.2}
        axes.plot(*split_at_gaps(elapsed, norm), **{**own, "label": ""})
    axes.set(xlabel="time [s]", ylabel="distance from the truth [m]")
    axes.set_ylim(0.0, 1.3 * reach or 1.0)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(**ABOVE_LEFT)


def innovations(
    time: FloatArray,
    residual: FloatArray,
    sigma: FloatArray,
    nis: FloatArray,
    gated: BoolArray,
    title: str,
) -> Figure:
    """Draw a filter's innovations, one or more, with their 3 sigma bands, and the NIS.

    The axes fit most of them; what is beyond, such as the first update, is drawn at the edge.

    Args:
        time: (M,) times of the updates [s].
        residual: (M, 3) innovation, x y z [m].
        sigma: (M, 3) standard deviation of the innovation according to the filter [m].
        nis: (M,) normalised innovation squared.
        gated: (M,) True where the gate rejected or weakened the update.
        title: title of the figure.
    """
    fig = new_figure(9.0, 9.0, title)
    panels = panels_of(fig, 1, 1, 1, 1.3)
    settled = time >= min(time[0] + _SETTLED_S, time[-1])
    for k, (axes, axis) in enumerate(zip(panels, "xyz", strict=False)):
        _draw_band(axes, time, sigma[:, k], max_gap=1.0, color=BLUE)
        used = np.abs(residual[settled & ~gated, k])
        reach = reach_of(_most(used), _most(3 * sigma[settled, k]))
        # A gated residual can be huge: drawn at the edge, it leaves room for the others.
        _draw_dots(axes, time, np.clip(residual[:, k], -reach, reach), gated)
        axes.set(ylabel=f"{axis} [m]", ylim=(-reach, reach))
    panels[0].set_title("residual, band: 3 sigma", loc="left", fontsize=10)
    _draw_nis(panels[3], time, nis, gated)
    panels[3].set_xlabel("time [s]")
    fig.align_ylabels()
    return fig


def imu_overview(
    sequence: ImuSequence,
    rotation: tuple[FloatArray, FloatArray] | None = None,
    rest: Iterable[tuple[float, float]] = (),
    gaps: Iterable[tuple[float, float]] = (),
) -> Figure:
    """Draw angular rate, specific force and its norm, and the true speed if there is a truth.

    Long recordings are drawn as mean and envelope, so that no peak is lost.

    Args:
        sequence: the recording, with a finite sample.
        rotation: times [s] and norm of the true angular rate [rad/s], drawn with that of the
            gyroscope.
        rest: first and last time of stretches to shade as stationary [s].
        gaps: first and last time of stretches without samples [s]: shaded, or marked at the upper
            edge if they are short enough to be bridged.
    """
    finite = finite_samples(sequence)
    order = np.flatnonzero(finite)[np.argsort(sequence.time[finite], kind="stable")]
    time, gyro, accel = sequence.time[order], sequence.gyro[order], sequence.accel[order]
    count = 2 + (rotation is not None) + (sequence.truth is not None)
    fig = new_figure(9.0, 2.0 + 2.0 * count, f"IMU of {sequence.name}")
    panels = panels_of(fig, *([1] * count))
    draw_samples(panels[1], time, np.linalg.norm(accel, axis=1), "norm", GREY)
    for axes, values in ((panels[0], gyro), (panels[1], accel)):
        for k, axis in enumerate("xyz"):
            draw_samples(axes, time, values[:, k], axis, _AXIS_COLOURS[k])
    panels[1].axhline(STANDARD_GRAVITY, color=INK, lw=0.9, ls="--", label="gravity")
    panels[0].set_ylabel("angular rate [rad/s]")
    panels[1].set_ylabel("specific force [m/s$^2$]")
    if rotation is not None:
        panels[2].plot(*rotation, color=GREY, lw=0.8, label="truth")
        draw_samples(panels[2], time, np.linalg.norm(gyro, axis=1), "gyroscope", BLUE)
        panels[2].set(ylabel="rotation [rad/s]", ylim=(0, reach_of(np.linalg.norm(gyro, axis=1))))
    for k, (start, stop) in enumerate(rest):
        panels[1].axvspan(start, stop, color=SKY, alpha=0.3, lw=0, label="" if k else "at rest")
    for axes in panels[:2]:
        _draw_gaps(axes, np.reshape([*gaps], (-1, 2)))
    for axes in panels[: 2 + (rotation is not None)]:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), **LEGEND)
    if sequence.truth is not None:
        ticks, speed = _speed(sequence.truth)
        panels[-1].plot(ticks, speed, color="black", lw=1.0)
        panels[-1].set(ylabel="true speed [m/s]", ylim=(0, reach_of(speed)))
    panels[-1].set_xlabel("time [s]")
    fig.align_ylabels()
    panels[-1].set_xlim(time[0], time[-1] if time[-1] > time[0] else time[0] + 1.0)
    return fig


def _draw_gaps(axes: Axes, gaps: FloatArray) -> None:
    """Shade gaps (n, 2) [s] behind the curves; mark those that are bridged at the upper edge."""
    long = is_gap(np.diff(gaps)[:, 0], MAX_IMU_GAP)
    for k, (start, stop) in enumerate(gaps[long]):
        label = "" if k else "gap"
        axes.axvspan(start, stop, color=RED, alpha=0.5, lw=1, zorder=0.5, label=label)
    if not long.all():
        short = gaps[~long].mean(axis=1)
        edge = axes.get_xaxis_transform()
        axes.plot(short, np.ones(len(short)), "|", color=RED, ms=9, transform=edge, label="lost")


def _speed(truth: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Return times [s] and speed [m/s] along 1 s chords, from which path length is measured."""
    ticks = whole_seconds(truth.time)
    if len(ticks) < 2 or truth.valid.sum() < 2:
        return np.empty(0), np.empty(0)
    at = truth.at(ticks)
    speed = np.linalg.norm(np.diff(at.position_W, axis=0), axis=1)
    known = at.valid[1:] & at.valid[:-1]
    return ticks[:-1] + 0.5, np.where(known, speed, np.nan)


def _draw_axis_errors(panels: list[Axes], errors: PoseErrors, line: dict[str, Any]) -> None:
    time, colour = errors.estimate.time, line["color"]
    edge = {**line, "label": "", "lw": 0.7}
    for k, (axes, axis) in enumerate(zip(panels, "xyz", strict=True)):
        axes.plot(*split_at_gaps(time, errors.position_W[:, k]), **line, lw=1.2)
        if errors.estimate.position_covariance_W is not None:
            sigma = np.sqrt(errors.estimate.position_covariance_W[:, k, k])
            _draw_band(axes, time, sigma, color=colour, label=f"{line['label']}, 3 sigma")
            for bound in (-3.0 * sigma, 3.0 * sigma):
                axes.plot(*split_at_gaps(time, bound), **edge)
        axes.set_ylabel(f"error in {axis} [m]")


def _most(values: FloatArray) -> FloatArray:
    """Return what most values (N,) lie below, as (1,); nothing if there are none."""
    return np.percentile(values, [_MOST_PERCENT]) if len(values) else values


def _draw_band(
    axes: Axes, time: FloatArray, sigma: FloatArray, max_gap: float = MAX_TRUTH_GAP, **style: Any
) -> None:
    """Shade three standard deviations (N,) on both sides of zero."""
    time, band = split_at_gaps(time, 3 * sigma, max_gap=max_gap)
    axes.fill_between(time, -band, band, alpha=0.15, lw=0, **style)


def _draw_dots(axes: Axes, time: FloatArray, value: FloatArray, gated: BoolArray) -> None:
    """Draw values (N,) as dots, gated ones as crosses."""
    axes.plot(time[~gated], value[~gated], ".", color=BLUE, ms=3, label="used")
    # An empty line has no extent; unclipped, it would leave the layout without any bounds.
    clipped = not gated.any()
    axes.plot(time[gated], value[gated], "x", color=RED, ms=5, label="gated", clip_on=clipped)


def _draw_nis(axes: Axes, time: FloatArray, nis: FloatArray, gated: BoolArray) -> None:
    low, bound, top = (chi2_quantile(p, 3.0) for p in (0.001, 0.95, 0.9999))
    _draw_dots(axes, time, np.maximum(nis, low), gated)
    axes.axhline(3.0, color=INK, lw=1.0, label="expected 3")
    axes.axhline(bound, color=INK, lw=1.0, ls="--", label=f"95 % below {bound:.1f}")
    axes.set_yscale("log")
    axes.set_ylim(low, 1.5 * max(top, float(np.nanmax(nis))))
    axes.set_ylabel("NIS [1]")
    title = f"NIS: mean {np.nanmean(nis):.2f}, {100 * np.mean(gated):.1f} % gated"
    axes.set_title(title, loc="left", fontsize=10)
    axes.legend(**ABOVE_RIGHT)
