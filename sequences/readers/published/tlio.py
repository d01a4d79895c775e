"""TLIO's golden set: `<id>/imu0_resampled.npy` and, alongside, the raw `imu_samples_0.csv`.

Resampled (Liu et al., RA-L 2020; 200 Hz): `imu0_resampled_description.json` names the columns and
their widths: time [us], gyroscope [rad/s] and specific force [m/s^2], compensated and already
rotated to the world, attitude `qxyzw_World_Device` (`qwxyz_...` in some copies, in that order),
position [m] and, in most copies, velocity [m/s]. The attitude rotates the samples back to the
device's axes, unless its rate shows that they are in these already, as in copies of other data
sets.

Raw: time [ns], temperature, gyroscope [rad/s], accelerometer [m/s^2] at about 1 kHz. As in the
authors' filter, `calibration.json` corrects them to R^-1 x - b: R is the `RectificationMatrix`, b
the bias's `Offset`. Ground truth is the resampled pose if present. `T_Device_Imu` takes the IMU's
axes to those of the pose, but must not be applied in copies whose pose is that of the IMU itself:
with or without it, whichever matches the resampled rates better is used.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import interpolated, trapezoids
from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import finite_rows, trajectory
from stario.sequences.readers.published.fields import Fields, JsonFields, file_in
from stario.sequences.readers.text import IntArray, read_table, seconds
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory

_RESAMPLED, _RAW = "imu0_resampled.npy", "imu_samples_0.csv"
_DESCRIPTION, _CALIBRATION = "imu0_resampled_description.json", "calibration.json"

_TIME, _GYRO, _ACCEL = (
    "ts_us",
    "gyr_compensated_rotated_in_World",
    "acc_compensated_rotated_in_World",
)
_POSITION, _VELOCITY = "pos_World_Device", "vel_World"
_WIDTHS = {_TIME: 1, _GYRO: 3, _ACCEL: 3, _POSITION: 3}
_QUATERNIONS = {"qxyzw_World_Device": "xyzw", "qwxyz_World_Device": "wxyz"}
_COLUMN = re.compile(r"(?P<name>\w+)\((?P<width>\d+)\)$")


def read_tlio(path: Path) -> ImuSequence:
    """Read a recording from its folder (resampled if both exist) or from one of its files."""
    file = file_in(path, _RESAMPLED, _RAW)
    if file is None:
        raise ReadError(path, _RESAMPLED, "no such file", "a TLIO recording")
    return _read_raw(file) if file.suffix == ".csv" else _read_resampled(file)[1]


def is_tlio(path: Path) -> bool:
    """Return whether a path leads to one of the two files."""
    return file_in(path, _RESAMPLED, _RAW) is not None


def _read_resampled(file: Path) -> tuple[IntArray, ImuSequence]:
    """Return the times as written [us], and the recording in the device's axes."""
    places = _places(file.with_name(_DESCRIPTION))
    table = _array(file)
    width = max(place.stop for place in places.values())
    if table.ndim != 2 or table.shape[1] < width or not len(table):
        raise ReadError(file, "array", f"shape {table.shape}", f"(N, {width}) as in {_DESCRIPTION}")
    fields = Fields(file, {name: table[:, place] for name, place in places.items()})
    quat = next(name for name in _QUATERNIONS if name in fields)
    attitude_WB = fields.rotations(quat, _QUATERNIONS[quat])
    us, gyro, accel = fields[_TIME][:, 0], fields[_GYRO], fields[_ACCEL]
    time = (us - us[0]) * 1e-6
    if not _in_body_axes(time, gyro, attitude_WB):
        gyro, accel = (attitude_WB.apply(values, inverse=True) for values in (gyro, accel))
    truth = trajectory(file, time, fields[_POSITION], attitude_WB, fields.get(_VELOCITY))
    sequence = ImuSequence(file.resolve().parent.name, time, gyro, accel, truth)
    return np.rint(us).astype(np.int64), sequence


def _in_body_axes(time: FloatArray, gyro: FloatArray, attitude_WB: Rotation) -> bool:
    """Return whether rates (N, 3) are in the body's axes, whatever their column's name.

    Over a step the attitude rotates by R_k^T R_k+1 in the body's axes, R_k+1 R_k^T in the world's.
    """
    if len(time) < 2:
        return False
    turned = trapezoids(time, gyro)
    steps_B = (attitude_WB[:-1].inv() * attitude_WB[1:]).as_rotvec()
    steps_W = attitude_WB[:-1].apply(steps_B)
    return bool(np.abs(turned - steps_B).sum() < np.abs(turned - steps_W).sum())


