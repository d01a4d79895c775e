"""EuRoC and TUM-VI folders: `mav0/imu0/data.csv`, ground truth alongside (Burri et al., 2016).

IMU rows: time [ns], gyroscope xyz [rad/s], accelerometer xyz [m/s^2]. Truth rows, in
`state_groundtruth_estimate0` (EuRoC) or `mocap0` (TUM-VI, Schubert et al., 2018): time [ns],
position xyz [m], quaternion w x y z, IMU to world; EuRoC adds velocity xyz. Time is returned as
seconds since the first IMU row. Truth may start later, end earlier and have gaps; a pose without a
unit quaternion, as captures write when they lose track, is marked invalid with a warning.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import captured_rotations, pose_mask
from stario.sequences.readers.columns import IMU, canonical_names
from stario.sequences.readers.phones.sensor_words import time_unit_of
from stario.sequences.readers.text import first_line, read_table, seconds
from stario.sequences.sequence import ImuSequence, Trajectory
from stario.sequences.units import TIME_UNITS

_log = logging.getLogger(__name__)

TRUTH_FOLDERS = ("state_groundtruth_estimate0", "mocap0", "gt")
"""Folders with the IMU's poses; EuRoC's `leica0` has only positions, `vicon0` the markers' pose."""


def read_euroc(path: Path) -> ImuSequence:
    """Read a recording from its folder, its `mav0` folder or its `imu0/data.csv`."""
    imu = imu_file(path)
    if imu is None:
        expected = "an EuRoC or TUM-VI folder with its IMU"
        raise ReadError(path, "mav0/imu0/data.csv", "no such file", expected, "unpack all of it")
    header = first_line(imu, comments=True)
    names = canonical_names(header)
    if set(names) >= {"t", *IMU} and names[:7] != ["t", *IMU]:
        expected = "time, gyroscope xyz and accelerometer xyz first"
        fix = f"read {imu.name} itself with `--format csv`, by its titles"
        raise ReadError(imu, "header", repr(header.strip()[:80]), expected, fix)
    table = read_table(imu, columns=7)
    stamps = table.stamps_ns(_unit_ns(imu))
    truth_files = (imu.parent.parent / folder / "data.csv" for folder in TRUTH_FOLDERS)
    truth_file = next((file for file in truth_files if file.is_file()), None)
    folder = imu.resolve().parent.parent
    return ImuSequence(
        name=folder.parent.name if folder.name == "mav0" else folder.name,
        time=seconds(stamps, stamps[0]),
        gyro=table.values[:, 1:4],
        accel=table.values[:, 4:7],
        truth=None if truth_file is None else _truth(truth_file, stamps[0]),
    )


def _unit_ns(path: Path) -> int:
    """Return the unit of a file's times [ns], nanoseconds unless its title names another."""
    return TIME_UNITS.get(time_unit_of(first_line(path, comments=True).split(",")[0]), 1)


def is_euroc(path: Path) -> bool:
    """Return whether a path leads to an `imu0/data.csv`, or is a folder that should."""
    return imu_file(path) is not None or (path / "mav0").is_dir()


def imu_file(path: Path) -> Path | None:
    """Return the recording's `imu0/data.csv`, or None if `path` does not lead to one."""
    if path.is_file():
        return path if path.name == "data.csv" and path.parent.name.startswith("imu") else None
    candidates = (path / "mav0/imu0/data.csv", path / "imu0/data.csv", path / "data.csv")
    return next((c for c in candidates if c.is_file() and c.parent.name.startswith("imu")), None)


def _truth(path: Path, start_ns: np.int64) -> Trajectory:
    # Some copies of EuRoC's files lack the velocity; TUM-VI's never have it.
    estimated = path.parent.name.startswith("state_groundtruth")
    columns = 11 if estimated and first_line(path).count(",") >= 10 else 8
    rows = read_table(path, columns=columns)
    table, time = rows.values, seconds(rows.stamps_ns(_unit_ns(path)), start_ns)
    keep = pose_mask(path, time)
    table, time = table[keep], time[keep]
    attitude_WB, valid = captured_rotations(table[:, [5, 6, 7, 4]])
    valid &= np.isfinite(table[:, 1:4]).all(axis=1)
    if not valid.all():
        _log.warning("%s: rejected %d of %d poses as invalid", path, (~valid).sum(), len(valid))
    return Trajectory(
        time=time,
        position_W=table[:, 1:4],
        attitude_WB=attitude_WB,
        velocity_W=table[:, 8:11] if columns == 11 else None,
        valid=valid,
    )
