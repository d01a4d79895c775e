"""Errors of a network alone on one recording, for any kind of ground truth.

All positions are horizontal and written x + iy. The track is given in N, whose yaw relative to the
world is unknown; how it is determined depends on the truth:

- poses: displacements over a horizon are rotated by the true yaw at the horizon's start; the track
  as a whole is fitted in yaw and position, or aligned with the first pose.
- positions: the yaw is fitted over 20 s (or the horizon, if longer) from the displacement's start.
- waypoints: the track is fitted to all waypoints in yaw and position.

A displacement is compared only if the truth has neither gap nor jump between its ends.

Windows overlap by half: each contributes the mean velocity over its second, and the velocity
between two ticks of the track is the mean over the windows that cover them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stario.fusion.imu.direction import Complex, Direction, direction, weighted_force
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.errors import InputError
from stario.sequences.findings import warn
from stario.sequences.inspection.checks import check_units
from stario.sequences.inspection.samples import dead_axes
from stario.sequences.legs import gaps_and_jumps
from stario.sequences.levelled_stream import (
    TICK_SECONDS,
    TICKS_PER_SECOND,
    LevelledStream,
    levelled_streams,
)
from stario.sequences.sequence import (
    BoolArray,
    FloatArray,
    ImuSequence,
    PositionTrack,
    Trajectory,
    is_gap,
)

HORIZONS = (1, 10, 30)
"""Spans [s] over which displacements are compared."""

BLOCK_SECONDS = 30.0
"""Length of the blocks over which errors are summed for the bootstrap."""

STRETCH_SECONDS = 20
"""Length of the stretches over which `stretch_percent` is computed."""

_MIN_DISPLACEMENTS = 20
"""Minimum number of displacements for a piece to count in the error over a horizon."""

_LEG = round(2.0 / TICK_SECONDS)

FIGURES = {
    "ate_fit_m": "root mean square of the horizontal position error after a fit in yaw and position"
    " [m]; for waypoints, the error at the waypoints",
    "ate_fit_percent": "the same in % of the true path length; gaps of the IMU divide a recording "
    "into pieces, which are fitted one by one",
    "ate_first_m": "the same after alignment by yaw and position of the first pose [m]",
    "length_ratio": "length of the track over that of the truth, along legs of 2 s or between "
    "waypoints",
    "rms_1s_m": "root mean square error of displacements over 1 s [m]",
    "rms_10s_m": "the same over 10 s [m]",
    "rms_30s_m": "the same over 30 s [m]",
    "stretch_percent": "root mean square position error within stretches of 20 s, each fitted in "
    "yaw and position, in % of the stretch's path",
    "direction_deg": "absolute yaw between the directions of the displacements and of the "
    "accelerometer [deg]: the only figure that shows whether waypoints are walked backwards; on a "
    "one-minute walk at constant speed it is accurate to only about 30 degrees",
    "nis": "mean of error^T covariance^-1 error of single windows, scaled to three axes "
    "(expected: 3)",
    "nis_filtered": "mean NIS of the filter in its default settings (expected: 3), if requested",
}
"""Figures of a recording and their meaning; NaN if its kind of truth does not provide one."""

_MIN_PATH_M = 1.0
"""Length of the true path [m] below which a recording is not compared."""


class Piece(NamedTuple):
    """An unbroken stretch of a recording with the displacements of its M windows.

    Attributes:
        stream: IMU, levelled without the truth.
        displacement_N: (M, 3) displacement over the second from tick m [m].
        covariance_N: (M, 3, 3) covariance [m^2].
    """

    stream: LevelledStream
    displacement_N: FloatArray
    covariance_N: FloatArray

    @property
    def windows(self) -> Complex:
        """Horizontal displacements (M,) [m]."""
        return planar(self.displacement_N)

    def track(self) -> Complex:
        """Return the horizontal position (K,) [m] at the stream's ticks, 0 at the first."""
        steps, cover = self.windows / TICKS_PER_SECOND, np.ones(TICKS_PER_SECOND)
        total, count = np.convolve(steps, cover), np.convolve(np.ones(len(steps)), cover)
        track = np.concatenate([[0.0], np.cumsum(total / count)])
        return track[: len(self.stream.R_NB)]


