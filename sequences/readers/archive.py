"""StarIO's archive: an HDF5 file with a group per recording; `file.h5:name` names a recording.

A group holds `imu/{t,gyro,accel}`, if known `mag/{t,field}`, `pressure/{t,hPa}` and
`satellites/{t,latlon_deg,altitude_m,radius_m,speed_m_s,bearing_deg}`, and one of three kinds of
truth: `truth/{t,p,quat_xyzw}` (poses), `truth/{t,p}` (positions) or `waypoints/{t,xy}` (or `p`).
Units are s, rad/s, m/s^2, uT and m; all clocks of a recording have the same zero. Its attributes
record who carried which device where. Poses may come with
`truth/{velocity,position_covariance,valid}`, positions with `sigma`, `latlon_deg` and `floor`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stario.sequences.arrays import first_of
from stario.sequences.errors import ReadError, StarioError
from stario.sequences.lazy import optional_package
from stario.sequences.readers.checked import OPTIONAL, checked, pose_mask, rotations
from stario.sequences.readers.lines import first_bytes
from stario.sequences.sequence import (
    Barometer,
    BoolArray,
    DeviceAttitude,
    FloatArray,
    ImuSequence,
    Magnetometer,
    PositionTrack,
    Satellites,
    Trajectory,
)
from stario.sequences.time_order import increasing_mask

SUFFIXES = (".h5", ".hdf5")

AttributeFilter = Mapping[str, Sequence[str]]
"""Filter of recordings: patterns for each attribute, one of which must match."""

_RONIN = "data.hdf5"
_EXPECTED = "an intact HDF5 archive"
_OPTIONAL = {
    "velocity_W": ("truth/velocity", (3,)),
    "position_covariance_W": ("truth/position_covariance", (3, 3)),
}

POSITIONS_OPTIONAL = ("sigma", "latlon_deg", "floor")
SATELLITES_OPTIONAL = tuple(OPTIONAL.values())


def split_name(path: Path) -> tuple[Path, str | None]:
    """Split `file.h5:name` into the archive's file and the recording's name, None without one."""
    text = str(path)
    for suffix in SUFFIXES:
        stop = text.lower().find(f"{suffix}:") + len(suffix)
        if stop >= len(suffix) and text[stop + 1 :]:
            return Path(text[:stop]), text[stop + 1 :]
    return path, None


def is_archive(path: Path) -> bool:
    """Return whether a file is an archive: HDF5 with a group that holds IMU samples or a track.

    A file that cannot be opened counts as one unless it is named like RoNIN's: reading it then
    raises an error that names the damage.
    """
    if path.suffix.lower() not in SUFFIXES or not is_hdf5(path):
        return False
    h5py = optional_package("h5py", "readers")
    try:
        with h5py.File(path) as file:
            groups = (group for group in file.values() if isinstance(group, h5py.Group))
            return any("imu/t" in group or "truth/t" in group for group in groups)
    except DAMAGED:
        return path.name != _RONIN


def archive_members(path: Path, where: AttributeFilter | None = None) -> list[Path]:
    """Return `file.h5:name` for each recording in an archive with IMU data, reading no samples.

    Args:
        path: the archive's file.
        where: patterns for each attribute, one of which must match its text, `*` for anything:
            `{"person": ["dan", "ha*"]}`.

    Raises:
        ReadError: the file cannot be read, or no recording matches; then the error lists the
            values present.
    """
    wanted = where or {}
    with opened_hdf5(path, _EXPECTED) as file:
        known = {
            name: {**(_attributes(group) if wanted else {}), "name": name}
            for name, group in file.items()
            if "imu/t" in group
        }
    chosen = [name for name, attributes in known.items() if _matches(attributes, wanted)]
    if known and not chosen:
        raise _none_chosen(path, list(known.values()), wanted)
    return [Path(f"{path}:{name}") for name in chosen]


def archive_attributes(path: Path) -> dict[str, str | float]:
    """Return the attributes of `file.h5:name` without its samples; empty for other paths."""
    file_path, name = split_name(path)
    if name is None:
        return {}
    with opened_hdf5(file_path, _EXPECTED) as file:
        return _attributes(file[name])


def _attributes(group: Any) -> dict[str, str | float]:
    return {key: _plain(value) for key, value in group.attrs.items()}


def filter_words(where: AttributeFilter) -> str:
    """Return a filter as it is written in a list."""
    return ", ".join(f"{key}={value}" for key, values in where.items() for value in values)


def _matches(attributes: Mapping[str, str | float], where: AttributeFilter) -> bool:
    return all(
        any(fnmatchcase(_text(attributes.get(key, "")), pattern) for pattern in patterns)
        for key, patterns in where.items()
    )


def _none_chosen(
    path: Path, known: list[dict[str, str | float]], where: AttributeFilter
) -> ReadError:
    none_match = (
        key
        for key, patterns in where.items()
        if not any(_matches(attributes, {key: patterns}) for attributes in known)
    )
    key = next(none_match, next(iter(where)))
    values = sorted({_text(attributes.get(key, "")) for attributes in known} - {""})
    listed = first_of(values, 6)
    expected = f"{key} to be one of {listed}" if listed else f"another attribute: none has {key}"
    return ReadError(path, f"recordings with {filter_words(where)}", "none", expected)


def _text(value: str | float) -> str:
    return value if isinstance(value, str) else f"{value:g}"


def read_archive(path: Path) -> ImuSequence:
    """Read one recording from an archive.

    Args:
        path: `file.h5:name`, or only the file if it holds a single recording.

    Raises:
        ReadError: the file or the recording does not exist, or its content is malformed.
    """
    file_path, name = split_name(path)
    with opened_hdf5(file_path, _EXPECTED) as file:
        names = list(file)
        if name is None and len(names) == 1:
            name = names[0]
        if name is None:
            found, fix = f"{len(names)} recordings", f"use {path.name}:{names[0]}"
            raise ReadError(file_path, "recording", found, "the name of one", fix)
        if name not in file:
            known = ", ".join(names[:3])
            raise ReadError(file_path, "recording", repr(name), f"a name in it, such as {known}")
        return _sequence(path, name, file[name])


def _sequence(path: Path, name: str, group: Any) -> ImuSequence:
    truth, positions = _truth(path, group)
    field = _samples(path, group, "mag", "field", 3)
    pressure = _samples(path, group, "pressure", "hPa")
    time = _column(path, group, "imu/t", finite=False)
    return ImuSequence(
        name=name,
        time=time,
        gyro=_column(path, group, "imu/gyro", (len(time), 3), finite=False),
        accel=_column(path, group, "imu/accel", (len(time), 3), finite=False),
        truth=truth,
        converted=frozenset({"gyro", "accel", "sign"}),
        magnetometer=None if field is None else Magnetometer(*field),
        positions=positions,
        device_attitude=_device_attitude(path, group),
        barometer=None if pressure is None else Barometer(*pressure),
        satellites=_satellites(path, group),
        attributes=_attributes(group),
    )


def _samples(
    path: Path, group: Any, stem: str, name: str, *columns: int
) -> tuple[FloatArray, FloatArray] | None:
    """Return times (N,) that increase and values (N, *columns) of a sensor; None without it."""
    if stem not in group:
        return None
    time = _column(path, group, f"{stem}/t")
    values = _column(path, group, f"{stem}/{name}", (len(time), *columns))
    keep = increasing_mask(time)
    return time[keep], values[keep]


def _device_attitude(path: Path, group: Any) -> DeviceAttitude | None:
    found = _samples(path, group, "attitude", "quat_xyzw", 4)
    if found is None:
        return None
    return DeviceAttitude(found[0], rotations(path, "attitude/quat_xyzw", found[1], "xyzw"))


def _satellites(path: Path, group: Any) -> Satellites | None:
    if "satellites" not in group:
        return None
    time = _column(path, group, "satellites/t")
    latlon_deg = _column(path, group, "satellites/latlon_deg", (len(time), 2))
    keep = increasing_mask(time)
    rest = _optional(path, group, "satellites", SATELLITES_OPTIONAL, time)
    return Satellites(time[keep], latlon_deg[keep], **{k: v[keep] for k, v in rest.items()})


def _optional(
    path: Path, group: Any, stem: str, names: Iterable[str], time: FloatArray
) -> dict[str, FloatArray]:
    """Return the columns of a part that are there, which may hold NaN."""
    shapes = {"latlon_deg": (len(time), 2)}
    return {
        name: _column(path, group, f"{stem}/{name}", shapes.get(name, time.shape), finite=False)
        for name in names
        if f"{stem}/{name}" in group
    }


def _truth(path: Path, group: Any) -> tuple[Trajectory | None, PositionTrack | None]:
    """Return the poses, and the positions or waypoints."""
    positions = None
    if "waypoints" in group:
        place = "waypoints/xy" if "waypoints/xy" in group else "waypoints/p"
        positions = _positions(path, group, "waypoints", place)
    if "truth" not in group:
        return None, positions
    if "truth/quat_xyzw" not in group:
        return None, _positions(path, group, "positions", "truth/p")
    time = _column(path, group, "truth/t")
    keep = pose_mask(path, time)
    valid = _valid(path, group, "truth", time)
    quat = _column(path, group, "truth/quat_xyzw", (len(time), 4), finite=False)
    _check_known(path, "truth/quat_xyzw", quat, valid)
    # Invalid rows may hold anything, but each must become a rotation.
    finite = np.isfinite(quat).all(axis=1)
    quat = np.where(finite.reshape(-1, 1), quat, [0.0, 0.0, 0.0, 1.0])
    attitude_WB = rotations(path, "truth/quat_xyzw", quat[keep], "xyzw")
    optional = {
        name: _column(path, group, field, (len(time), *shape), finite=False)[keep]
        for name, (field, shape) in _OPTIONAL.items()
        if field in group
    }
    position_W = _column(path, group, "truth/p", (len(time), 3), finite=False)
    _check_known(path, "truth/p", position_W, valid)
    truth = Trajectory(time[keep], position_W[keep], attitude_WB, valid=valid[keep], **optional)
    return truth, positions


def _positions(
    path: Path, group: Any, kind: Literal["positions", "waypoints"], field: str
) -> PositionTrack:
    stem = field.split("/")[0]
    time = _column(path, group, f"{stem}/t")
    keep = pose_mask(path, time)
    valid = _valid(path, group, stem, time)
    position_W = _column(path, group, field, (len(time), 2), (len(time), 3), finite=False)
    _check_known(path, field, position_W, valid)
    rest = _optional(path, group, stem, POSITIONS_OPTIONAL, time)
    known = {name: values[keep] for name, values in rest.items()}
    return PositionTrack(time[keep], position_W[keep], kind, valid[keep], **known)


def _valid(path: Path, group: Any, stem: str, time: FloatArray) -> BoolArray:
    field = f"{stem}/valid"
    if field not in group:
        return np.ones(len(time), dtype=np.bool_)
    return np.asarray(_column(path, group, field, (len(time),)), dtype=np.bool_)


def _check_known(path: Path, field: str, values: FloatArray, valid: BoolArray) -> None:
    """Check that the truth's values (N, K) are finite where it is valid."""
    bad = valid & ~np.isfinite(values).all(axis=1)
    if bad.any():
        where = f"row {int(np.argmax(bad)) + 1}, {field}"
        fix = f"write False there in {field.split('/')[0]}/valid"
        raise ReadError(path, where, "a value that is not finite", "finite numbers", fix)


