"""StarIO's archive: many recordings in one HDF5 file, each a group; one is named `file.h5:name`.

A group holds `imu/{t,gyro,accel}`, where known `mag/{t,field}`, and truth of one of three kinds:
`truth/{t,p,quat_xyzw}` (poses), `truth/{t,p}` (positions) or `waypoints/{t,xy}`. Units are s,
rad/s, m/s^2, uT and m; all clocks of a recording have the same zero. Its attributes say who carried
which device where.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import checked, optional_package, rotations
from stario.sequences.readers.text import magic
from stario.sequences.sequence import ImuSequence, Magnetometer, PositionTrack, Trajectory
from stario.sequences.time_order import advancing

SUFFIXES = (".h5", ".hdf5")

_HDF5_MAGIC = b"\x89HDF"
_RONIN = "data.hdf5"


def split_name(path: Path) -> tuple[Path, str | None]:
    """The archive's file and the recording's name in it: `file.h5:name`, or None without one."""
    text = str(path)
    for suffix in SUFFIXES:
        file, found, name = text.partition(f"{suffix}:")
        if found and name:
            return Path(file + suffix), name
    return path, None


def is_archive_member(path: Path) -> bool:
    """Whether a path names a recording in an archive."""
    file, name = split_name(path)
    return name is not None and is_archive(file)


def is_archive(path: Path) -> bool:
    """Whether a file is an archive: HDF5 whose groups hold an IMU's samples or a track.

    One that cannot be opened is taken for one, by its name: reading it says what is wrong.
    """
    if path.suffix.lower() not in SUFFIXES or magic(path, 4) != _HDF5_MAGIC:
        return False
    h5py = optional_package("h5py", "readers")
    try:
        with h5py.File(path) as file:
            first = next(iter(file.values()), None)
            return isinstance(first, h5py.Group) and ("imu/t" in first or "truth/t" in first)
    except OSError:
        return path.name != _RONIN


def archive_members(path: Path, **where: str) -> list[Path]:
    """`file.h5:name` of every recording of an archive that has an IMU.

    Args:
        path: the archive's file.
        where: attributes that a recording must have, as text: `person="dan"`.

    Raises:
        ReadError: the file cannot be read.
    """
    h5py = optional_package("h5py", "readers")
    with _opened(h5py, path) as file:
        return [
            Path(f"{path}:{name}")
            for name, group in file.items()
            if "imu/t" in group
            and all(str(group.attrs.get(key, "")) == value for key, value in where.items())
        ]


def read_archive(path: Path) -> ImuSequence:
    """Read one recording of an archive.

    Args:
        path: `file.h5:name`, or the file alone where it holds one recording.

    Raises:
        ReadError: the file or the recording is not there, or its content is malformed.
    """
    h5py = optional_package("h5py", "readers")
    file_path, name = split_name(path)
    with _opened(h5py, file_path) as file:
        names = list(file)
        if name is None and len(names) == 1:
            name = names[0]
        if name is None:
            found = f"{len(names)} of them"
            raise ReadError(
                file_path, "recording", found, "the name of one", f"{path.name}:{names[0]}"
            )
        if name not in file:
            known = ", ".join(names[:3])
            raise ReadError(file_path, "recording", repr(name), f"a name in it, as {known}")
        return _sequence(path, name, file[name])


def _sequence(path: Path, name: str, group: Any) -> ImuSequence:
    time = _column(path, group, "imu/t")
    truth, positions = _truth(path, group)
    return ImuSequence(
        name=name,
        time=time,
        gyro=_column(path, group, "imu/gyro"),
        accel=_column(path, group, "imu/accel"),
        truth=truth,
        converted=frozenset({"gyro", "accel"}),
        magnetometer=_magnetometer(path, group),
        positions=positions,
        attributes={key: _plain(value) for key, value in group.attrs.items()},
    )


def _magnetometer(path: Path, group: Any) -> Magnetometer | None:
    if "mag" not in group:
        return None
    time, field = _column(path, group, "mag/t"), _column(path, group, "mag/field")
    keep = advancing(time)
    return Magnetometer(time[keep], field[keep])


def _truth(path: Path, group: Any) -> tuple[Trajectory | None, PositionTrack | None]:
    """Poses, or else positions or waypoints."""
    if "waypoints" in group:
        time, xy = _column(path, group, "waypoints/t"), _column(path, group, "waypoints/xy")
        keep = advancing(time)
        return None, PositionTrack(time[keep], xy[keep], "waypoints")
    if "truth" not in group:
        return None, None
    time, position_W = _column(path, group, "truth/t"), _column(path, group, "truth/p")
    keep = advancing(time)
    if "truth/quat_xyzw" not in group:
        return None, PositionTrack(time[keep], position_W[keep], "positions")
    quat = np.asarray(group["truth/quat_xyzw"][:], dtype=np.float64)
    attitude_WB: Rotation = rotations(path, "truth/quat_xyzw", quat, "xyzw")
    return Trajectory(time[keep], position_W[keep], attitude_WB[keep]), None


def _column(path: Path, group: Any, field: str) -> Any:
    if field not in group:
        raise ReadError(path, field, "no such dataset", "an array of numbers")
    return checked(path, field, np.asarray(group[field][:], dtype=np.float64))


def _plain(value: Any) -> str | float:
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    return value if isinstance(value, str) else float(value)


def _opened(h5py: Any, path: Path) -> Any:
    try:
        return h5py.File(path)
    except OSError as error:
        fix = "is the download complete?"
        raise ReadError(path, "content", str(error), "a whole HDF5 archive", fix) from None
