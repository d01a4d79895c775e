"""Phone loggers: a folder with a text file for each sensor, or one wide file with all of them.

Each app writes its own variant (Sensor Logger, phyphox, SensLogs, the Android and iOS loggers of
several data sets), so a file's name and content determine what it holds; see `sensor_words` and
`sensor_layout`. Time without a unit is in the unit that gives 10 to 1200 samples per second;
values without a unit are in rad/s, m/s^2 and uT. A wide file (AndroSensor, Physics Toolbox,
phyphox, `*_IMU.txt`) has a clock and columns for each sensor; cells of sensors that were not
sampled are empty.

The accelerometer is interpolated to the gyroscope's times in their common time span. If its file
lacks gravity and there is a file of gravity, that is added. Apple's accelerometers report the
opposite of specific force, in g, see `attitude`. A pose that an ARCore or ARKit logger wrote
alongside is the ground truth, see `poses`; pressure, satellite positions and reference points are
those of `alongside`.

ADVIO (Cortés et al., ECCV 2018) is `<name>/iphone/*.csv` with `ground-truth/pose.csv` alongside.
Rows without headers are time [s] and values; the gyroscope in rad/s, the magnetometer in uT, the
accelerometer in m/s^2 or, in some copies, in g with Apple's sign. Poses are time, position [m] and
quaternion, w first, in a world with y up; `iphone/arkit.csv` has ARKit's, used if there is no
ground truth.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import magnetometer
from stario.sequences.readers.clocks import Samples, resample_to_gyro
from stario.sequences.readers.columns import IMU, POSITION, QUAT, named_columns
from stario.sequences.readers.phones import alongside
from stario.sequences.readers.phones.attitude import (
    accel_sign,
    device_attitude,
    is_in_g,
    logged_attitude,
)
from stario.sequences.readers.phones.files import (
    NO_SAMPLES,
    SUFFIXES,
    PhoneFiles,
    app_of,
    is_complete,
    phone_recordings,
)
from stario.sequences.readers.phones.sensor_layout import read_samples, sensor_table
from stario.sequences.readers.phones.sensor_words import (
    Sensor,
    is_sensor_word,
    without_sensor,
    words_of,
)
from stario.sequences.readers.poses import pose_files, with_pose
from stario.sequences.readers.text import IntArray, head_lines, may_be_read, seconds
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence, Magnetometer

_log = logging.getLogger(__name__)

_ADVIO, _ADVIO_POSES = "iphone", ("ground-truth/pose.csv", "iphone/arkit.csv")

_GRAVITY_REMOVED = 5.0
"""Median force [m/s^2] below which gravity was removed."""


def read_phone(path: Path) -> ImuSequence:
    """Read a logger's folder, or the recording of one gyroscope file in a folder with several."""
    folder = path if path.is_dir() else path.parent
    files = _chosen(path)
    name = folder.resolve().name if path.is_dir() else without_sensor(path.stem) or path.stem
    return assemble_recording(name, files, pose_files(folder, files.key))


def read_wide(path: Path) -> ImuSequence:
    """Read one file that holds all sensors in separate columns."""
    files = _wide(path)
    if files is None:
        lines = head_lines(path)[:1]
        found = repr(lines[0].strip()[:60]) if lines else "no lines"
        expected = "a header that names a clock and the axes of gyroscope and accelerometer"
        raise ReadError(path, "header", found, expected)
    gyro = files.tables["gyro"][0]
    if gyro.unused:
        _log.warning(
            "%s: several IMUs: read the one with %s, not those with %s; to read another, remove "
            "the columns of this one", path, gyro.axes["gyro"][0].title, ", ".join(gyro.unused),
        )  # fmt: skip
    return assemble_recording(path.stem, files, _wide_poses(path, files))


