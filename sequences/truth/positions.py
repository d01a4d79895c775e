"""Comparison of the truth with the accelerometer: axes and signs, scale of the positions.

The second difference of the positions over h is the mean of the acceleration under a triangle, so
it must equal the second difference of the specific force, rotated by the true attitude and
integrated twice, plus gravity:

    (p(t + h) - 2 p(t) + p(t - h)) / h^2  =  mean of  R_WB f  +  g

Gravity and the accelerometer's bias are nearly constant: they go with the mean of either side. What
is left must agree in every axis, whichever axis of the world is vertical. With h = 0.3 s it keeps
the bounce of a step and averages the noise of positions; the lever arm between IMU and tracked
point, a clock error of a few hundredths of a second and noise reduce the correlation, but turn or
mirror nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import correlation, even_grid, integral, interpolated
from stario.sequences.clean_samples import compared_samples
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence, Trajectory
from stario.sequences.time_order import MAX_IMU_GAP

_H_S = 0.3
_MIN_ROWS = 50
"""Minimum number of instants, half of h apart, that are compared."""

_MIN_MOTION = 0.12
"""Scatter of the acceleration along an axis [m/s^2] from which it is compared."""

_OUTLIER = 3.0
"""Factor on the 98th percentile above which a row is left out: a jump of the positions."""


@dataclass(frozen=True, eq=False)
class PositionFit:
    """Result of `fit_positions`.

    Attributes:
        axes: (A,) the compared axes of the world, in which the device moves enough: all three, or
            only the horizontal ones, 0 and 1.
        correlation: correlation of both accelerations as they are.
        turned_correlation: the same after rotating and mirroring by `Q_PW`.
        Q_PW: (3, 3) orthogonal matrix from the attitude's world to that of the positions;
            its determinant is -1 if they are mirrored.
        scale: size of the positions' acceleration relative to the accelerometer's: their unit.
    """

    axes: tuple[int, ...]
    correlation: float
    turned_correlation: float
    Q_PW: FloatArray
    scale: float

    @property
    def mirrored(self) -> bool:
        """Whether the positions are those of a mirrored world."""
        return bool(np.linalg.det(self.Q_PW) < 0.0)

    @property
    def turned(self) -> float:
        """Angle of the positions' rotation [rad], after mirroring all three axes if `mirrored`."""
        proper = -self.Q_PW if self.mirrored else self.Q_PW
        return float(Rotation.from_matrix(proper).magnitude())


def fit_positions(sequence: ImuSequence, time_offset: float) -> PositionFit | None:
    """Compare the accelerations of positions and accelerometer over up to 10 minutes.

    The true attitude agrees with the gyroscope if its time is moved by an offset [s]. None if there
    is too little motion or overlap, or the positions are constant. InputError as for
    `clean_samples`, or fewer than two valid poses.
    """
    assert sequence.truth is not None
    time, _, accel = compared_samples(sequence)
    truth = replace(sequence.truth, time=sequence.truth.time + time_offset)
    moved, felt = _accelerations(time, accel, truth)
    if len(felt) < _MIN_ROWS:
        return None
    used = _inliers(moved) & _inliers(felt)
    moved, felt = (rows[used] - rows[used].mean(axis=0) for rows in (moved, felt))
    enough = felt.std(axis=0) > _MIN_MOTION
    axes = (0, 1, 2) if enough.all() else (0, 1)
    if not enough[:2].all() or not moved.any():
        return None
    moved, felt = moved[:, axes], felt[:, axes]
    U, _, Vt = np.linalg.svd(moved.T @ felt)
    turned = felt @ (U @ Vt).T
    Q_PW = np.eye(3)
    Q_PW[np.ix_(axes, axes)] = U @ Vt
    return PositionFit(
        axes=axes,
        correlation=correlation(moved, felt),
        turned_correlation=correlation(moved, turned),
        Q_PW=Q_PW,
        # The slope of a regression would be reduced by noise of the accelerometer's side.
        scale=math.sqrt(float(np.square(moved).sum() / np.square(felt).sum())),
    )


def _accelerations(
    time: FloatArray, accel: FloatArray, truth: Trajectory
) -> tuple[FloatArray, FloatArray]:
    """Return both sides (M, 3) [m/s^2] at instants whose surroundings have no gap."""
    pose = truth.at(time)
    force_W = pose.attitude_WB.apply(accel)
    steps = np.diff(time)
    gap = (steps > MAX_IMU_GAP) | ~(pose.valid[1:] & pose.valid[:-1])
    gaps = np.append(0, np.cumsum(gap))
    ticks = even_grid(time[0] + _H_S, time[-1] - _H_S, 0.5 * _H_S)
    first = np.searchsorted(time[1:], ticks - _H_S, side="right")  # 0 too if rounded to before it
    ticks = ticks[gaps[first] == gaps[np.searchsorted(time, ticks + _H_S)]]
    fallen = integral(time, integral(time, force_W - force_W[pose.valid].mean(axis=0)))
    known = truth.valid
    return (
        _second_difference(ticks, truth.time[known], truth.position_W[known]),
        _second_difference(ticks, time, fallen),
    )


def _second_difference(ticks: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    before, here, after = (interpolated(ticks + by, time, values) for by in (-_H_S, 0.0, _H_S))
    return np.asarray((after - 2.0 * here + before) / _H_S**2)


def _inliers(rows: FloatArray) -> BoolArray:
    size = np.linalg.norm(rows - np.median(rows, axis=0), axis=1)
    return np.asarray(size <= _OUTLIER * np.percentile(size, 98))
