"""OxIOD, synchronised form: `syn/imuN.csv` beside `syn/viN.csv` (Chen et al., 2018).

`imuN.csv` has no header: time, roll, pitch, yaw [rad], gyroscope xyz [rad/s], gravity xyz [g],
user acceleration xyz [g], magnetic field xyz [uT], in Apple's signs: the specific force is
-(gravity + user acceleration) * 9.81. Its printed times are rounded to uselessness; the rows of
both files are synchronous at 100 Hz. `viN.csv`: time, frame, position xyz [m], quaternion xyzw of
the tracked body. The phone sits turned in that body, the capture glitches and flips, and its
world is not quite level: see `stario.sequences.alignment`.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from stario.sequences.alignment import align_tracked_body
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers.text import first_numbers, read_table
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence, Trajectory

RATE = 100.0
_log = logging.getLogger(__name__)

_G = 9.81
_JUMP_M = 0.04
"""A tracked body that moves further than this within one row (4 m/s) is a glitch."""

_SPIKE_M = 0.1
"""Nor is it ever this far from the median of the half second around it."""


def read_oxiod(path: Path) -> ImuSequence:
    """Read `syn/imuN.csv` and, where it lies beside it, `syn/viN.csv`.

    Truth is None, with a warning logged, where too little of it agrees with the gyroscope.

    Raises:
        ReadError: a file is missing, cut short, or the two do not have the same number of rows.
    """
    table = read_table(path, columns=16).values
    time = np.arange(len(table)) / RATE
    gyro = table[:, 4:7]
    accel = -_G * (table[:, 7:10] + table[:, 10:13])
    vicon = path.with_name(path.name.replace("imu", "vi", 1))
    has_truth = vicon != path and vicon.exists()
    truth = _truth(vicon, time, gyro, accel) if has_truth else None
    return ImuSequence(name=_name(path), time=time, gyro=gyro, accel=accel, truth=truth)


def is_oxiod(path: Path) -> bool:
    """Whether a file starts with 16 numbers whose gravity is one g long; there is no header."""
    row = first_numbers(path)
    return len(row) == 16 and abs(float(np.linalg.norm(row[7:10])) - 1.0) < 0.05


def _name(path: Path) -> str:
    """`handheld/data1/syn/imu3.csv` becomes `handheld-data1-imu3`."""
    parts = [p.replace(" ", "_") for p in (*path.parent.parts[-3:], path.stem) if p != "syn"]
    return "-".join(p for p in parts if p not in ("/", "..", "."))


def _truth(path: Path, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> Trajectory | None:
    table = read_table(path, columns=9).values
    if len(table) != len(time):
        raise ReadError(path, "rows", str(len(table)), f"{len(time)} as in the IMU's file")
    position, quat_xyzw = table[:, 2:5], table[:, 5:9]
    norm = np.linalg.norm(quat_xyzw, axis=1)
    valid = np.isfinite(table[:, 2:9]).all(axis=1) & (np.abs(norm - 1.0) < 1e-2)
    valid &= ~_position_glitches(position)
    quat_xyzw = np.where(valid[:, None], quat_xyzw, [0.0, 0.0, 0.0, 1.0])
    known = np.isfinite(gyro).all(axis=1) & np.isfinite(accel).all(axis=1)
    imu = (time[known], gyro[known], accel[known])
    try:
        aligned = align_tracked_body(*imu, time, Rotation.from_quat(quat_xyzw), valid)
    except InputError as error:
        _log.warning("%s: left out: %s", path, error)
        return None
    return Trajectory(
        time=time + aligned.lag,
        position_W=aligned.leveling_WW.apply(position),
        attitude_WB=aligned.attitude_WB,
        valid=aligned.valid,
    )


def _position_glitches(position: FloatArray) -> BoolArray:
    """Rows at either end of an impossible step or far from the median around them, widened."""
    half = 25
    padded = np.pad(position, ((half, half), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0)
    distance = np.linalg.norm(position - np.median(windows, axis=-1), axis=1)
    jump = ~(np.linalg.norm(np.diff(position, axis=0), axis=1) < _JUMP_M)
    bad = ~(distance < _SPIKE_M)
    bad[1:] |= jump
    bad[:-1] |= jump
    return np.asarray(binary_dilation(bad, iterations=2), dtype=np.bool_)
