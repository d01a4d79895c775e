"""OxIOD: `<carriage>/<dataN>/{syn,raw}/imuN.csv` with the capture alongside (Chen et al., 2018).

`imuN.csv` has no header: time, roll, pitch, yaw [rad], gyroscope xyz [rad/s], gravity xyz [g],
user acceleration xyz [g], magnetic field xyz [uT], in Apple's signs: the specific force is
-(gravity + user acceleration) * 9.81. The capture is Vicon's `viN.csv` (`handN.csv` in one
folder) or, at large scale, `tangoN.csv`: time, frame, position xyz [m], quaternion xyzw of the
tracked body.

In `syn` the printed times are too coarsely rounded to use; the rows of both files are synchronous
at 100 Hz. In `raw` each file has its own clock, in ns, us, ms or s as its rate indicates. There the
IMU's rows are sorted (neighbours are occasionally swapped), and the capture is brought onto the
phone's clock by matching the rotation in both. The Nexus 5 of `multi devices` writes other rows in
`raw`: time, a code (1 accelerometer [m/s^2], 2 magnetometer [uT], 4 gyroscope [rad/s]) and xyz.

The phone is rotated relative to the tracked body, the capture has glitches and flips, and its world
is not quite level: see `stario.sequences.attitude.alignment`.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, median_filter

from stario.sequences.arrays import samples_in
from stario.sequences.attitude.alignment import align_tracked_body, clock_offset
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers.checked import captured_rotations, magnetometer
from stario.sequences.readers.clocks import Samples, joined_sequence, time_unit
from stario.sequences.readers.text import (
    IntArray,
    Table,
    first_line,
    first_lines,
    numbers_in,
    read_table,
    seconds,
)
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence, Trajectory

RATE = 100.0
_log = logging.getLogger(__name__)

_G = 9.81
_CAPTURES = ("vi", "hand", "tango")
_ACCELEROMETER, _MAGNETIC, _GYROSCOPE = 1, 2, 4

_JUMP_M_S = 4.0
"""Maximum speed of a tracked body from row to row; anything faster is a glitch."""

_SPIKE_M = 0.1
"""Maximum distance of a tracked body from the median of the half second around it."""


def read_oxiod(path: Path) -> ImuSequence:
    """Read `imuN.csv` and, if it lies alongside, the capture.

    The truth is None, with a warning logged, if too little of it agrees with the gyroscope.
    """
    phone, start_ns = _sensor_rows(path) if _is_sensor_rows(path) else _phone(path)
    capture = capture_file(path)
    return phone if capture is None else replace(phone, truth=_truth(capture, phone, start_ns))


def is_oxiod(path: Path) -> bool:
    """Return whether a file starts with 16 numbers, with gravity of 1 g, or with sensor codes."""
    row = numbers_in(first_line(path))
    apple = len(row) == 16 and abs(float(np.linalg.norm(row[7:10])) - 1.0) < 0.05
    return apple or _is_sensor_rows(path)


def _is_sensor_rows(path: Path) -> bool:
    rows = [numbers_in(line) for line in first_lines(path, 40)[:-1]]
    if not rows or any(len(row) != 5 for row in rows):
        return False
    codes = {row[1] for row in rows}
    return {_ACCELEROMETER, _GYROSCOPE} <= codes and all(c == int(c) for c in codes)


def _name(path: Path) -> str:
    """Return the name of a recording: `handheld/data1/syn/imu3.csv` is `handheld-data1-imu3`."""
    parts = [p.replace(" ", "_") for p in (*path.parent.parts[-3:], path.stem) if p != "syn"]
    return "-".join(p for p in parts if p not in ("/", "..", "."))


def _phone(path: Path) -> tuple[ImuSequence, np.int64 | None]:
    """Return the samples and the first one's stamp [ns], None if only the rows give the time."""
    table = read_table(path, columns=16)
    rows, start_ns = table.values, None
    if path.parent.name == "syn" or len(np.unique(rows[:, 0])) < len(rows) / 2:
        time = np.arange(len(rows)) / RATE
    else:
        stamps = _stamps_ns(table)
        order = np.argsort(stamps, kind="stable")
        rows, start_ns = rows[order], stamps[order[0]]
        time = seconds(stamps[order], start_ns)
    accel = -_G * (rows[:, 7:10] + rows[:, 10:13])
    field = magnetometer(time, rows[:, 13:16])
    return ImuSequence(_name(path), time, rows[:, 4:7], accel, magnetometer=field), start_ns


