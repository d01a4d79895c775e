"""StarIO's archive: an HDF5 file with a group per recording; `file.h5:name` names a recording.

A group holds `imu/{t,gyro,accel}`, if known `mag/{t,field}`, `pressure/{t,hPa}` and
`satellites/{t,latlon_deg,altitude_m,radius_m,speed_m_s,bearing_deg}`, and one of three kinds of
truth: `truth/{t,p,quat_xyzw}` (poses), `truth/{t,p}` (positions) or `waypoints/{t,xy}` (or `p`).
Units are s, rad/s, m/s^2, uT and m; all clocks of a recording have the same zero. Its attributes
record who carried which device where. Poses may come with
`truth/{velocity,position_covariance,valid}`, positions with `sigma`, `latlon_deg` and `floor`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import partial
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
_OF_POSES = {"velocity": (3,), "position_covariance": (3, 3)}
POSITIONS_OPTIONAL = ("sigma", "latlon_deg", "floor")
SATELLITES_OPTIONAL = tuple(OPTIONAL.values())

_MAGIC = b"\x89HDF\r\n\x1a\n"

DAMAGED = (OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError, AttributeError)
"""Exceptions of h5py and NumPy for a damaged file, or for one with other content."""


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
    part = partial(_part, path, group)
    time = _column(path, group, "imu/t", finite=False)
    truth, positions = _truth(path, group)
    field, pressure = part("mag", {"field": [(3,)]}), part("pressure", {"hPa": [()]})
    own = part("attitude", {"quat_xyzw": [(4,)]})
    reported = part("satellites", {"latlon_deg": [(2,)]}, dict.fromkeys(SATELLITES_OPTIONAL, ()))
    if own is not None:
        own["attitude_WB"] = rotations(path, "attitude/quat_xyzw", own.pop("quat_xyzw"), "xyzw")
    return ImuSequence(
        name=name,
        time=time,
        gyro=_column(path, group, "imu/gyro", (len(time), 3), finite=False),
        accel=_column(path, group, "imu/accel", (len(time), 3), finite=False),
        truth=truth,
        converted=frozenset({"gyro", "accel", "sign"}),
        magnetometer=Magnetometer(**field) if field else None,
        positions=positions,
        device_attitude=DeviceAttitude(**own) if own else None,
        barometer=Barometer(*pressure.values()) if pressure else None,
        satellites=Satellites(**reported) if reported else None,
        attributes=_attributes(group),
    )


def _part(
    path: Path,
    group: Any,
    stem: str,
    required: Mapping[str, Sequence[tuple[int, ...]]],
    optional: Mapping[str, tuple[int, ...]] | None = None,
    known: bool = False,
) -> dict[str, Any] | None:
    """Return the times that increase and the columns of a part by name; None without it.

    A row of a `required` column may have any of some shapes; `optional` columns may lack, and hold
    NaN. In a truth (`known`), others may hold NaN too where "valid" is False.
    """
    if stem not in group:
        return None
    time = _column(path, group, f"{stem}/t")
    columns: dict[str, Any] = {"time": time}
    valid = np.ones(len(time), dtype=np.bool_)
    if known and f"{stem}/valid" in group:
        valid = np.asarray(_column(path, group, f"{stem}/valid", time.shape), dtype=np.bool_)
    for name, rows in required.items():
        shapes = [(len(time), *row) for row in rows]
        values = _column(path, group, f"{stem}/{name}", *shapes, finite=not known)
        if (bad := valid & ~np.isfinite(values.reshape(len(time), -1)).all(axis=1)).any():
            where, fix = f"row {int(np.argmax(bad)) + 1}, {stem}/{name}", f"{stem}/valid"
            found = "a value that is not finite"
            raise ReadError(path, where, found, "finite numbers", f"write False there in {fix}")
        columns[name] = values
    for name, row in (optional or {}).items():
        if f"{stem}/{name}" in group:
            shape = len(time), *row
            columns[name] = _column(path, group, f"{stem}/{name}", shape, finite=False)
    keep = pose_mask(path, time) if known else increasing_mask(time)
    columns |= {"valid": valid} if known else {}
    return {name: values[keep] for name, values in columns.items()}


def _truth(path: Path, group: Any) -> tuple[Trajectory | None, PositionTrack | None]:
    """Return the poses, and the positions or waypoints."""
    place = "xy" if "waypoints/xy" in group else "p"
    positions = _positions(path, group, "waypoints", "waypoints", place)
    if "truth/quat_xyzw" not in group:
        return None, _positions(path, group, "truth", "positions", "p") or positions
    poses = _part(
        path, group, "truth", {"quat_xyzw": [(4,)], "p": [(3,)]},
        _OF_POSES, known=True,
    )  # fmt: skip
    assert poses is not None
    # Invalid rows may hold anything, but each must become a rotation.
    quat = poses.pop("quat_xyzw")
    quat = np.where(np.isfinite(quat).all(axis=1)[:, None], quat, [0.0, 0.0, 0.0, 1.0])
    attitude_WB = rotations(path, "truth/quat_xyzw", quat, "xyzw")
    named = {f"{name}_W": poses.pop(name) for name in _OF_POSES if name in poses}
    truth = Trajectory(position_W=poses.pop("p"), attitude_WB=attitude_WB, **poses, **named)
    return truth, positions


def _positions(
    path: Path, group: Any, stem: str, kind: Literal["positions", "waypoints"], place: str
) -> PositionTrack | None:
    optional = {name: (2,) if name == "latlon_deg" else () for name in POSITIONS_OPTIONAL}
    found = _part(path, group, stem, {place: [(2,), (3,)]}, optional, known=True)
    return PositionTrack(position_W=found.pop(place), kind=kind, **found) if found else None


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