def usable_streams(sequence: ImuSequence) -> list[LevelledStream]:
    """Return the unbroken stretches of a recording, levelled.

    Raises:
        InputError: there is no unbroken stretch of 2 s, or a unit is wrong.
    """
    check_units(sequence)
    warn(sequence.name, dead_axes(sequence))
    return levelled_streams(sequence)


class _AtTicks(NamedTuple):
    """Track and truth (n,) at the ticks of a piece, and the truth's breaks (n,) before each."""

    track: Complex
    truth: Complex
    breaks: np.ndarray

    def unbroken(self, span: int) -> BoolArray:
        """Return whether the `span` ticks after each tick (n - span,) have neither gap nor jump."""
        ends = np.isfinite(self.truth[:-span]) & np.isfinite(self.truth[span:])
        return np.asarray(ends & (self.breaks[:-span] == self.breaks[span:]))

    def displacements(self, seconds: int) -> tuple[Complex, Complex, np.ndarray]:
        """Return displacements of track and truth over a span, and the ticks they start at."""
        span = round(seconds / TICK_SECONDS)
        start = np.flatnonzero(self.unbroken(span))
        moved, true = (xy[start + span] - xy[start] for xy in (self.track, self.truth))
        return moved, true, start

    def turn_of_stretches(self, seconds: int) -> Complex:
        """Return exp(i yaw) (n,) that best fits the legs from each tick on; NaN across a break."""
        span = round(seconds / TICK_SECONDS)
        turn = np.full(len(self.track), complex(np.nan, np.nan))
        unbroken = np.flatnonzero(self.unbroken(span))
        legs, true_legs = (xy[_LEG:] - xy[:-_LEG] for xy in (self.track, self.truth))
        total = np.concatenate([[0.0], np.cumsum(np.conj(legs) * np.nan_to_num(true_legs))])
        turn[unbroken] = np.exp(1j * np.angle(total[unbroken + span - _LEG + 1] - total[unbroken]))
        return turn


_Errors = Iterator[tuple[str, FloatArray, FloatArray]]
"""Figure, seconds since the piece's first tick (n,) and errors (n,); those of "path" and "length"
are the lengths [m] of legs of truth and track."""


def known_truth(sequence: ImuSequence) -> tuple[str, PositionTrack]:
    """Return the kind of a recording's truth, and its valid positions.

    Raises:
        InputError: there is no truth of any kind, or only one pose or position of it is valid.
    """
    known = sequence.truth or sequence.positions
    if known is None:
        raise InputError(f"{sequence.name}: truth", "none", "poses, positions or waypoints")
    if known.valid.sum() < 2:
        raise InputError(f"{sequence.name}: truth", f"{known.valid.sum()} valid", "two or more")
    kind = known.kind if isinstance(known, PositionTrack) else "poses"
    time, position_W = known.time[known.valid], known.position_W[known.valid]
    return kind, PositionTrack(time, position_W, "positions")


