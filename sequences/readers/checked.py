"""Parts of a recording as files give them, checked: numbers, rotations, poses, magnetic field."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.rotations import NORM_TOLERANCE
from stario.sequences.errors import ReadError
from stario.sequences.readers.text import IntArray
from stario.sequences.sequence import BoolArray, FloatArray, Magnetometer, Trajectory
from stario.sequences.time_order import increasing_mask

_log = logging.getLogger(__name__)

_HELD_SHARE = 1.0 / 3.0


def checked(path: Path, field: str, values: FloatArray) -> FloatArray:
    """Return values (N,) or (N, K) if all are finite.

    Raises:
        ReadError: one is not; the error names the field and its row, counted from 1.
    """
    good = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    if not good.all():
        k = int(np.argmin(good))
        found = "nan" if np.isnan(values[k]).any() else "inf"
        where = f"row {k + 1}, {field}"
        raise ReadError(path, where, found, "finite numbers", "cut the recording there")
    return values


def finite_rows(path: Path, field: str, values: FloatArray) -> IntArray:
    """Return the rows of values (N,) or (N, K) that are finite, and warn of the others.

    Raises:
        ReadError: most are not finite; the error names the field.
    """
    rows = np.flatnonzero(np.isfinite(values).reshape(len(values), -1).all(axis=1))
    if lost := len(values) - len(rows):
        if lost > len(values) / 2:
            found = f"{lost} of {len(values)} rows that are not finite"
            raise ReadError(path, field, found, "finite numbers")
        count = len(values)
        _log.warning("%s: %s: dropped %d of %d rows that are not finite", path, field, lost, count)
    return rows


def rotations(
    path: Path,
    field: str,
    quat: FloatArray,
    order: str = "wxyz",
    first_row: int = 1,
    rows: IntArray | None = None,
) -> Rotation:
    """Return rotations from unit quaternions.

    Args:
        path: the file, for errors.
        field: name of the quaternions, for errors.
        quat: (N, 4) quaternions.
        order: order of their components, `wxyz` or `xyzw`.
        first_row: number of the first row, for errors.
        rows: rows to return the rotations of; all if None.

    Raises:
        ReadError: a component is not finite or a norm differs from 1 by more than a percent; the
            error names the field and its row.
    """
    rows = np.arange(len(quat)) if rows is None else rows
    quat = quat[rows]
    norm = np.linalg.norm(quat, axis=1)
    bad = ~(np.abs(norm - 1.0) <= NORM_TOLERANCE)
    if bad.any():
        k = int(np.argmax(bad))
        where = f"row {rows[k] + first_row}, {field}"
        raise ReadError(
            path, where, f"norm {norm[k]:.4g}", "a unit quaternion", "cut the recording there"
        )
    return Rotation.from_quat(quat if order == "xyzw" else quat[:, [1, 2, 3, 0]])


def captured_rotations(quat_xyzw: FloatArray) -> tuple[Rotation, BoolArray]:
    """Return rotations from (N, 4) and the mask of those with a unit quaternion, else identity.

    Captures that lose track write zeros, NaN or other numbers instead.
    """
    norm = np.linalg.norm(quat_xyzw, axis=1)
    known = np.isfinite(norm) & (np.abs(norm - 1.0) <= NORM_TOLERANCE)
    return Rotation.from_quat(np.where(known[:, None], quat_xyzw, [0.0, 0.0, 0.0, 1.0])), known


def magnetometer(time: FloatArray, field: FloatArray, held: bool = True) -> Magnetometer | None:
    """Return the finite, non-zero samples of a magnetometer whose times advance; None if none.

    Args:
        time: (N,) sample times [s].
        field: (N, 3) magnetic field [uT].
        held: whether to skip repeated values if more than a third are repeated: some apps write
            the last reading at the IMU's rate.
    """
    known = np.isfinite(field).all(axis=1) & np.isfinite(time) & field.any(axis=1)
    time, field = time[known], field[known]
    keep = increasing_mask(time)
    if held and len(field) > 1:
        fresh = np.append(True, np.diff(field, axis=0).any(axis=1))
        if fresh.mean() < 1.0 - _HELD_SHARE:
            keep &= fresh
    return Magnetometer(time[keep], field[keep]) if keep.any() else None


def pose_mask(path: Path, time: FloatArray) -> BoolArray:
    """Return which of a truth's times (N,) [s] to keep, so that they increase.

    Repeated rows are usual; a warning counts the others that are dropped.
    """
    keep = increasing_mask(time)
    if (np.diff(time) < 0.0).any():
        count = int((~keep).sum())
        _log.warning(
            "%s: dropped %d of %d poses: their times do not increase", path, count, len(keep)
        )
    return keep


def trajectory(
    path: Path,
    time: FloatArray,
    position_W: FloatArray,
    attitude_WB: Rotation,
    velocity_W: FloatArray | None = None,
) -> Trajectory:
    """Return a trajectory of a file's poses whose times advance, as `pose_mask` selects them."""
    keep = pose_mask(path, time)
    return Trajectory(
        time=time[keep],
        position_W=position_W[keep],
        attitude_WB=attitude_WB[keep],
        velocity_W=None if velocity_W is None else velocity_W[keep],
    )