def _column(
    path: Path, group: Any, field: str, *shapes: tuple[int, ...], finite: bool = True
) -> FloatArray:
    """Return a dataset as numbers of one of some shapes, (N,) with any N > 0 without shapes.

    IMU samples may be NaN, which the health report counts.
    """
    if field not in group:
        raise ReadError(path, field, "no such dataset", "an array of numbers")
    dataset = group[field]
    if not hasattr(dataset, "dtype"):
        raise ReadError(path, field, "a group", "a dataset of numbers")
    if dataset.dtype.kind not in "fiub":
        raise ReadError(path, field, f"values of type {dataset.dtype}", "an array of numbers")
    if not (dataset.shape in shapes if shapes else dataset.ndim == 1 and dataset.size):
        expected = " or ".join(map(str, shapes)) or "(N,) with at least one"
        raise ReadError(path, field, f"shape {dataset.shape}", expected)
    values: FloatArray = np.asarray(dataset[:], dtype=np.float64)
    return checked(path, field, values) if finite else values


def _plain(value: Any) -> str | float:
    if isinstance(value, bytes):
        return value.decode(errors="replace")
    try:
        return value if isinstance(value, str) else float(value)
    except (TypeError, ValueError):
        return str(value)


_MAGIC = b"\x89HDF\r\n\x1a\n"

DAMAGED = (OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError, AttributeError)
"""Exceptions of h5py and NumPy for a damaged file, or for one with other content."""


def is_hdf5(path: Path) -> bool:
    """Return whether a file is HDF5, by its first bytes; never raises."""
    return first_bytes(path, len(_MAGIC)) == _MAGIC


@contextmanager
def opened_hdf5(path: Path, expected: str) -> Iterator[Any]:
    """Open a file for reading; damage or other content found in the block becomes a ReadError.

    Args:
        path: the file.
        expected: what the file should be, for the error.

    Raises:
        ReadError: the file or what the block reads from it is damaged.
        MissingPackageError: h5py is not installed.
    """
    h5py = optional_package("h5py", "readers")
    try:
        with h5py.File(path) as file:
            yield file
    except StarioError:
        raise
    except DAMAGED as error:
        found = " ".join(str(error).split())[:200] or type(error).__name__
        locked = isinstance(error, BlockingIOError) or "already open for write" in found
        fix = "close it in the program that writes it" if locked else "is the download complete?"
        raise ReadError(path, "content", found, expected, fix) from error
