"""RIDI and IMUNet: `<sequence>/processed/data.csv`, 200 Hz (Yan et al., ECCV 2018; Zeinali, 2022).

Columns by name: `time` [ns], `gyro_x..` [rad/s], `acce_x..` [m/s^2], `pos_x..` [m], `ori_w..z`,
`rv_w..z` and, if present, `magnet_x..` [uT]; others are ignored. The attitude is that of RIDI's and
RoNIN's authors, the game rotation vector rotated to start at the pose's attitude:
ori[0] conj(rv[0]) rv.

IMUNet writes the same columns from ARCore's poses, whose world has y up. Its authors rotate the
positions upright, (x, -z, y), but not the attitudes: where the specific force points along y, the
attitude is rotated likewise.

IMUNet's raw form, read if there is no processed one, is `acce.txt`, `gyro.txt`, `orientation.txt`
and `pose.txt`: rows of blank-separated numbers below `#` comments, each file at its own times. They
hold time [ns] and specific force xyz [m/s^2], rate xyz [rad/s], game rotation vector xyzw or, at
30 Hz, ARCore's pose, position xyz [m] and quaternion xyzw in a world with y up: there positions are
rotated upright as well. RIDI's raw folders have the same files in a world that already has z up:
the specific force distinguishes them. The authors' later recorder writes several pose files (of the
camera, the display, the sensor); the one that agrees with the gyroscope is used, see `poses`.
"""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import finite_rows, magnetometer, rotations, trajectory
from stario.sequences.readers.clocks import Samples, joined_sequence
from stario.sequences.readers.poses import pose_files, with_pose
from stario.sequences.readers.published.fields import MAGNETIC, file_in, header_names, read_columns
from stario.sequences.readers.text import RowFormat, first_line, read_table
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory

_log = logging.getLogger(__name__)

_UPRIGHT = Rotation.from_euler("x", 90.0, degrees=True)
"""Rotation from a world with y up to one with z up: (x, y, z) becomes (x, -z, y)."""

_STEMS = {"gyro": "xyz", "acce": "xyz", "pos": "xyz", "ori": "wxyz", "rv": "wxyz"}
_OWN = ("rv_x", "rv_w", "ori_w", "linacce_x", "grav_x")
"""Names that distinguish this header from others with a gyroscope and an accelerometer."""

_PICKLES = ("data.pkl", "data.pickle")
_MAX_TILT_RAD = np.deg2rad(20.0)
_FILES = ("acce.txt", "gyro.txt", "orientation.txt", "pose.txt")


def read_ridi(path: Path) -> ImuSequence:
    """Read a recording from its folder, its `processed` folder or its `data.csv`."""
    file = _data_file(path)
    if file is None:
        raise ReadError(path, "processed/data.csv", "no such file", "a RIDI or IMUNet recording")
    if file.name in _PICKLES:
        fix = "write the table to data.csv next to it with pandas' to_csv"
        raise ReadError(file, "file", "a pickle, which may run code", "processed/data.csv", fix)
    time, fields = read_columns(file, ("time", 1), _STEMS)
    pose, game_rv = fields.rotations("ori"), fields.rotations("rv")
    attitude_WB = pose[0] * game_rv[0].inv() * game_rv
    if _y_is_up(file, attitude_WB, fields["acce"]):
        attitude_WB = _UPRIGHT * attitude_WB
    folder = file.resolve().parent
    return ImuSequence(
        name=folder.parent.name if folder.name == "processed" else folder.name,
        time=time,
        gyro=fields["gyro"],
        accel=fields["acce"],
        truth=trajectory(file, time, fields["pos"], attitude_WB),
        magnetometer=magnetometer(time, fields.get(MAGNETIC)),
    )


def is_ridi(path: Path) -> bool:
    """Return whether a path leads to a CSV with these columns, or to a pickle in its place."""
    file = _data_file(path)
    if file is None or file.name in _PICKLES:
        return file is not None
    return len(set(_OWN) & set(header_names(file))) >= 2


def _data_file(path: Path) -> Path | None:
    """Return the recording's `data.csv`, any other CSV, or else a pickle in its place."""
    if path.suffix == ".csv" and path.is_file():
        return path
    inside = path / "processed" if path.is_dir() and path.name != "processed" else path
    return file_in(inside, "data.csv", *_PICKLES)


def _y_is_up(path: Path, attitude_WB: Rotation, accel: FloatArray) -> bool:
    """Return whether an attitude's world has y up instead of z, by the mean specific force (N, 3).

    A warning names the file if neither axis is near the force.
    """
    up = attitude_WB.apply(accel).mean(axis=0)
    cosines = up / max(float(np.linalg.norm(up)), 1e-9)
    if max(cosines[1], cosines[2]) < np.cos(_MAX_TILT_RAD):
        tilt = np.degrees(np.arccos(np.clip(cosines[2], -1.0, 1.0)))
        _log.warning("%s: with its poses, specific force is %.0f degrees off vertical", path, tilt)
    return bool(cosines[1] > cosines[2])


def read_imunet(path: Path) -> ImuSequence:
    """Read a recording from its folder, processed or raw."""
    if is_ridi(path):
        return read_ridi(path)
    folder = path if path.is_dir() else path.parent
    sequence, start_ns = joined_sequence(
        folder,
        folder.resolve().name,
        _samples(folder / "gyro.txt", 3),
        _samples(folder / "acce.txt", 3),
        _field(folder / "magnet.txt"),
    )
    poses = pose_files(folder)
    if len(poses) != 1:
        return with_pose(sequence, start_ns, poses)
    return replace(sequence, truth=_truth(folder, start_ns, sequence))


def is_imunet(path: Path) -> bool:
    """Return whether a folder holds the raw files."""
    return path.is_dir() and all((path / name).is_file() for name in _FILES)


def _samples(path: Path, width: int) -> Samples:
    table = read_table(path, 1 + width, RowFormat(delimiter=None))
    rows = finite_rows(path, "values", table.values)
    return Samples(table.stamps_ns(kept=rows), table.values[rows, 1:])


def _field(path: Path) -> Samples | None:
    """Return the magnetometer's samples, also those that are not finite: it is optional."""
    if not path.is_file() or not first_line(path):
        return None
    table = read_table(path, 4, RowFormat(delimiter=None))
    return Samples(table.stamps_ns(), table.values[:, 1:])


def _truth(folder: Path, start_ns: np.int64, sequence: ImuSequence) -> Trajectory:
    file = folder / "pose.txt"
    pose, rv = _samples(file, 7), _samples(folder / "orientation.txt", 4)
    pose_time = pose.seconds(start_ns)
    rv_time, kept = np.unique(rv.seconds(start_ns), return_index=True)
    game_rv = rotations(folder / "orientation.txt", "quaternion", rv.values[kept], "xyzw")
    inside = (pose_time >= rv_time[0]) & (pose_time <= rv_time[-1])
    if not inside.any() or len(kept) < 2:
        raise ReadError(file, "time", "no pose", "poses during orientation.txt")
    pose_time, poses = pose_time[inside], pose.values[inside]
    known = Slerp(rv_time, game_rv)
    start = rotations(file, "quaternion", poses[:, 3:7], "xyzw")[0]
    R_WU = start * known(pose_time[0]).inv()
    attitude_WB, position = R_WU * known(pose_time), poses[:, :3]
    at_force = R_WU * known(np.clip(sequence.time, rv_time[0], rv_time[-1]))
    if _y_is_up(file, at_force, sequence.accel):
        attitude_WB, position = _UPRIGHT * attitude_WB, _UPRIGHT.apply(position)
    return trajectory(file, pose_time, position, attitude_WB)
