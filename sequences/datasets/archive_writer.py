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
from stario.sequences.readers.archive import PARTS, SUFFIXES, Layout, track_layout
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
    track, layouts = sequence.positions, dict(PARTS)
    if track is not None and track.kind == "positions" and sequence.truth is not None:
        _log.warning("%s: positions alongside true poses are not written", sequence.name)
    elif track is not None:
        flat = track.kind == "waypoints" and track.position_W.shape[1] == 2
        layouts["positions"] = track_layout(track.kind, "xy" if flat else "p")
    columns = {"imu/t": sequence.time, "imu/gyro": sequence.gyro, "imu/accel": sequence.accel}
    for attribute, layout in layouts.items():
        if layout is not None and (part := getattr(sequence, attribute)) is not None:
            columns |= _columns(layout, part)
    for name, values in columns.items():
        group.create_dataset(name, data=values, **(_COMPRESSION if len(values) else {}))
    for key, value in sequence.attributes.items():
        group.attrs[key] = value


def _columns(layout: Layout, part: Timed) -> dict[str, FloatArray]:
    """Return the known attributes of a part by their datasets' names.

    Flags are left out if all are True, which is what a reader takes for granted.
    """
    columns = {}
    for name, attribute in ({"t": "time"} | layout.needed | layout.optional).items():
        value = getattr(part, attribute)
        if value is not None and not (attribute == "valid" and value.all()):
            value = value.as_quat() if attribute == "attitude_WB" else value
            columns[f"{layout.stem}/{name}"] = value
    return columns