def _array(file: Path) -> FloatArray:
    try:
        array = np.load(file, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        pickled = "pickle" in str(error).lower()
        found = "pickled objects, which may run code" if pickled else " ".join(str(error).split())
        fix = "save plain numbers" if pickled else "is the download complete?"
        raise ReadError(file, "array", found, "an npy array of numbers", fix) from None
    if array.dtype.kind not in "fiu":
        raise ReadError(file, "array", f"dtype {array.dtype}", "numbers")
    return np.asarray(array, dtype=np.float64)


def _places(description: Path) -> dict[str, slice]:
    """Return the columns of each quantity from a list such as ["ts_us(1)", ...] under any key."""
    fields = JsonFields(description).fields
    lists = (x for x in fields.values() if isinstance(x, list) and x)
    names = next((x for x in lists if all(isinstance(c, str) for c in x)), [])
    places, widths, start = {}, {}, 0
    for text in names:
        match = _COLUMN.match(text)
        if match is None:
            raise ReadError(description, "columns_name(width)", repr(text), "a name with its width")
        widths[match["name"]] = int(match["width"])
        places[match["name"]] = slice(start, start := start + int(match["width"]))
    missing = [name for name, width in _WIDTHS.items() if widths.get(name) != width]
    if not any(widths.get(name) == 4 for name in _QUATERNIONS):
        missing.append("qxyzw_World_Device")
    if missing:
        expected = ", ".join(f"{n}({w})" for n, w in (*_WIDTHS.items(), ("qxyzw_World_Device", 4)))
        raise ReadError(description, "columns_name(width)", f"no {', '.join(missing)}", expected)
    return places


def _read_raw(file: Path) -> ImuSequence:
    table = read_table(file, columns=8)
    samples = table.values[:, 2:8]
    rows = finite_rows(file, "samples", samples)
    stamps, samples = table.stamps_ns(kept=rows), samples[rows]
    calibration = JsonFields(file.with_name(_CALIBRATION))
    sequence = ImuSequence(
        name=file.resolve().parent.name,
        time=seconds(stamps, stamps[0]),
        gyro=_calibrated(calibration, "Gyroscope", samples[:, :3]),
        accel=_calibrated(calibration, "Accelerometer", samples[:, 3:]),
    )
    resampled = file.with_name(_RESAMPLED)
    if not resampled.is_file():
        return sequence
    stamps_us, posed = _read_resampled(resampled)
    offset = (int(stamps_us[0]) * 1000 - int(stamps[0])) * 1e-9
    return replace(sequence, truth=_imu_pose(calibration, sequence, posed, offset))


def _calibrated(calibration: JsonFields, sensor: str, raw: FloatArray) -> FloatArray:
    name = f"{sensor}.Model.RectificationMatrix"
    matrix = calibration.array(name, 3, 3)
    if abs(np.linalg.det(matrix)) < 1e-6:
        raise ReadError(calibration.path, name, "a singular matrix", "an invertible one")
    bias = calibration.array(f"{sensor}.Bias.Offset", 3)
    return np.asarray(raw @ np.linalg.inv(matrix).T - bias, dtype=np.float64)


def _imu_pose(
    calibration: JsonFields, sequence: ImuSequence, posed: ImuSequence, offset: float
) -> Trajectory:
    """Return the IMU's pose from the device's, whose clock is `offset` behind [s]."""
    time, truth = posed.time + offset, posed.truth
    inside = (time >= sequence.time[0]) & (time <= sequence.time[-1])
    if truth is None or not inside.any():
        found = f"times offset by {offset:.3f} s"
        raise ReadError(calibration.path.with_name(_RESAMPLED), _TIME, found, f"those of {_RAW}")
    truth = replace(truth, time=truth.time + offset)
    R_DI, p_DI = _device_imu(calibration)
    rate_I = interpolated(time[inside], sequence.time, sequence.gyro)
    own, turned = (
        np.square(rate - posed.gyro[inside]).mean() for rate in (rate_I, R_DI.apply(rate_I))
    )
    if own <= turned:
        return truth
    position_W = truth.position_W + truth.attitude_WB.apply(p_DI)
    return Trajectory(truth.time, position_W, truth.attitude_WB * R_DI)


def _device_imu(calibration: JsonFields) -> tuple[Rotation, FloatArray]:
    """Return R_DI and p_DI [m], identity if missing, from [w, [x, y, z]] or [w, x, y, z]."""
    name = "T_Device_Imu.UnitQuaternion"
    quat = calibration.get(name)
    if quat is None:
        return Rotation.identity(), np.zeros(3)
    nested = isinstance(quat, list) and len(quat) == 2 and isinstance(quat[1], list)
    R_DI = calibration.rotation(name, [quat[0], *quat[1]] if nested else quat)
    return R_DI, calibration.array("T_Device_Imu.Translation", 3)
