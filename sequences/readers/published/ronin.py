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
from stario.sequences.readers.checked import magnetometer, trajectory
from stario.sequences.readers.published.fields import Fields, JsonFields
from stario.sequences.sequence import FloatArray, ImuSequence

_TIME, _GYRO, _ACCEL = "synced/time", "synced/gyro_uncalib", "synced/acce"
_GAME_RV, _EKF, _MAGNETIC = "synced/game_rv", "pose/ekf_ori", "synced/magnet"
_POSITION, _ATTITUDE = "pose/tango_pos", "pose/tango_ori"
_OPTIONAL = (_EKF, _MAGNETIC)
_WIDTHS = {_GYRO: 3, _ACCEL: 3, _GAME_RV: 4, _POSITION: 3, _ATTITUDE: 4, _EKF: 4, _MAGNETIC: 3}

_ERRORS = {"gyro": "gyro_integration_error", _GAME_RV: "grv_ori_error", _EKF: "ekf_ori_error"}
"""Names of the errors at a recording's end of the sources of attitude [degrees]."""

_TRUSTED_DEG = 20.0
"""Maximum error at which the game rotation vector is used, whatever the other errors."""


def read_ronin(path: Path) -> ImuSequence:
    """Read a recording from its folder or its `data.hdf5`."""
    file = path / "data.hdf5" if path.is_dir() else path
    if not file.is_file():
        raise ReadError(file, "file", "no such file", "the recording's HDF5 file")
    fields = _fields(file)
    info = JsonFields(file.with_name("info.json"))
    gyro = fields[_GYRO] - info.array("imu_init_gyro_bias", 3)
    accel = info.array("imu_acce_scale", 3) * (fields[_ACCEL] - info.array("imu_acce_bias", 3))
    attitude_WB = _device_attitude(info, fields, gyro)
    frame, last = info.get("start_frame", 0), int(fields.rows[-1])
    if not isinstance(frame, int) or not 0 <= frame <= last:
        raise ReadError(info.path, "start_frame", repr(frame), f"a row from 0 to {last}")
    used = slice(int(np.searchsorted(fields.rows, frame)), None)
    time, field = fields[_TIME][used], fields.get(_MAGNETIC)
    time = time - time[0]
    return ImuSequence(
        name=file.resolve().parent.name,
        time=time,
        gyro=gyro[used],
        accel=accel[used],
        truth=trajectory(file, time, fields[_POSITION][used], attitude_WB[used]),
        magnetometer=None if field is None else magnetometer(time, field[used]),
    )


def is_ronin(path: Path) -> bool:
    """Return whether a path is an HDF5 file or a folder with `data.hdf5`."""
    return (path / "data.hdf5").is_file() or is_hdf5(path)


def _fields(file: Path) -> Fields:
    """Return the required fields and the optional ones present, all of one length."""
    with opened_hdf5(file, "HDF5 data") as data:
        if "synced" not in data:  # any HDF5 that is no archive comes here
            expected = "imu/t in each group, as in archives, or RoNIN's synced/time"
            raise ReadError(file, "content", "no recordings in a known format", expected)
        names = [name for name in (_TIME, *_WIDTHS) if name in data or name not in _OPTIONAL]
        if missing := [name for name in names if name not in data]:
            raise ReadError(file, missing[0], "no such field", ", ".join(names))
        arrays = {name: np.asarray(data[name], dtype=np.float64) for name in names}
    count = len(arrays[_TIME]) if arrays[_TIME].ndim == 1 else 0
    for name, values in arrays.items():
        shape = (count, _WIDTHS[name]) if name in _WIDTHS else (count,)
        if values.shape != shape or not count:
            raise ReadError(file, name, f"shape {values.shape}", f"{shape} as for {_TIME}")
    return Fields(file, arrays, _OPTIONAL)


def _device_attitude(info: JsonFields, fields: Fields, gyro: FloatArray) -> Rotation:
    """Return the phone's attitude in the Tango's world, from the source the authors would use."""
    game_rv = fields.rotations(_GAME_RV)
    known = [name for name in _ERRORS if name in fields or name == "gyro"]
    given = [name for name in known if info.get(_ERRORS[name]) is not None]
    errors = {name: float(info.array(_ERRORS[name])) for name in given}
    trusted = errors.get(_GAME_RV, 0.0) <= _TRUSTED_DEG
    name = _GAME_RV if trusted else min(errors, key=lambda name: errors[name])
    if name == "gyro":
        source = game_rv[0] * integrated_gyro(fields[_TIME], gyro)
    else:
        source = game_rv if name == _GAME_RV else fields.rotations(name)
    first = fields.rotations(_ATTITUDE, count=1)[0]
    return first * info.rotation("start_calibration") * source[0].inv() * source