def _sensor_rows(path: Path) -> tuple[ImuSequence, np.int64 | None]:
    """Read a file with a row for each sample of each sensor, at its own time."""
    table = read_table(path, columns=5)
    stamps, code = _stamps_ns(table), table.values[:, 1]
    gyro, accel, field = (
        Samples(stamps[code == c], table.values[code == c, 2:5])
        for c in (_GYROSCOPE, _ACCELEROMETER, _MAGNETIC)
    )
    return joined_sequence(path, _name(path), gyro, accel, field)


def _stamps_ns(table: Table) -> IntArray:
    return table.stamps_ns(time_unit(table.path, table.values[:, 0]))


def capture_file(path: Path) -> Path | None:
    """Return the capture with the IMU file's number, from its folder or the sibling `tango`."""
    if not path.name.startswith("imu"):
        return None
    number = path.name.removeprefix("imu")
    folders = (path.parent, path.parent.parent / "tango")
    files = (folder / f"{name}{number}" for folder in folders for name in _CAPTURES)
    return next((file for file in files if file.is_file()), None)


def _truth(path: Path, phone: ImuSequence, start_ns: np.int64 | None) -> Trajectory | None:
    table = read_table(path, columns=max(8, len(numbers_in(first_line(path)))))
    time, kept = phone.time, np.arange(len(table.values))
    if start_ns is not None:
        stamps, kept = np.unique(_stamps_ns(table), return_index=True)
        time = seconds(stamps, start_ns)
    elif len(kept) != len(time):
        raise ReadError(path, "rows", str(len(kept)), f"{len(time)} as in the IMU's file")
    # Left in as invalid, they would spoil the averages over their neighbours.
    finite = np.isfinite(table.values[kept, -7:]).all(axis=1)
    time, pose = time[finite], table.values[kept[finite], -7:]
    position, (attitude_WV, valid) = pose[:, :3], captured_rotations(pose[:, 3:])
    valid &= (position != 0.0).any(axis=1)  # zeros are written while the body is out of sight
    known = np.isfinite(phone.gyro).all(axis=1) & np.isfinite(phone.accel).all(axis=1)
    imu = (phone.time[known], phone.gyro[known], phone.accel[known])
    try:
        valid &= ~_position_glitches(time, position)
        if start_ns is not None:
            time = time + clock_offset(*imu[:2], time, attitude_WV, valid)
        aligned = align_tracked_body(*imu, time, attitude_WV, valid, position)
    except InputError as error:
        _log.warning("%s: ground truth rejected: %s", path, error)
        return None
    return Trajectory(
        time=time + aligned.lag,
        position_W=aligned.leveling_WW.apply(position),
        attitude_WB=aligned.attitude_WB,
        valid=aligned.valid,
    )


def _position_glitches(time: FloatArray, position: FloatArray) -> BoolArray:
    """Return rows next to an impossible step or far from the median around them, dilated by two."""
    if len(time) < 2:
        return np.zeros(len(time), dtype=np.bool_)
    half = samples_in(0.25, time)
    median = median_filter(position, size=(2 * half + 1, 1), mode="nearest")
    distance = np.linalg.norm(position - median, axis=1)
    limit = _JUMP_M_S * np.maximum(np.diff(time), 1.0 / RATE)
    jump = ~(np.linalg.norm(np.diff(position, axis=0), axis=1) < limit)
    bad = ~(distance < _SPIKE_M)
    bad[1:] |= jump
    bad[:-1] |= jump
    return np.asarray(binary_dilation(bad, iterations=2), dtype=np.bool_)