def is_wide(path: Path) -> bool:
    """Return whether a file's header names a clock and the axes of both sensors.

    One with positions is a generic CSV, of which others count only if poses lie next to it or it
    has what that format lacks: two kinds of force (gFx and ax, or gravity apart) or an attitude.
    """
    if not path.is_file() or path.suffix.lower() not in SUFFIXES:
        return False
    files = _wide(path)
    if files is None:
        return False
    named = named_columns(path)
    if named & set(IMU) and named & set(POSITION):
        return False
    if not named >= {"t", *IMU} or _wide_poses(path, files):
        return True
    axes = files.tables["gyro"][0].axes
    in_two_parts = bool({"linear", "gravity"} & set(axes))
    in_two_parts |= "accel" in axes and axes["accel"][0].title.lower().startswith("g")
    return in_two_parts or named >= set(QUAT)


def _wide(path: Path) -> PhoneFiles | None:
    table = sensor_table(path)
    if table is None or not is_complete(table.axes):
        return None
    words = words_of(path.stem)
    key = " ".join(word for word in words if word != "imu" and not is_sensor_word(word))
    sensors: tuple[Sensor, ...] = ("accel", "gyro", "mag", "gravity", "linear")
    files = PhoneFiles(key, {sensor: [table] for sensor in sensors if sensor in table.axes})
    if table.quaternion:
        files.tables["attitude"] = [table]
    return files


def _wide_poses(path: Path, files: PhoneFiles) -> list[Path]:
    """Return the pose files with the same name as an `*_IMU.txt`."""
    return pose_files(path.parent, files.key) if "imu" in words_of(path.stem) else []


def is_phone(path: Path) -> bool:
    """Return whether a folder is one recording, or a file the gyroscope's of one; never raises."""
    if path.is_dir():
        return len(phone_recordings(path)) == 1
    if not path.is_file() or "gyr" not in path.name.lower():
        return False
    return any(files.gyro == path for files in phone_recordings(path.parent))


def read_advio(path: Path) -> ImuSequence:
    """Read a recording from its folder."""
    files = _advio_files(path)
    if files is None:
        raise ReadError(path, _ADVIO, "no gyro.csv and accelerometer.csv", "an ADVIO recording")
    poses = [path / name for name in _ADVIO_POSES if (path / name).is_file()][:1]
    name = path.resolve().name
    return assemble_recording(name, files, poses, orders=("wxyz",), core_motion=True)


def is_advio(path: Path) -> bool:
    """Return whether a folder holds a phone's files in `iphone` and one of the pose files."""
    return any((path / name).is_file() for name in _ADVIO_POSES) and _advio_files(path) is not None


def _advio_files(path: Path) -> PhoneFiles | None:
    folder = path / _ADVIO
    found = phone_recordings(folder) if folder.is_dir() else []
    return next((files for files in found if not files.key), None)


def _chosen(path: Path) -> PhoneFiles:
    folder = path if path.is_dir() else path.parent
    found = phone_recordings(folder)
    if path.is_dir() and len(found) > 1:
        names = ", ".join(files.gyro.name for files in found)
        fix = f"name one by its gyroscope file: {found[0].gyro}"
        raise ReadError(folder, "files", f"{len(found)} recordings ({names})", "one", fix)
    chosen = [files for files in found if path.is_dir() or files.gyro == path]
    if not chosen:
        names = ", ".join(sorted(p.name for p in folder.glob("*"))[:6]) or "nothing"
        expected = "a gyroscope file and an accelerometer file of one recording"
        fix = "put each recording into a separate folder"
        raise ReadError(folder, "files", names, expected, fix)
    return chosen[0]


