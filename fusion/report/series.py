"""Columns of a track over time as drawn by the report: thinned, with standard deviations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stario.fusion.state import Track
from stario.sequences.arrays import evenly_spaced, interpolated
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.drawing.figures import indices_after_gaps
from stario.sequences.sequence import MAX_TRUTH_GAP, BoolArray, FloatArray, Trajectory

MAX_POINTS = 1000
"""Maximum number of poses drawn per track; a screen shows no more, and the file stays small."""


Bias = tuple[FloatArray, FloatArray]
"""A bias (N, 3) and its sigma."""


@dataclass(frozen=True, eq=False)
class Series:
    """A track as columns of N rows, NaN where poses are not valid and once in each gap.

    Attributes:
        time: (N,) time since the recording's first sample [s].
        position: (N, 3) [m].
        speed: (N,) [m/s].
        yaw: (N,) [deg], unwrapped.
        position_covariance: (N, 3, 3) [m^2], or None.
        speed_sigma: (N,) [m/s], or None.
        yaw_sigma: (N,) [deg], or None.
        gyro_bias: (N, 3) [deg/s] and its sigma, or None.
        accel_bias: (N, 3) [m/s^2] and its sigma, or None.
    """

    time: FloatArray
    position: FloatArray
    speed: FloatArray
    yaw: FloatArray
    position_covariance: FloatArray | None = None
    speed_sigma: FloatArray | None = None
    yaw_sigma: FloatArray | None = None
    gyro_bias: Bias | None = None
    accel_bias: Bias | None = None

    @property
    def height_sigma(self) -> FloatArray | None:
        """Standard deviation of the height (N,) [m]."""
        if self.position_covariance is None:
            return None
        return np.asarray(np.sqrt(self.position_covariance[:, 2, 2]), dtype=np.float64)

    @property
    def horizontal_sigma(self) -> FloatArray | None:
        """Larger semi-axis of the horizontal 1-sigma ellipse (N,) [m]."""
        if self.position_covariance is None:
            return None
        largest = np.linalg.eigvalsh(self.position_covariance[:, :2, :2])[:, 1]
        return np.asarray(np.sqrt(largest), dtype=np.float64)


def track_series(track: Track, aligned: Trajectory, start: float) -> Series:
    """Return the columns of a track.

    Args:
        track: track, with biases and covariance if it has them.
        aligned: its trajectory as drawn, pose for pose.
        start: time of the recording's first sample [s].
    """
    _, rows, shown = _rows(aligned)
    plain = trajectory_series(aligned, start)
    if track.covariance is None:
        return plain
    P, velocity = track.covariance[rows], track.trajectory.velocity_W
    sigma = np.sqrt(P[:, range(15), range(15)])

    def bias(values: FloatArray | None, scale: float, part: slice) -> Bias | None:
        if values is None:
            return None
        return np.where(shown[:, None], scale * values[rows], np.nan), scale * sigma[:, part]

    return replace(
        plain,
        speed_sigma=None if velocity is None else _speed_sigma(velocity[rows], P[:, 3:6, 3:6]),
        yaw_sigma=np.degrees(sigma[:, 2]),
        gyro_bias=bias(track.b_g, float(np.degrees(1.0)), slice(9, 12)),
        accel_bias=bias(track.b_a, 1.0, slice(12, 15)),
    )


def trajectory_series(trajectory: Trajectory, start: float) -> Series:
    """Return the columns of a trajectory; without velocities, speed is taken from positions."""
    time, rows, shown = _rows(trajectory)
    yaw = np.degrees(np.unwrap(yaw_of(trajectory.attitude_WB[rows])))
    covariance = trajectory.position_covariance_W
    if trajectory.velocity_W is None:
        speed = _speed_of(trajectory)[rows]
    else:
        speed = np.linalg.norm(trajectory.velocity_W[rows], axis=1)
    return Series(
        time - start,
        np.where(shown[:, None], trajectory.position_W[rows], np.nan),
        np.where(shown, speed, np.nan),
        np.where(shown, yaw, np.nan),
        None if covariance is None else covariance[rows],
    )


def ellipse(covariance: FloatArray) -> FloatArray:
    """Return the closed outline (49, 2) of the horizontal 3-sigma ellipse about zero [m].

    Args:
        covariance: (3, 3) or (2, 2) [m^2].
    """
    values, axes = np.linalg.eigh(covariance[:2, :2])
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outline: FloatArray = (axes * 3.0 * np.sqrt(np.maximum(values, 0.0))) @ circle
    return outline.T


def _rows(
    trajectory: Trajectory,
) -> tuple[FloatArray, np.ndarray[tuple[int], np.dtype[np.intp]], BoolArray]:
    """Return the times (N,) and rows (N,) drawn of a track, and which of them are shown.

    At most `MAX_POINTS` poses are drawn, and in the middle of each gap a row that is not shown.
    """
    time = trajectory.time
    rows = evenly_spaced(len(time), MAX_POINTS)
    after = np.unique(np.searchsorted(rows, indices_after_gaps(time, MAX_TRUTH_GAP)))
    middle = 0.5 * (time[rows[after - 1]] + time[rows[after]])
    return (
        np.insert(time[rows], after, middle),
        np.insert(rows, after, rows[after]),
        np.insert(trajectory.valid[rows], after, False),
    )


def _speed_sigma(velocity: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the sigma of the norm of v to first order: sqrt(u'Pu), u the direction of v."""
    norm = np.linalg.norm(velocity, axis=1, keepdims=True)
    # At rest there is no direction: take the largest variance of any.
    largest = np.linalg.eigvalsh(covariance)[:, -1]
    u = velocity / np.maximum(norm, 1e-9)
    along = np.einsum("ni,nij,nj->n", u, covariance, u)
    return np.sqrt(np.where(norm[:, 0] > 1e-6, along, largest))


def _speed_of(trajectory: Trajectory) -> FloatArray:
    """Return the speed (N,) by central differences over one second, to suppress noise of poses."""
    t, half = trajectory.time, 0.5
    valid = np.flatnonzero(trajectory.valid)
    if len(valid) < 2:
        return np.full(len(t), np.nan)
    first, last = t[valid[0]], t[valid[-1]]
    before, after = (np.clip(t + sign * half, first, last) for sign in (-1.0, 1.0))
    ends = [interpolated(at, t[valid], trajectory.position_W[valid]) for at in (before, after)]
    span = np.maximum(after - before, 1e-9)
    return np.asarray(np.linalg.norm(ends[1] - ends[0], axis=1) / span)
