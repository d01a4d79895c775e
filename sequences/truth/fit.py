"""Fit of a recording's ground truth to its IMU: time offset, axes, tilted world, drift of yaw.

Both measure the same rotations, so the offset of their clocks and the constant rotation between
their axes follow from gyroscope and differentiated attitude
(`stario.sequences.attitude.alignment`).

Then the yaw's drift has two causes. Rotated by the true attitude, a gyroscope with a scale error s
and a constant bias b in its axes turns by psi about the vertical, which drifts from the true turn:

    psi_true - psi = -s / (1 + s) (psi - psi_0) - b . integral of up_B + const

Along the levelled attitude instead, a scale error that tilts the device is mistaken for a bias in
its axes, and the removal of that bias hides part of the error or feigns one.

Phones whose system removes the bias still have scale errors of a few percent; on a walk in loops
these add up, and neither gravity nor the network makes them observable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import even_grid, interpolated, trapezoids
from stario.sequences.attitude.alignment import BodyAlignment, align_tracked_body, clock_offset
from stario.sequences.attitude.levelling import BIAS_SIGMA
from stario.sequences.attitude.mounts import Rotations
from stario.sequences.attitude.rotations import GyroIntegral
from stario.sequences.attitude.stacks import composed
from stario.sequences.clean_samples import (
    clean_samples,
    compared_samples,
    longest_unbroken,
    middle_part,
)
from stario.sequences.conventions import SAME_AXES, axes_matrix, axes_named
from stario.sequences.errors import InputError
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence
from stario.sequences.time_order import MAX_IMU_GAP

MAX_OFFSET_S = 5.0
"""Largest time offset searched, in either direction [s]."""

_RATE = 100.0
_NEAR_RAD = np.deg2rad(20.0)
_MIN_CORRELATION, _MIN_AGREEING = 0.9, 0.7
"""Correlation, and share of agreeing truth samples, below which gyroscope and truth did not measure
the same rotations; published recordings have at least 0.97 and 0.999. An even gait correlates with
itself a few steps later by up to 0.94, but with a lower share."""

_JUMPED_RAD, _REMOUNTED_RAD = np.deg2rad(15.0), np.deg2rad(30.0)
"""Change of the world, and of the mount, that the gyroscope did not measure: a jump."""

EDGE_S = 0.05
"""An offset this close [s] to the largest one searched is the end of the search, not a maximum."""


@dataclass(frozen=True, eq=False)
class TruthFit:
    """Result of `fit_truth`.

    Attributes:
        time_offset: offset to be added to the truth's time [s].
        correlation: correlation of gyroscope and differentiated attitude after all corrections.
        R_TB: rotation from the IMU's axes to those whose attitude the truth gives.
        tilt: angle between the vertical axis of the truth's world and gravity [rad].
        agreeing: share of the truth's samples that agree with the gyroscope.
        jumps: number of jumps of the truth's attitude that the gyroscope did not measure.
        accel_against: loss of the mean vertical force if `R_TB` is applied, as a share of the mean
            force: if it is large, the accelerometer agrees with the truth, not the gyroscope.
        one_axis: whether the device turns about a single axis, which determines neither the offset
            nor `R_TB`.
        applied_axes: the recording's `axes`, in which `R_TB` is given.
        times: (M,) [s] on the IMU's clock, for a figure.
        speed: (M,) angular rate of the truth at `times` [rad/s], NaN where unknown.
    """

    time_offset: float
    correlation: float
    R_TB: Rotation
    tilt: float
    agreeing: float
    jumps: int
    accel_against: float
    one_axis: bool
    applied_axes: str
    times: FloatArray
    speed: FloatArray

    @property
    def misalignment(self) -> float:
        """Angle between the IMU's axes and the truth's [rad]."""
        return float(self.R_TB.magnitude())

    @property
    def consistent(self) -> bool:
        """Whether both measured the same rotations, so that offset and axes are meaningful."""
        return abs(self.time_offset) < MAX_OFFSET_S - EDGE_S and self.agrees

    @property
    def agrees(self) -> bool:
        """Whether both rotations agree after all corrections, whatever the offset."""
        return self.correlation > _MIN_CORRELATION and self.agreeing > _MIN_AGREEING

    def axes(self) -> str | None:
        """Return the truth's axes in the IMU's; None if they are the same or none is near."""
        text = axes_named(self.R_TB.as_matrix())
        left = Rotation.from_matrix(axes_matrix(text)).inv() * self.R_TB
        near = self.consistent and left.magnitude() < _NEAR_RAD
        return text if near and text != SAME_AXES else None

    def axes_remedy(self) -> str | None:
        """Return how to rotate the IMU to the truth's axes; None if that is not needed or fits.

        The option refers to the axes in the file, so it includes the rotation already applied.
        """
        further = self.axes()
        if further is None:
            return None
        text = axes_named(axes_matrix(further) @ axes_matrix(self.applied_axes))
        return "omit `--axes`" if text == SAME_AXES else f"pass `--axes={text}`"


def fit_truth(sequence: ImuSequence) -> TruthFit:
    """Compare gyroscope and true attitude over up to 10 minutes.

    Raises:
        InputError: there is no truth, or less than 10 s in which both measured the same rotations.
    """
    if sequence.truth is None or sequence.truth.valid.sum() < 2:
        raise InputError(f"{sequence.name}: truth", "none", "a true trajectory to compare with")
    time, gyro, accel = compared_samples(sequence)
    truth = sequence.truth
    pose = truth.at(_grid(truth.time[0], truth.time[-1]))
    coarse = clock_offset(time, gyro, pose.time, pose.attitude_WB, pose.valid)
    truth = replace(truth, time=truth.time + coarse)
    grid = _grid(max(time[0], truth.time[0]), min(time[-1], truth.time[-1]))
    pose = truth.at(grid)
    gaps = np.flatnonzero(np.diff(time) > MAX_IMU_GAP)
    valid = pose.valid & ~np.isin(np.searchsorted(time, grid) - 1, gaps)
    aligned = align_tracked_body(time, gyro, accel, grid, pose.attitude_WB, valid)
    gyro_B = GyroIntegral(time, gyro)
    fitted = grid + aligned.lag
    both = Rotations(fitted, pose.attitude_WB, gyro_B.attitude(fitted))
    begin, end, mount = max(aligned.mounts, key=lambda piece: piece[1] - piece[0])
    piece = np.searchsorted(fitted, [begin, end])
    return TruthFit(
        time_offset=coarse + aligned.lag,
        correlation=aligned.correlation,
        R_TB=mount,
        tilt=float(aligned.leveling_WW.magnitude()),
        agreeing=float(aligned.valid.sum() / max(valid.sum(), 1)),
        jumps=_jumps(gyro_B, time[gaps], aligned, fitted),
        accel_against=_accel_against(
            interpolated(fitted, time, accel)[aligned.valid],
            pose.attitude_WB[aligned.valid],
            mount,
        ),
        one_axis=both.about_one_axis((piece[0], piece[1])),
        applied_axes=sequence.axes,
        times=fitted,
        speed=_speed(pose.attitude_WB, pose.valid),
    )


def _jumps(gyro_B: GyroIntegral, gaps: FloatArray, aligned: BodyAlignment, time: FloatArray) -> int:
    """Count changes of mount or world that no gyroscope measured, outside its `gaps` [s]."""
    count = 0
    for (_, before, mount), (after, _, other) in pairwise(aligned.mounts):
        if ((gaps > before - 1.0) & (gaps < after)).any():
            continue
        ends = np.searchsorted(time, [before, after])
        true, measured = aligned.attitude_WB[ends], gyro_B.attitude(time[ends])
        turned = (true[0].inv() * true[1]) * (measured[0].inv() * measured[1]).inv()
        jumped = turned.magnitude() > _JUMPED_RAD
        count += bool(jumped or (mount.inv() * other).magnitude() > _REMOUNTED_RAD)
    return count


def _accel_against(force_B: FloatArray, attitude_WT: Rotation, R_TB: Rotation) -> float:
    if not len(force_B):
        return 0.0
    upright, turned = (
        float(attitude_WT.apply(force).mean(axis=0)[2]) for force in (force_B, R_TB.apply(force_B))
    )
    return (upright - turned) / max(float(np.linalg.norm(force_B, axis=1).mean()), 1e-9)


def _grid(start: float, stop: float) -> FloatArray:
    return even_grid(start, max(stop, start + 2.0 / _RATE), 1.0 / _RATE)


def _speed(attitude: Rotation, valid: BoolArray) -> FloatArray:
    """Return the angular rate [rad/s] around each sample of an even grid, NaN where unknown."""
    stride = 4
    speed = np.full(len(valid), np.nan)
    if len(valid) > stride:
        half = stride // 2
        angle = composed(attitude[:-stride].inv(), attitude[stride:]).magnitude()
        known = valid[:-stride] & valid[stride:]
        speed[half : half + len(angle)] = np.where(known, angle * _RATE / stride, np.nan)
    return speed


_MIN_TURNED_RAD = 0.3
"""Minimum deviation of the true yaw from an even rotation that separates scale from bias."""

_RESIDUAL_RAD, _LASTING_S = math.radians(0.5), 5.0
"""Typical residual of a recording [rad] and the time for which it lasts [s]."""


@dataclass(frozen=True)
class YawDrift:
    """Drift of the gyroscope's yaw relative to the true one.

    Attributes:
        scale: scale error of the gyroscope, positive if it reads too high.
        bias: its mean bias about the vertical [rad/s].
        residual_rms: root mean square of the residual yaw [rad].
    """

    scale: float
    bias: float
    residual_rms: float


def yaw_drift(sequence: ImuSequence, fit: TruthFit) -> YawDrift | None:
    """Fit scale and bias over the longest unbroken stretch of the part that `fit_truth` uses.

    None if the device turned too little. InputError as for `clean_samples`.
    """
    assert sequence.truth is not None  # a fit of it exists
    time, gyro, _ = clean_samples(middle_part(sequence))
    part = longest_unbroken(time)
    time, gyro = time[part], gyro[part]
    truth = replace(sequence.truth, time=sequence.truth.time + fit.time_offset)
    pose = truth.at(time)
    attitude_WB = composed(pose.attitude_WB, fit.R_TB)
    both = pose.valid[1:] & pose.valid[:-1]
    if both.sum() < 3:
        return None
    up_B = attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
    turns = trapezoids(time, np.sum(gyro * up_B, axis=1, keepdims=True))[both]
    true_turns = composed(attitude_WB[1:], attitude_WB[:-1].inv()).as_rotvec()[both, 2]
    psi_true, psi = np.cumsum(true_turns), np.cumsum(turns)
    even = np.column_stack([np.ones(len(psi)), np.cumsum(np.diff(time)[both])])
    # The true turn is tested, so that a gyroscope that measures only a fiftieth is reported too.
    uneven = psi_true - even @ np.linalg.lstsq(even, psi_true, rcond=None)[0]
    if float(uneven.std()) < _MIN_TURNED_RAD:
        return None
    upward = np.cumsum(trapezoids(time, up_B)[both], axis=0)
    columns = np.column_stack([even[:, 0], upward, psi])
    # Components of the bias that hardly show are held near zero: they would absorb anything else.
    weight = math.sqrt(even[-1, 1] / _LASTING_S / len(psi)) / _RESIDUAL_RAD
    rows = np.concatenate([weight * columns, np.eye(5)[1:4] / BIAS_SIGMA])
    drift = np.append(weight * (psi_true - psi), np.zeros(3))
    fitted, *_ = np.linalg.lstsq(rows, drift, rcond=None)
    residual_rms = math.sqrt(float(np.square(psi_true - psi - columns @ fitted).mean()))
    return YawDrift(
        scale=float(-fitted[4] / (1.0 + fitted[4])),
        bias=float(-fitted[1:4] @ up_B[pose.valid].mean(axis=0)),
        residual_rms=residual_rms,
    )