def recording_errors(
    sequence: ImuSequence, pieces: Sequence[Piece]
) -> tuple[dict[str, float], pd.DataFrame]:
    """Compute the errors of a network's displacements in each piece of a recording.

    Returns:
        The length `path_m` of the true path that was compared [m], and `FIGURES`. It is 0, and they
        are unknown, if the device hardly moved: errors at rest are related to nothing, and would
        count in means of ratios like those of a walk.
        `blocks_of` each `metric` "rms_1s_m" to "rms_30s_m" [m^2]. For waypoints, their residuals
        replace the 10 s errors.

    Raises:
        InputError: as for `known_truth`.
    """
    kind, known = known_truth(sequence)
    total_direction, rows = Direction(), []
    for k, piece in enumerate(pieces):
        weighted = weighted_force(piece.stream.windows())
        total_direction += direction(weighted, piece.displacement_N, TICKS_PER_SECOND)
        of_kind = (
            _waypoints(piece, known)
            if kind == "waypoints"
            else _positions(piece, known, sequence.truth)
        )
        rows += [(metric, k, seconds, errors) for metric, seconds, errors in of_kind]
    table = pd.DataFrame(rows, columns=["metric", "piece", "second", "error"])
    table = table.explode(["second", "error"]).astype({"second": float, "error": float})
    table["squares"] = table["error"] ** 2
    by_metric = table.groupby("metric")
    paths = table[table["metric"] == "path"].groupby("piece")["error"].sum()
    path = float(paths.sum())
    if path < _MIN_PATH_M:
        return {"path_m": 0.0, **dict.fromkeys(FIGURES, np.nan)}, blocks_of(table[:0])
    rms = np.sqrt(by_metric["squares"].mean())
    usual_path = float((paths**2).sum()) / path  # of a piece, weighted by lengths
    figures = {
        "path_m": path,
        **{name: rms.get(name, np.nan) for name in FIGURES},
        "ate_fit_percent": 100.0 * rms.get("ate_fit_m", np.nan) / usual_path,
        "length_ratio": by_metric["error"].sum()["length"] / path,
        "direction_deg": abs(np.degrees(total_direction.turn)),
        "nis": rms.get("nis", np.nan) ** 2,
    }
    if kind == "waypoints":
        table["metric"] = table["metric"].replace("ate_fit_m", "rms_10s_m")
    return figures, blocks_of(table[table["metric"].str.startswith("rms")])


