"""StarIO's archive: an HDF5 file with a group per recording; `file.h5:name` names a recording.

A group holds the samples in `imu/{t,gyro,accel}`, the parts that `PARTS` lists and one of three
kinds of truth: `truth/{t,p,quat_xyzw}` (poses), `truth/{t,p}` (positions) or `waypoints/{t,xy}` (or
`p`); its attributes record who carried which device where. The guide to formats
(examples/guides/formats.md) names all datasets and their units; all clocks of a recording have the
same zero. Numbers are written unchanged, in double precision and compressed.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from stario.sequences.arrays import (
    as_float64,
    checked_array,
    checked_valid,
    finite_times,
    shortlist,
)
from stario.sequences.errors import InputError, ReadError, StarioError
from stario.sequences.files import atomic_path, unused_name
from stario.sequences.lazy import optional_package
from stario.sequences.readers.checked import OPTIONAL, captured_rotations, pose_mask
from stario.sequences.readers.text import first_bytes
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

_log = logging.getLogger(__name__)

SUFFIXES = (".h5", ".hdf5")

AttributeFilter = Mapping[str, Sequence[str]]
"""Filter of recordings: patterns for each attribute, one of which must match."""

_RONIN = "data.hdf5"
_EXPECTED = "an intact HDF5 archive"
_COMPRESSION = {"compression": "gzip", "compression_opts": 4, "shuffle": True}
_MAGIC = b"\x89HDF\r\n\x1a\n"

DAMAGED = (OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError, AttributeError)
"""Exceptions of h5py and NumPy for a damaged file, or for one with other content."""


class Layout(NamedTuple):
    """How a part of a recording is kept: its group, its class, and attributes by dataset.

    The dataset `t` holds its times; `optional` ones may lack.
    """

    stem: str
    kind: Callable[..., Any]
    needed: dict[str, str]
    optional: dict[str, str]


_OF_POSES = ("velocity", "position_covariance")

PARTS = {
    "truth": Layout(
        "truth",
        Trajectory,
        {"p": "position_W", "quat_xyzw": "attitude_WB"},
        {name: f"{name}_W" for name in _OF_POSES} | {"valid": "valid"},
    ),
    "magnetometer": Layout("mag", Magnetometer, {"field": "field"}, {}),
    "device_attitude": Layout("attitude", DeviceAttitude, {"quat_xyzw": "attitude_WB"}, {}),
    "barometer": Layout("pressure", Barometer, {"hPa": "pressure_hPa"}, {}),
    "satellites": Layout(
        "satellites",
        Satellites,
        {"latlon_deg": "latlon_deg"},
        {name: name for name in OPTIONAL.values()},
    ),
}
"""Parts by the attribute of a recording; `track_layout` has its positions."""


def track_layout(kind: Literal["positions", "waypoints"], place: str = "p") -> Layout:
    """Return the layout of positions, in the dataset `place`, without attitude."""
    optional = {name: name for name in ("sigma", "latlon_deg", "floor", "valid")}
    stem = "truth" if kind == "positions" else "waypoints"
    return Layout(stem, partial(PositionTrack, kind=kind), {place: "position_W"}, optional)


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
    try:
        with opened_hdf5(path, _EXPECTED) as file:
            groups = _groups(file).values()
            return any("imu/t" in group or "truth/t" in group for group in groups)
    except ReadError:
        return path.name != _RONIN


def _groups(file: Any) -> dict[str, Any]:
    """Return a file's groups by name, without datasets beside them."""
    return {name: group for name, group in file.items() if hasattr(group, "keys")}


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
            for name, group in _groups(file).items()
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
    matched = {key for key in where for one in known if _matches(one, {key: where[key]})}
    key = next((key for key in where if key not in matched), next(iter(where)))
    values = sorted({_text(attributes.get(key, "")) for attributes in known} - {""})
    listed = shortlist(values, 6)
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
        names = list(_groups(file))
        if not names:
            raise ReadError(file_path, "recordings", "no group", "one for each, with its imu/t")
        if name is None and len(names) == 1:
            name = names[0]
        if name is None:
            found, fix = f"{len(names)} recordings", f"use {path.name}:{names[0]}"
            raise ReadError(file_path, "recording", found, "the name of one", fix)
        if not hasattr(file.get(name), "keys"):
            known = ", ".join(names[:3])
            raise ReadError(file_path, "recording", repr(name), f"a name in it, such as {known}")
        try:
            return _sequence(path, name, file[name])
        except InputError as error:
            raise ReadError(path, error.field, error.found, error.expected, error.fix) from None