def assemble_recording(
    name: str,
    files: PhoneFiles,
    poses: list[Path],
    orders: Collection[str] = ("xyzw", "wxyz", "matrix"),
    core_motion: bool = False,
) -> ImuSequence:
    """Assemble a recording of files and of poses alongside them, in one of some `orders`.

    `core_motion` says that an iPhone wrote the files: values in g have Apple's sign.
    """
    folder = files.gyro.parent
    for file in files.unread:
        why = f"it has {NO_SAMPLES}" if may_be_read(file) else "no permission"
        _log.warning("%s: not read: %s", file, why)
    gyro = read_samples(files.tables["gyro"][0], "gyro")
    attitude = logged_attitude(files, gyro)
    accel, converted, maybe_apple = _force(files, attitude, core_motion)
    stamps, rate, force, alone = resample_to_gyro(folder, gyro, accel)
    converted["gyro"] = gyro.unit not in ("", "rad/s")
    recording = alongside.Recording(files.gyro, files.key, stamps[0], stamps[-1])
    reported = alongside.reported_positions(recording)
    first = next(reported, None)
    sequence = ImuSequence(
        name=name,
        time=seconds(stamps, stamps[0]),
        gyro=rate,
        accel=force,
        converted=frozenset(sensor for sensor, done in converted.items() if done),
        magnetometer=_magnetometer(files, stamps[0], stamps[-1]),
        device_attitude=device_attitude(attitude, stamps[0]),
        barometer=alongside.recorded_pressure(recording),
        satellites=first,
        source="" if core_motion else app_of(files) + gyro.assumed,
        maybe_apple=maybe_apple,
        alone_s=alone,
    )
    sequence = with_pose(sequence, stamps[0], poses, orders)
    if sequence.truth is not None:
        return sequence
    positions = alongside.reference_points(recording)
    if positions is None and first is not None:
        tracks = map(alongside.as_known_positions, chain([first], reported))
        positions = next((track for track in tracks if track is not None), None)
    return replace(sequence, positions=positions)


def _force(
    files: PhoneFiles, attitude: tuple[IntArray, Rotation] | None, core_motion: bool
) -> tuple[Samples, dict[str, bool], bool]:
    """Return the specific force, with gravity added if that was logged apart.

    Which of unit and sign were converted follows, and whether it may have Apple's sign.
    """
    candidates = [read_samples(table, "accel") for table in files.tables.get("accel", [])]
    gravity_table = files.first("gravity")
    gravity = None if gravity_table is None else read_samples(gravity_table, "gravity")
    total = _with_gravity(candidates, or_g=gravity is None)
    first = total or next(iter(candidates), None)
    accel = first or read_samples(files.tables["linear"][0], "linear")
    in_two_parts = total is None and gravity is not None
    if total is None and gravity is not None:
        stamps, force, gravity_B, _ = resample_to_gyro(
            files.gyro.parent, accel, gravity, ("linear acceleration", "gravity")
        )
        accel = replace(accel, stamps_ns=stamps, values=force + gravity_B)
        _log.info("%s: added gravity from its own columns or file", files.shown)
    in_g = not accel.unit and is_in_g(accel.values)
    sign = -1.0 if in_g and core_motion else accel_sign(files, accel, attitude)
    inverted = sign == -1.0
    factor = -1.0 if inverted else 1.0
    # In g without a sign, `check_units` asks for both unless the caller has given them.
    factor *= STANDARD_GRAVITY if in_g and inverted else 1.0
    converted = {
        "accel": inverted or accel.unit.removeprefix("-") not in ("", "m/s^2"),
        "sign": inverted or accel.unit.startswith("-"),
    }
    maybe_apple = sign is None and in_two_parts and not in_g
    return replace(accel, values=factor * accel.values), converted, maybe_apple


def _with_gravity(candidates: list[Samples], or_g: bool) -> Samples | None:
    """Return the first candidate with gravity in m/s^2, else the steadiest that may be in g."""
    sizes = [np.linalg.norm(candidate.values, axis=1) for candidate in candidates]
    for candidate, size in zip(candidates, sizes, strict=True):
        if float(np.median(size)) >= _GRAVITY_REMOVED:
            return candidate
    shares = [float(np.percentile(size, 10) / max(np.median(size), 1e-9)) for size in sizes]
    maybe = [k for k, candidate in enumerate(candidates) if or_g and is_in_g(candidate.values)]
    return candidates[max(maybe, key=shares.__getitem__)] if maybe else None


def _magnetometer(files: PhoneFiles, start_ns: np.int64, stop_ns: np.int64) -> Magnetometer | None:
    table = files.first("mag")
    if table is None:
        return None
    try:
        samples = read_samples(table, "mag")
    except ReadError as error:  # the magnetometer is optional
        _log.warning("magnetometer skipped: %s", error)
        return None
    inside = (samples.stamps_ns >= start_ns) & (samples.stamps_ns <= stop_ns)
    if not inside.any():
        _log.warning("magnetometer skipped: none of its samples is within the recording")
        return None
    return magnetometer(samples.seconds(start_ns), samples.values)