def blocks_of(errors: pd.DataFrame) -> pd.DataFrame:
    """Return the sum of `squares` and their `count` in blocks of 30 s, numbered by `metric`.

    Errors have the columns `metric`, `piece`, `second` and `squares`.
    """
    by = ["metric", "piece", errors["second"] // BLOCK_SECONDS]
    sums = errors.groupby(by)["squares"].agg(squares="sum", count="count").reset_index("metric")
    return sums.assign(block=sums.groupby("metric").cumcount())


def _positions(piece: Piece, known: PositionTrack, poses: Trajectory | None) -> _Errors:
    """Yield the errors at known positions; poses also tell the yaw at each tick."""
    track = piece.track()
    ticks = piece.stream.ticks[: len(track)]
    if poses is None:
        bad = gaps_and_jumps(known.time, known.position_W)
        at = _AtTicks(track, *_interpolated(ticks, known, bad))
        turns = {h: at.turn_of_stretches(max(h, STRETCH_SECONDS)) for h in HORIZONS}
    else:
        at = _AtTicks(track, *_interpolated(ticks, known, is_gap(np.diff(known.time))))
        finite = np.isfinite(at.truth)
        if finite.sum() < 2:
            return
        levelled = Rotation.from_matrix(piece.stream.R_NB[: len(track)])
        yaw_WN = yaw_of(poses.at(ticks).attitude_WB * levelled.inv())
        turn = np.where(finite, np.exp(1j * yaw_WN), np.nan)
        turns = dict.fromkeys(HORIZONS, turn)
        seconds, track, truth = ticks[finite] - ticks[0], track[finite], at.truth[finite]
        yield "ate_fit_m", seconds, np.abs(fit_yaw_and_position(track, truth) - truth)
        placed = truth[0] + turn[finite][0] * (track - track[0])
        yield "ate_first_m", seconds, np.abs(placed - truth)
    yield from _along_the_path(at, piece, turns)


def _interpolated(
    ticks: FloatArray, known: PositionTrack, bad: BoolArray
) -> tuple[Complex, np.ndarray]:
    """Return positions at the ticks (K,), NaN across bad steps, and how many are before each."""
    time, position_W = known.time, known.position_W
    before = np.searchsorted(time, ticks, side="right") - 1
    inside = (before >= 0) & (before < len(bad))
    inside[inside] = ~bad[before[inside]]
    xy = np.interp(ticks, time, planar(position_W))
    breaks = np.searchsorted(time[1:][bad], ticks, side="right")
    return np.where(inside, xy, complex(np.nan, np.nan)), breaks


def _along_the_path(at: _AtTicks, piece: Piece, turns: Mapping[int, Complex]) -> _Errors:
    """Yield the errors over all horizons, given exp(i yaw) from N to W at each tick for each."""
    estimated, true, start = at.displacements(2)
    legs = start % _LEG == 0
    yield "path", TICK_SECONDS * start[legs], np.abs(true[legs])
    yield "length", TICK_SECONDS * start[legs], np.abs(estimated[legs])
    for horizon in HORIZONS:
        estimated, true, start = at.displacements(horizon)
        turn = turns[horizon][start]
        known = np.isfinite(turn)
        seconds = TICK_SECONDS * start[known]
        if horizon == 1:  # the windows themselves
            estimated = piece.windows[start]
            yield "nis", seconds, _nis(piece, start[known], np.conj(turn[known]) * true[known])
        apart = np.abs(turn * estimated - true)[known]
        if len(apart) >= _MIN_DISPLACEMENTS:
            yield f"rms_{horizon}s_m", seconds, apart
    yield from _stretches(at)


def _waypoints(piece: Piece, known: PositionTrack) -> _Errors:
    track = piece.track()
    ticks = piece.stream.ticks[: len(track)]
    inside = (known.time >= ticks[0]) & (known.time <= ticks[-1])
    time, truth = known.time[inside], planar(known.position_W[inside])
    if len(time) < 3:
        return
    estimated = np.interp(time, ticks, track)
    seconds = time - ticks[0]
    yield "ate_fit_m", seconds, np.abs(fit_yaw_and_position(estimated, truth) - truth)
    yield "path", seconds[1:], np.abs(np.diff(truth))
    yield "length", seconds[1:], np.abs(np.diff(estimated))


def planar(position: NDArray[np.floating[Any]]) -> Complex:
    """Return horizontal positions x + iy (n,) of positions (n, 2 or 3)."""
    return np.asarray(position[:, 0] + 1j * position[:, 1])


def fit_yaw_and_position(
    track: Complex, truth: Complex, part: BoolArray | slice = slice(None)
) -> Complex:
    """Fit a track (n,) to the truth (n,) by least squares in yaw and position, or by a part."""
    centre, target = track[part].mean(), truth[part].mean()
    turn = np.vdot(track[part] - centre, truth[part] - target)
    return np.asarray(target + np.exp(1j * np.angle(turn)) * (track - centre))


def _stretches(at: _AtTicks) -> _Errors:
    """Yield position errors in % of the path after fitting each half-overlapping stretch."""
    span = round(STRETCH_SECONDS / TICK_SECONDS)
    unbroken = at.unbroken(span)
    for start in span // 2 * np.flatnonzero(unbroken[:: span // 2]):
        part = slice(start, start + span + 1)
        track, truth = at.track[part], at.truth[part]
        path = float(np.abs(np.diff(truth[::_LEG])).sum())
        if path >= 5.0:  # else stationary: there is no path to relate errors to
            percent = 100.0 * np.abs(fit_yaw_and_position(track, truth) - truth) / path
            yield "stretch_percent", np.full_like(percent, TICK_SECONDS * start), percent


def _nis(piece: Piece, start: np.ndarray, true_N: Complex) -> FloatArray:
    """Return the root of the NIS (n,) of the horizontal error, scaled from two axes to three."""
    error = piece.windows[start] - true_N
    vector = np.stack([error.real, error.imag], axis=1)
    covariance = piece.covariance_N[start, :2, :2]
    nis = np.einsum("ni,ni->n", vector, np.linalg.solve(covariance, vector[..., None])[..., 0])
    return np.asarray(np.sqrt(1.5 * nis))
