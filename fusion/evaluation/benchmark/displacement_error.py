"""Errors of a network alone on one recording, for any kind of ground truth.

All positions are horizontal and written x + iy. The track is given in N, whose yaw relative to the
world is unknown; how it is determined depends on the truth:

- poses: displacements over a horizon are rotated by the true yaw at the horizon's start; the track
  as a whole is fitted in yaw and position, or aligned with the first pose.
- positions: the yaw is fitted over 20 s (or the horizon, if longer) from the displacement's start.
- waypoints: the track is fitted to all waypoints in yaw and position.

A displacement is compared only if the truth has neither gap nor jump between its ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stario.fusion.evaluation.benchmark.aligned import Aligned, AlignedPiece, Predictions
from stario.fusion.imu.direction import Complex, Direction, direction, weighted_force
from stario.sequences.levelled_stream import TICK_SECONDS, TICKS_PER_SECOND
from stario.sequences.sequence import BoolArray, FloatArray

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
    "nis_ekf": "mean NIS of the EKF in its default settings (expected: 3), if requested",
}
"""Figures of a recording and their meaning; NaN if its kind of truth does not provide one."""


_MIN_PATH_M = 1.0
"""Length of the true path [m] below which a recording is not compared."""


class RecordingErrors(NamedTuple):
    """Errors of one network on one recording.

    Attributes:
        path_m: length of the true path that was compared [m]; 0 if the device hardly moved: errors
            at rest are related to nothing, and would count in means of ratios like those of a walk.
        figures: figures by name, see `FIGURES`.
        blocks: (B, 2) arrays by horizon ("1", "10", "30" s): sum of squared errors [m^2] and number
            of errors in each block of 30 s. For waypoints, their residuals are listed under "10".
    """

    path_m: float
    figures: dict[str, float]
    blocks: dict[str, FloatArray]


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


@dataclass(eq=False)
class _Sums:
    """Sums over the pieces of a recording."""

    squares: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    path: float = 0.0
    length: float = 0.0
    blocks: dict[str, list[FloatArray]] = field(default_factory=dict)

    def add(self, measure: str, errors: FloatArray) -> None:
        finite = errors[np.isfinite(errors)]
        self.squares.setdefault(measure, []).append((float(np.sum(finite**2)), len(finite)))

    def rms(self, measure: str) -> float:
        total, count = np.sum(self.squares.get(measure, [(0.0, 0.0)]), axis=0)
        return float(np.sqrt(total / count)) if count else float("nan")

    def add_blocks(self, measure: str, errors: FloatArray) -> None:
        """Add errors (K,) by start tick, NaN where unknown."""
        known = np.flatnonzero(np.isfinite(errors))
        if len(known) >= _MIN_DISPLACEMENTS:
            self.add(measure, errors)
            sums = block_sums(np.asarray(TICK_SECONDS * known), errors[known] ** 2)
            self.blocks.setdefault(measure, []).append(sums)


def recording_errors(aligned: Aligned, found: Sequence[Predictions]) -> RecordingErrors:
    """Compute the errors of a network's predictions on each piece of a recording."""
    sums = _Sums()
    add_errors = {"poses": _poses, "positions": _positions, "waypoints": _waypoints}[aligned.kind]
    total_direction = Direction()
    paths = []
    for piece, predictions in zip(aligned.pieces, found, strict=True):
        before = sums.path
        add_errors(piece, predictions, sums)
        paths.append(sums.path - before)
        weighted = weighted_force(piece.stream.windows())
        total_direction += direction(weighted, predictions.displacement_N, TICKS_PER_SECOND)
    if sums.path < _MIN_PATH_M:
        unknown = dict.fromkeys(FIGURES, float("nan"))
        return RecordingErrors(0.0, unknown, {})
    fitted = sums.rms("fit")
    usual_path = float(np.square(paths).sum()) / sums.path  # of a piece, weighted by their lengths
    figures = {
        "ate_fit_m": fitted,
        "ate_fit_percent": 100.0 * fitted / usual_path,
        "ate_first_m": sums.rms("first"),
        "length_ratio": sums.length / sums.path,
        **{f"rms_{h}s_m": sums.rms(str(h)) for h in HORIZONS},
        "stretch_percent": 100.0 * sums.rms("stretch"),
        "direction_deg": abs(np.degrees(total_direction.turn)),
        "nis": sums.rms("nis") ** 2,
        "nis_ekf": float("nan"),
    }
    blocks = {name: np.concatenate(parts) for name, parts in sums.blocks.items()}
    return RecordingErrors(sums.path, figures, blocks)


def _poses(piece: AlignedPiece, predictions: Predictions, sums: _Sums) -> None:
    at = _at_ticks(piece, predictions)
    track, truth = at.track, at.truth
    finite = np.isfinite(truth)
    if finite.sum() < 2:
        return
    fitted = fit_yaw_and_position(track[finite], truth[finite])
    sums.add("fit", np.abs(fitted - truth[finite]))
    turn = np.exp(1j * piece.yaw_WN[: len(track)])
    first = np.flatnonzero(finite)[0]
    on_first = truth[first] + turn[first] * (track - track[first])
    sums.add("first", np.abs(on_first - truth)[finite])
    _along_the_path(at, predictions, dict.fromkeys(HORIZONS, turn), sums)


