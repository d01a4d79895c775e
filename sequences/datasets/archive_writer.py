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
from stario.sequences.sequence import FloatArray, ImuSequence

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
    satellites = {name: name for name in ("latlon_deg", *SATELLITES_OPTIONAL)}
    columns = {
        "imu/t": sequence.time,
        "imu/gyro": sequence.gyro,
        "imu/accel": sequence.accel,
        **_known("mag", sequence.magnetometer, field="field"),
        **_known("attitude", sequence.device_attitude, quat_xyzw="attitude_WB"),
        **_known("pressure", sequence.barometer, hPa="pressure_hPa"),
        **_known("satellites", sequence.satellites, **satellites),
        **_known(
            "truth",
            sequence.truth,
            p="position_W",
            quat_xyzw="attitude_WB",
            velocity="velocity_W",
            position_covariance="position_covariance_W",
            valid="valid",
        ),
        **_positions(sequence),
    }
    for name, values in columns.items():
        group.create_dataset(name, data=values, **(_COMPRESSION if len(values) else {}))
    for key, value in sequence.attributes.items():
        group.attrs[key] = value


def _positions(sequence: ImuSequence) -> dict[str, FloatArray]:
    track = sequence.positions
    if track is None:
        return {}
    stem, place = "truth", "p"
    if track.kind == "waypoints":
        stem, place = "waypoints", "xy" if track.position_W.shape[1] == 2 else "p"
    elif sequence.truth is not None:
        _log.warning("%s: positions alongside true poses are not written", sequence.name)
        return {}
    names = {name: name for name in (*POSITIONS_OPTIONAL, "valid")}
    return _known(stem, track, **{place: "position_W"}, **names)


def _known(stem: str, part: Timed | None, **names: str) -> dict[str, FloatArray]:
    """Return the time and the known attributes of a part by their datasets' names.

    Flags are left out if all are True, which is what a reader takes for granted.
    """
    if part is None:
        return {}
    columns = {f"{stem}/t": part.time}
    for name, attribute in names.items():
        value = getattr(part, attribute)
        if value is not None and not (attribute == "valid" and value.all()):
            columns[f"{stem}/{name}"] = value.as_quat() if attribute == "attitude_WB" else value
    return columns