def _sequence(path: Path, name: str, group: Any) -> ImuSequence:
    layouts = dict(PARTS)
    if "truth/quat_xyzw" not in group:
        del layouts["truth"]
        layouts["positions"] = track_layout("positions")
    if "waypoints" in group:
        place = "xy" if "waypoints/xy" in group else "p"
        layouts["positions"] = track_layout("waypoints", place)
    time, gyro, accel = (_numbers(group, f"imu/{field}") for field in ("t", "gyro", "accel"))
    return ImuSequence(
        name,
        time,
        gyro,
        accel,
        converted=frozenset({"gyro", "accel", "sign"}),
        attributes=_attributes(group),
        **{
            attribute: _part(path, group, layout)
            for attribute, layout in layouts.items()
            if layout.stem in group
        },
    )


def _part(path: Path, group: Any, layout: Layout) -> Any:
    """Return a part of a recording, its rows at times that increase."""
    optional = {n: a for n, a in layout.optional.items() if f"{layout.stem}/{n}" in group}
    rows: dict[str, Any] = {
        attribute: _numbers(group, f"{layout.stem}/{name}")
        for name, attribute in ({"t": "time"} | layout.needed | optional).items()
    }
    time = finite_times(f"{layout.stem}/t", rows["time"])
    if "attitude_WB" in rows:
        field = f"{layout.stem}/quat_xyzw"
        quat_xyzw = checked_array(field, rows["attitude_WB"], (len(time), 4), where=False)
        rows["attitude_WB"], known = captured_rotations(quat_xyzw)
        valid = checked_valid(f"{layout.stem}/valid", rows.get("valid", np.empty(0)), time)
        if (bad := valid & ~known).any():
            where = f"row {int(np.argmax(bad)) + 1}, {field}"
            raise InputError(where, "no unit quaternion", f"one, or False in {layout.stem}/valid")
    if not (keep := pose_mask(path, time)).all():
        rows = {attribute: values[keep] for attribute, values in rows.items()}
    return layout.kind(**rows)


def _numbers(group: Any, field: str) -> FloatArray:
    if not hasattr(dataset := group.get(field), "dtype"):
        raise InputError(field, "no such dataset", "an array of numbers")
    return as_float64(field, dataset[()])


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

    It says what was `expected`. MissingPackageError if h5py is not installed.
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
    """Write a recording; flags are left out if all are True, which readers take for granted."""
    track, layouts = sequence.positions, dict(PARTS)
    if track is not None and track.kind == "positions" and sequence.truth is not None:
        _log.warning("%s: positions alongside true poses are not written", sequence.name)
    elif track is not None:
        flat = track.kind == "waypoints" and track.position_W.shape[1] == 2
        layouts["positions"] = track_layout(track.kind, "xy" if flat else "p")
    columns = {"imu/t": sequence.time, "imu/gyro": sequence.gyro, "imu/accel": sequence.accel}
    for attribute, layout in layouts.items():
        part = getattr(sequence, attribute)
        for name, field in ({"t": "time"} | layout.needed | layout.optional).items():
            value = None if part is None else getattr(part, field)
            if value is not None and not (field == "valid" and value.all()):
                value = value.as_quat() if field == "attitude_WB" else value
                columns[f"{layout.stem}/{name}"] = value
    for name, values in columns.items():
        group.create_dataset(name, data=values, **(_COMPRESSION if len(values) else {}))
    for key, value in sequence.attributes.items():
        group.attrs[key] = value
