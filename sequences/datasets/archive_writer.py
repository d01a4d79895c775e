"""Writer of StarIO's archive: many recordings in one HDF5 file, each in a group of its name.

The layout is the one that `stario.sequences.readers.archive` reads. Numbers are written unchanged,
in double precision and compressed, so that they are read back bit for bit (attitudes to the last
digit of their quaternions).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from stario.sequences.auxiliary import Timed
from stario.sequences.errors import InputError
from stario.sequences.files import atomic_path, unused_name
from stario.sequences.lazy import optional_package
from stario.sequences.readers.archive import POSITIONS_OPTIONAL, SATELLITES_OPTIONAL, SUFFIXES
from stario.sequences.sequence import FloatArray, ImuSequence, PositionTrack, Trajectory

_log = logging.getLogger(__name__)

_COMPRESSION = {"compression": "gzip", "compression_opts": 4, "shuffle": True}


def write_archive(path: Path | str, sequences: Iterable[ImuSequence]) -> list[str]:
    """Write recordings into one archive, atomically; an existing file is replaced.

    Args:
        path: the archive file, `.h5` or `.hdf5`.
        sequences: recordings, consumed one by one, so that they need not fit into memory together.

    Returns:
        The names under which they are stored: their own, with `-2`, `-3`, ... appended if a name
        is taken, and with `-` instead of a slash.

    Raises:
        InputError: the file's name has another suffix, its folder does not exist, there is no
            recording, or h5py is not installed.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise InputError("path", str(path), f"a file name ending in {' or '.join(SUFFIXES)}")
    h5py = optional_package("h5py", "readers")
    names: list[str] = []
    with atomic_path(path) as temporary:
        with h5py.File(temporary, "x") as file:
            for sequence in sequences:
                name = sequence.name.replace("/", "-") or "recording"
                names.append(unused_name(name, file))
                _write(file.create_group(names[-1]), sequence)
        if not names:
            raise InputError(str(path), "no recording", "at least one recording")
    return names


def _write(group: Any, sequence: ImuSequence) -> None:
    columns = {"imu/t": sequence.time, "imu/gyro": sequence.gyro, "imu/accel": sequence.accel}
    if sequence.magnetometer is not None:
        columns["mag/t"] = sequence.magnetometer.time
        columns["mag/field"] = sequence.magnetometer.field
    if sequence.device_attitude is not None:
        columns["attitude/t"] = sequence.device_attitude.time
        columns["attitude/quat_xyzw"] = sequence.device_attitude.attitude_WB.as_quat()
    if sequence.barometer is not None:
        columns["pressure/t"] = sequence.barometer.time
        columns["pressure/hPa"] = sequence.barometer.pressure_hPa
    if sequence.satellites is not None:
        names = ("latlon_deg", *SATELLITES_OPTIONAL)
        columns |= _known_columns("satellites", sequence.satellites, names)
    if sequence.truth is not None:
        columns |= _pose_columns(sequence.truth)
    if sequence.positions is not None:
        columns |= _position_columns(sequence, sequence.positions)
    for name, values in columns.items():
        group.create_dataset(name, data=values, **(_COMPRESSION if len(values) else {}))
    for key, value in sequence.attributes.items():
        group.attrs[key] = value


def _pose_columns(truth: Trajectory) -> dict[str, FloatArray]:
    columns: dict[str, Any] = {
        "truth/t": truth.time,
        "truth/p": truth.position_W,
        "truth/quat_xyzw": truth.quat_xyzw,
        "truth/velocity": truth.velocity_W,
        "truth/position_covariance": truth.position_covariance_W,
        "truth/valid": None if truth.valid.all() else truth.valid,
    }
    return {name: values for name, values in columns.items() if values is not None}


def _position_columns(sequence: ImuSequence, track: PositionTrack) -> dict[str, FloatArray]:
    if track.kind == "waypoints":
        stem, place = "waypoints", "xy" if track.position_W.shape[1] == 2 else "p"
    elif sequence.truth is None:
        stem, place = "truth", "p"
    else:
        _log.warning("%s: positions alongside true poses are not written", sequence.name)
        return {}
    columns = _known_columns(stem, track, POSITIONS_OPTIONAL)
    columns[f"{stem}/{place}"] = track.position_W
    if not track.valid.all():
        columns[f"{stem}/valid"] = track.valid
    return columns


def _known_columns(stem: str, part: Timed, names: Iterable[str]) -> dict[str, Any]:
    """Return the time and the known attributes of a part, by the names of their datasets."""
    columns = {f"{stem}/{name}": getattr(part, name) for name in names}
    known = {name: values for name, values in columns.items() if values is not None}
    return {f"{stem}/t": part.time, **known}