def _positions(piece: AlignedPiece, predictions: Predictions, sums: _Sums) -> None:
    at = _at_ticks(piece, predictions)
    turns = {h: at.turn_of_stretches(max(h, STRETCH_SECONDS)) for h in HORIZONS}
    _along_the_path(at, predictions, turns, sums)


def _along_the_path(
    at: _AtTicks, predictions: Predictions, turns: Mapping[int, Complex], sums: _Sums
) -> None:
    """Add the errors over all horizons, given exp(i yaw) from N to W at each tick for each."""
    _lengths(at, sums)
    for horizon in HORIZONS:
        estimated, true, start = at.displacements(horizon)
        turn = turns[horizon][start]
        if horizon == 1:  # the windows themselves
            estimated = _windows_xy(predictions)[start]
            known = np.isfinite(turn)
            _nis(predictions, start[known], np.conj(turn[known]) * true[known], sums)
        errors = np.full(len(at.track), np.nan)
        errors[start] = np.abs(turn * estimated - true)
        sums.add_blocks(str(horizon), errors)
    _stretches(at, sums)


def _waypoints(piece: AlignedPiece, predictions: Predictions, sums: _Sums) -> None:
    track = predictions.track()[: len(piece.position_W)]
    ticks = piece.stream.ticks[: len(track)]
    inside = piece.waypoint_time <= ticks[-1]
    time, truth = piece.waypoint_time[inside], piece.waypoint_W[inside]
    if len(time) < 3:
        return
    estimated = np.interp(time, ticks, track.real) + 1j * np.interp(time, ticks, track.imag)
    errors = np.abs(fit_yaw_and_position(estimated, truth) - truth)
    sums.add("fit", errors)
    sums.path += float(np.abs(np.diff(truth)).sum())
    sums.length += float(np.abs(np.diff(estimated)).sum())
    sums.blocks.setdefault("10", []).append(block_sums(time - ticks[0], errors**2))


def block_sums(seconds: FloatArray, squares: FloatArray) -> FloatArray:
    """Return (B, 2): sum of squares (n,) and their number, for every block of 30 s with any."""
    block = np.floor(seconds / BLOCK_SECONDS).astype(int)
    rows = np.stack([np.bincount(block, squares), np.bincount(block)], axis=1)
    return np.asarray(rows[rows[:, 1] > 0])


def _at_ticks(piece: AlignedPiece, predictions: Predictions) -> _AtTicks:
    """Return track, truth and its breaks at the ticks common to all."""
    track = predictions.track()
    count = min(len(track), len(piece.position_W))
    return _AtTicks(track[:count], piece.position_W[:count], piece.breaks[:count])


def fit_yaw_and_position(track: Complex, truth: Complex) -> Complex:
    """Fit a track (n,) to the truth (n,) by least squares in yaw and position."""
    centre, target = track.mean(), truth.mean()
    turn = np.vdot(track - centre, truth - target)
    return np.asarray(target + np.exp(1j * np.angle(turn)) * (track - centre))


def _lengths(at: _AtTicks, sums: _Sums) -> None:
    estimated, true, start = at.displacements(2)
    legs = start % _LEG == 0
    sums.path += float(np.abs(true[legs]).sum())
    sums.length += float(np.abs(estimated[legs]).sum())


def _stretches(at: _AtTicks, sums: _Sums) -> None:
    """Add position errors relative to the path [1] after fitting each half-overlapping stretch."""
    span = round(STRETCH_SECONDS / TICK_SECONDS)
    unbroken = at.unbroken(span)
    for start in span // 2 * np.flatnonzero(unbroken[:: span // 2]):
        part = slice(start, start + span + 1)
        track, truth = at.track[part], at.truth[part]
        path = float(np.abs(np.diff(truth[::_LEG])).sum())
        if path < 5.0:  # stationary: there is no path to relate errors to
            continue
        errors = np.abs(fit_yaw_and_position(track, truth) - truth)
        sums.add("stretch", errors / path)


def _nis(predictions: Predictions, start: np.ndarray, true_N: Complex, sums: _Sums) -> None:
    """Add the NIS of the horizontal error, scaled from two axes to three."""
    error = _windows_xy(predictions)[start] - true_N
    vector = np.stack([error.real, error.imag], axis=1)
    covariance = predictions.covariance_N[start, :2, :2]
    nis = np.einsum("ni,ni->n", vector, np.linalg.solve(covariance, vector[..., None])[..., 0])
    sums.add("nis", np.sqrt(1.5 * nis))


def _windows_xy(predictions: Predictions) -> Complex:
    return np.asarray(predictions.displacement_N[:, 0] + 1j * predictions.displacement_N[:, 1])
