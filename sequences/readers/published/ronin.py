"""RoNIN: `<sequence>/data.hdf5` with `info.json` alongside (Herath et al., ICRA 2020), 200 Hz.

`synced/time` [s], `synced/gyro_uncalib` [rad/s], `synced/acce` [m/s^2] and, if present,
`synced/magnet` [uT] are from a phone carried in any way; `pose/tango_pos` [m] and `pose/tango_ori`
from a second device on the chest, in a world with z up. Quaternions are w x y z. As the authors do,
`imu_init_gyro_bias` is subtracted from the gyroscope, the specific force is
`imu_acce_scale (acce - imu_acce_bias)`, rows before `start_frame` are skipped, and the phone's
attitude in the Tango's world is

    tango_ori[0] start_calibration conj(source[0]) source

where the source is the game rotation vector unless its error at the recording's end,
`grv_ori_error`, exceeds 20 degrees: then it is whichever of the integrated gyroscope, the game
rotation vector and `pose/ekf_ori` has the lowest error. The ground truth's position is therefore
that of the chest, its attitude that of the phone.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.rotations import integrated_gyro
from stario.sequences.errors import ReadError
from stario.sequences.readers.archive import is_hdf5, opened_hdf5
from stario.sequences.readers.checked import (
    finite_rows,
    magnetometer,
    rotations,
    trajectory,
)
from stario.sequences.readers.published.by_name import JsonFields
from stario.sequences.readers.text import IntArray
from stario.sequences.sequence import FloatArray, ImuSequence

_FIELDS = {
    "synced/time": (),
    "synced/gyro_uncalib": (3,),
    "synced/acce": (3,),
    "synced/game_rv": (4,),
    "pose/tango_pos": (3,),
    "pose/tango_ori": (4,),
}
_EKF = "pose/ekf_ori"
_MAGNETIC = "synced/magnet"
_OPTIONAL = {_EKF: (4,), _MAGNETIC: (3,)}

_TRUSTED_DEG = 20.0
"""Maximum error at which the game rotation vector is used, whatever the other errors."""


def read_ronin(path: Path) -> ImuSequence:
    """Read a recording from its folder or its `data.hdf5`."""
    file = path / "data.hdf5" if path.is_dir() else path
    if not file.is_file():
        raise ReadError(file, "file", "no such file", "the recording's HDF5 file")
    info = JsonFields(file.with_name("info.json"))
    fields = _fields(file)
    required = np.column_stack([fields[name] for name in _FIELDS])
    rows = finite_rows(file, "synced and pose", required)
    gyro = fields["synced/gyro_uncalib"] - info.array("imu_init_gyro_bias", 3)
    bias, scale = info.array("imu_acce_bias", 3), info.array("imu_acce_scale", 3)
    accel = scale * (fields["synced/acce"] - bias)
    attitude_WB = _device_attitude(file, info, fields, gyro, rows)
    frame, last = info.get("start_frame", 0), int(rows[-1])
    if not isinstance(frame, int) or not 0 <= frame <= last:
        raise ReadError(info.path, "start_frame", repr(frame), f"a row from 0 to {last}")
    start = int(np.searchsorted(rows, frame))
    rows, attitude_WB = rows[start:], attitude_WB[start:]
    time = fields["synced/time"][rows]
    time = time - time[0]
    return ImuSequence(
        name=file.resolve().parent.name,
        time=time,
        gyro=gyro[rows],
        accel=accel[rows],
        truth=trajectory(file, time, fields["pose/tango_pos"][rows], attitude_WB),
        magnetometer=magnetometer(time, fields[_MAGNETIC][rows]) if _MAGNETIC in fields else None,
    )


def is_ronin(path: Path) -> bool:
    """Return whether a path is an HDF5 file or a folder with `data.hdf5`."""
    return (path / "data.hdf5").is_file() or is_hdf5(path)


def _fields(file: Path) -> dict[str, FloatArray]:
    """Return the required fields and the optional ones present, all of one length."""
    with opened_hdf5(file, "HDF5 data") as data:
        names = [*_FIELDS, *(name for name in _OPTIONAL if name in data)]
        missing = [name for name in names if name not in data]
        if missing:
            raise ReadError(file, missing[0], "no such field", ", ".join(_FIELDS))
        fields = {name: np.asarray(data[name], dtype=np.float64) for name in names}
    count = len(fields["synced/time"]) if fields["synced/time"].ndim == 1 else 0
    for name, values in fields.items():
        shape = (count, *(_FIELDS | _OPTIONAL)[name])
        if values.shape != shape or not count:
            raise ReadError(file, name, f"shape {values.shape}", f"{shape} as for synced/time")
    return fields


def _device_attitude(
    file: Path,
    info: JsonFields,
    fields: dict[str, FloatArray],
    gyro: FloatArray,
    rows: IntArray,
) -> Rotation:
    """Return the phone's attitude in the Tango's world, from the source the authors would use."""

    def attitudes(name: str, rows: IntArray) -> Rotation:
        return rotations(file, name, fields[name], first_row=0, rows=rows)

    game_rv = attitudes("synced/game_rv", rows)
    name = _source(info, _EKF in fields)
    if name == "game_rv":
        source = game_rv
    elif name == "ekf":
        source = attitudes(_EKF, rows)
    else:
        source = game_rv[0] * integrated_gyro(fields["synced/time"][rows], gyro[rows])
    first = attitudes("pose/tango_ori", rows[:1])[0]
    calibration = info.array("start_calibration", 4)[None]
    R_TB = rotations(info.path, "start_calibration", calibration, first_row=0)[0]
    return first * R_TB * source[0].inv() * source


def _source(info: JsonFields, has_ekf: bool) -> str:
    fields = {"gyro": "gyro_integration_error", "game_rv": "grv_ori_error", "ekf": "ekf_ori_error"}
    if not has_ekf:
        del fields["ekf"]
    errors = {
        name: float(info.array(field))
        for name, field in fields.items()
        if info.get(field) is not None
    }
    if errors.get("game_rv", 0.0) <= _TRUSTED_DEG:
        return "game_rv"
    return min(errors, key=lambda name: errors[name])
