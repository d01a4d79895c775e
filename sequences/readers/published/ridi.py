"""RIDI and processed IMUNet: `<sequence>/processed/data.csv`, 200 Hz (Yan et al., ECCV 2018).

Columns by name: `time` [ns], `gyro_x..` [rad/s], `acce_x..` [m/s^2], `pos_x..` [m], `ori_w..z`,
`rv_w..z` and, if present, `magnet_x..` [uT]; others are ignored. The attitude is that of RIDI's and
RoNIN's authors, the game rotation vector rotated to start at the pose's attitude:
ori[0] conj(rv[0]) rv.

IMUNet (Zeinali et al., 2022) writes the same columns from ARCore's poses, whose world has y up. Its
authors rotate the positions upright, (x, -z, y), but not the attitudes: where the specific force
points along y, the attitude is rotated likewise.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import trajectory
from stario.sequences.readers.published.by_name import NamedColumns, axes_of, header_names
from stario.sequences.sequence import FloatArray, ImuSequence

_log = logging.getLogger(__name__)

UPRIGHT = Rotation.from_euler("x", 90.0, degrees=True)
"""Rotation from a world with y up to one with z up: (x, y, z) becomes (x, -z, y)."""

_COLUMNS = (
    "time",
    *axes_of("gyro"),
    *axes_of("acce"),
    *axes_of("pos"),
    *axes_of("ori", "wxyz"),
    *axes_of("rv", "wxyz"),
)
_OWN = ("rv_x", "rv_w", "ori_w", "linacce_x", "grav_x")
"""Names that distinguish this header from others with a gyroscope and an accelerometer."""

_PICKLES = ("data.pkl", "data.pickle")
_MAX_TILT_RAD = np.deg2rad(20.0)


def read_ridi(path: Path) -> ImuSequence:
    """Read a recording from its folder, its `processed` folder or its `data.csv`."""
    file = data_file(path)
    if file is None:
        raise ReadError(path, "processed/data.csv", "no such file", "a RIDI or IMUNet recording")
    if file.name in _PICKLES:
        fix = "write the table to data.csv next to it with pandas' to_csv"
        raise ReadError(file, "file", "a pickle, which may run code", "processed/data.csv", fix)
    columns = NamedColumns(file, _COLUMNS, magnetic=("magnet",))
    time, accel = columns.seconds("time"), columns.stack("acce")
    pose, game_rv = columns.rotations("ori"), columns.rotations("rv")
    attitude_WB = pose[0] * game_rv[0].inv() * game_rv
    if y_is_up(file, attitude_WB, accel):
        attitude_WB = UPRIGHT * attitude_WB
    return ImuSequence(
        name=_name(file),
        time=time,
        gyro=columns.stack("gyro"),
        accel=accel,
        truth=trajectory(file, time, columns.stack("pos"), attitude_WB),
        magnetometer=columns.magnetometer(time),
    )


def is_ridi(path: Path) -> bool:
    """Return whether a path leads to a CSV with these columns, or to a pickle in its place."""
    file = data_file(path)
    if file is None or file.name in _PICKLES:
        return file is not None
    return len(set(_OWN) & set(header_names(file))) >= 2


def data_file(path: Path) -> Path | None:
    """Return the recording's `data.csv`, else a pickle in its place, else None."""
    if path.is_file():
        return path if path.suffix == ".csv" or path.name in _PICKLES else None
    inside = path if path.name == "processed" else path / "processed"
    files = (inside / name for name in ("data.csv", *_PICKLES))
    return next((file for file in files if file.is_file()), None)


def y_is_up(path: Path, attitude_WB: Rotation, accel: FloatArray) -> bool:
    """Return whether an attitude's world has y up instead of z, by the mean specific force (N, 3).

    A warning names the file if neither axis is near the force.
    """
    up = attitude_WB.apply(accel).mean(axis=0)
    cosines = up / max(float(np.linalg.norm(up)), 1e-9)
    if max(cosines[1], cosines[2]) < np.cos(_MAX_TILT_RAD):
        tilt = np.degrees(np.arccos(np.clip(cosines[2], -1.0, 1.0)))
        _log.warning("%s: with its poses, specific force is %.0f degrees off vertical", path, tilt)
    return bool(cosines[1] > cosines[2])


def _name(file: Path) -> str:
    folder = file.resolve().parent
    return folder.parent.name if folder.name == "processed" else folder.name
