"""Raw IMUNet: `acce.txt`, `gyro.txt`, `orientation.txt`, `pose.txt` in a folder (Zeinali, 2022).

Rows of blank-separated numbers below `#` comments, each file at its own times. They hold time [ns]
and specific force xyz [m/s^2], rate xyz [rad/s], game rotation vector xyzw or, at 30 Hz, ARCore's
pose, position xyz [m] and quaternion xyzw in a world with y up. As the authors do, positions are
rotated upright, (x, -z, y), and the attitude is pose[0] conj(orientation[0]) orientation, rotated
likewise. RIDI's raw folders have the same files in a world that already has z up: the specific
force distinguishes them.

The authors' later recorder writes several pose files (of the camera, the display, the sensor); the
one that agrees with the gyroscope is used, see `poses`.

A processed recording, `processed/data.csv`, is read instead if present.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Slerp

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import finite_rows, magnetometer, rotations, trajectory
from stario.sequences.readers.clocks import resample_to_gyro
from stario.sequences.readers.lines import first_line
from stario.sequences.readers.poses import pose_files, with_pose
from stario.sequences.readers.published.ridi import UPRIGHT, is_ridi, read_ridi, y_is_up
from stario.sequences.readers.text import IntArray, RowFormat, read_table, seconds
from stario.sequences.sequence import FloatArray, ImuSequence, Magnetometer, Trajectory

_FILES = ("acce.txt", "gyro.txt", "orientation.txt", "pose.txt")


def read_imunet(path: Path) -> ImuSequence:
    """Read a recording from its folder, processed or raw."""
    if is_ridi(path):
        return read_ridi(path)
    folder = path if path.is_dir() else path.parent
    gyro_ns, gyro = _rows(folder / "gyro.txt", 3)
    accel_ns, accel = _rows(folder / "acce.txt", 3)
    stamps, gyro, accel = resample_to_gyro(folder, gyro_ns, gyro, accel_ns, accel)
    time = seconds(stamps, stamps[0])
    poses = pose_files(folder)
    sequence = ImuSequence(
        name=folder.resolve().name,
        time=time,
        gyro=gyro,
        accel=accel,
        truth=_truth(folder, stamps[0], time, accel) if len(poses) == 1 else None,
        magnetometer=_magnetometer(folder / "magnet.txt", stamps[0]),
    )
    return sequence if sequence.truth else with_pose(sequence, stamps[0], poses)


def is_imunet(path: Path) -> bool:
    """Return whether a folder holds the raw files."""
    return path.is_dir() and all((path / name).is_file() for name in _FILES)


def _magnetometer(path: Path, start_ns: np.int64) -> Magnetometer | None:
    if not path.is_file() or first_line(path) is None:
        return None
    table = read_table(path, 4, RowFormat(delimiter=None))
    return magnetometer(seconds(table.stamps_ns(), start_ns), table.values[:, 1:])


def _rows(path: Path, width: int) -> tuple[IntArray, FloatArray]:
    table = read_table(path, 1 + width, RowFormat(delimiter=None))
    rows = finite_rows(path, "values", table.values)
    return table.stamps_ns(kept=rows), table.values[rows, 1:]


def _truth(folder: Path, start_ns: np.int64, time: FloatArray, accel: FloatArray) -> Trajectory:
    pose_ns, pose = _rows(folder / "pose.txt", 7)
    rv_ns, rv = _rows(folder / "orientation.txt", 4)
    kept = np.unique(rv_ns, return_index=True)[1]
    game_rv = rotations(folder / "orientation.txt", "quaternion", rv[kept], "xyzw")
    inside = (pose_ns >= rv_ns[kept[0]]) & (pose_ns <= rv_ns[kept[-1]])
    if not inside.any() or len(kept) < 2:
        raise ReadError(folder / "pose.txt", "time", "no pose", "poses during orientation.txt")
    pose_ns, pose = pose_ns[inside], pose[inside]
    known = Slerp(seconds(rv_ns[kept], start_ns), game_rv)
    pose_time = seconds(pose_ns, start_ns)
    start = rotations(folder / "pose.txt", "quaternion", pose[:, 3:7], "xyzw")[0]
    R_WU = start * known(pose_time[0]).inv()
    attitude_WB, position = R_WU * known(pose_time), pose[:, :3]
    at_force = R_WU * known(np.clip(time, known.times[0], known.times[-1]))
    if y_is_up(folder / "pose.txt", at_force, accel):
        attitude_WB, position = UPRIGHT * attitude_WB, UPRIGHT.apply(position)
    return trajectory(folder / "pose.txt", pose_time, position, attitude_WB)
