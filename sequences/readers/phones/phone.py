"""Phone loggers: a folder with a text file for each sensor, or one wide file with all of them.

Each app writes its own variant (Sensor Logger, phyphox, SensLogs, the Android and iOS loggers of
several data sets), so a file's name and content determine what it holds; see `sensor_words` and
`sensor_table`. Time without a unit is in the unit that gives 10 to 1200 samples per second;
values without a unit are in rad/s, m/s^2 and uT.

A wide file (AndroSensor, Physics Toolbox, phyphox, `*_IMU.txt`) has a clock and columns for each
sensor; cells of sensors that were not sampled are empty.

`assembly` joins the sensors to a recording. A pose that an ARCore or ARKit logger wrote alongside
is the ground truth, see `poses`; reference points (`*_ref.csv`: time, x, y [m]) are waypoints.
"""

from __future__ import annotations

import logging
from pathlib import Path

from stario.sequences.errors import ReadError
from stario.sequences.readers.columns import IMU, POSITION
from stario.sequences.readers.generic_csv import named_columns
from stario.sequences.readers.lines import head_lines
from stario.sequences.readers.phones.assembly import assemble_recording
from stario.sequences.readers.phones.files import (
    SUFFIXES,
    PhoneFiles,
    is_complete,
    phone_recordings,
)
from stario.sequences.readers.phones.sensor_table import sensor_table
from stario.sequences.readers.phones.sensor_words import (
    Sensor,
    is_sensor_word,
    without_sensor,
    words_of,
)
from stario.sequences.readers.poses import pose_files
from stario.sequences.sequence import ImuSequence

_log = logging.getLogger(__name__)


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

    A generic CSV counts only if poses lie next to it, or if it has two kinds of force (gFx and ax,
    or gravity apart) and no ground truth.
    """
    if not path.is_file() or path.suffix.lower() not in SUFFIXES:
        return False
    files = _wide(path)
    if files is None:
        return False
    named = named_columns(path)
    if not named >= {"t", *IMU} or _wide_poses(path, files):
        return True
    axes = files.tables["gyro"][0].axes
    in_two_parts = bool({"linear", "gravity"} & set(axes))
    in_two_parts |= "accel" in axes and axes["accel"][0].title.lower().startswith("g")
    return in_two_parts and not named & set(POSITION)


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
    """Return whether a folder holds one recording, or a file is the gyroscope file of one of many.

    Never raises.
    """
    if path.is_dir():
        return len(phone_recordings(path)) == 1
    if not path.is_file() or "gyr" not in path.name.lower():
        return False
    return any(files.gyro == path for files in phone_recordings(path.parent))


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
