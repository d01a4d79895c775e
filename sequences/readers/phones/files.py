"""The sensor and the recording that each file of a folder belongs to, and the app that wrote them.

A file belongs to the one sensor that its name contains (`Gyroscope.csv`, `acce.txt`,
`Eight_gyr.csv`). The rest of the name identifies the recording, so files of two recordings in one
folder are read as two recordings, each named by its gyroscope file.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from stario.sequences.readers.phones.sensor_layout import SensorTable, sensor_table
from stario.sequences.readers.phones.sensor_words import (
    Sensor,
    axis_of,
    is_sensor_word,
    is_uncalibrated,
    sensor_of,
    words_of,
)
from stario.sequences.readers.text import head_lines

SUFFIXES = (".csv", ".txt", ".tsv", ".log", ".dat")
_MOTION = {"mot", "motion", "full"}
"""Words in names of Core Motion's files, `MotMagnFull.txt`, that identify no recording."""

_DEVICES = {
    *("phone", "watch", "wrist", "headphone", "headphones", "airpods", "glasses", "tag", "foot"),
    *("left", "right", "head", "chest", "hip", "waist", "thigh", "ankle", "leg", "arm", "hand"),
}
"""Words in names of files that tell devices apart, whose sensors must not be mixed."""

NO_SAMPLES = "no rows with a time that grows and three values"
"""What a file of `PhoneFiles.unread` has, if it may be read."""

_BY_HEADER = {
    "seconds_elapsed": "Sensor Logger",
    "Time since start in ms": "AndroSensor",
    '"Time (s)"': "phyphox",
    "loggingTime(txt)": "SensorLog",
    "gFx": "Physics Toolbox",
}
"""Text in the headers of an app's files."""

_BY_FILE = {
    "record.properties": "SensLogs on Android",
    "description.txt": "SensLogs on iOS",
    "arposes.txt": "iOS Logger",
    "motmagnfull.txt": "iOS Logger",
    "acce_uncalib.txt": "RoNIN-style logger",
    "game_rv.txt": "RoNIN-style logger",
}
"""Files that an app writes alongside its sensor files."""


@dataclass
class PhoneFiles:
    """A recording's files by sensor, the best variant first; their names share the words `key`.

    Unread are files of gyroscope or accelerometer that would be preferred, but hold no samples.
    """

    key: str
    tables: dict[Sensor, list[SensorTable]] = field(default_factory=dict)
    unread: list[Path] = field(default_factory=list)

    @property
    def gyro(self) -> Path:
        """Gyroscope file, which names the recording if a folder holds several."""
        return self.tables["gyro"][0].file

    @property
    def shown(self) -> Path:
        """The recording's path in messages: the only file, or else the folder."""
        return self.gyro if len(self.files) == 1 else self.gyro.parent

    @property
    def files(self) -> set[Path]:
        """The files of all sensors."""
        return {table.file for tables in self.tables.values() for table in tables}

    def first(self, sensor: Sensor) -> SensorTable | None:
        """Return the preferred file of a sensor, or None."""
        return next(iter(self.tables.get(sensor, [])), None)


def phone_recordings(folder: Path) -> list[PhoneFiles]:
    """Return the recordings whose gyroscope and accelerometer are in a folder; never raises."""
    groups = groups_of(folder)
    complete = [group for group in groups if is_complete(group.tables)]
    if complete:
        return complete
    merged = _merged_groups(groups)
    return [merged] if is_complete(merged.tables) else []


def groups_of(folder: Path) -> list[PhoneFiles]:
    """Return a folder's files of each recording, complete or not; never raises."""

    def preference(item: tuple[Path, list[str]]) -> tuple[bool, bool, bool]:
        """Return a sort key: uncalibrated files last, total force first, then calibrated files."""
        words = item[1]
        return is_uncalibrated(words), "total" not in words, not {"calibrated", "mot"} & {*words}

    groups: dict[str, PhoneFiles] = {}
    for file, words in sorted(text_files(folder), key=preference):
        # iOS Logger's `Motion.txt` is an attitude.
        sensor: Sensor | None = "attitude" if words == ["motion"] else sensor_of(words)
        table = sensor_table(file) if sensor else None
        # A file with both sensors is a recording by itself, such as the first walk, `walk_a.csv`.
        if sensor is None or (table is not None and is_complete(table.axes)):
            continue
        key = " ".join(word for word in words if not is_sensor_word(word) and word not in _MOTION)
        group = groups.setdefault(key, PhoneFiles(key))
        if table is not None:
            group.tables.setdefault(sensor, []).append(table)
        elif sensor in ("gyro", "accel") and sensor not in group.tables:
            group.unread.append(file)
    return list(groups.values())


def is_complete(sensors: Collection[str | None]) -> bool:
    """Return whether sensors include a gyroscope and an accelerometer of either kind."""
    return "gyro" in sensors and bool({"accel", "linear"} & set(sensors))


def names_both_sensors(path: Path) -> bool:
    """Return whether a line at the start of a file names axes of both sensors, clock or not."""
    for line in head_lines(path) if may_hold(path) else ():
        axes = (axis_of(cell.strip(" \"'")) for cell in re.split("[,;\t]", line))
        if is_complete({sensor_of(axis[1]) for axis in axes if axis is not None}):
            return True
    return False


def sensors_in(path: Path) -> list[Sensor]:
    """Return the sensors of a folder or of a wide file; never raises."""
    if not path.is_dir():
        table = sensor_table(path) if may_hold(path) else None
        order: tuple[Sensor, ...] = ("accel", "linear", "gyro", "mag")
        return [sensor for sensor in order if table is not None and sensor in table.axes]
    named = ((sensor_of(words), file) for file, words in text_files(path))
    return list(dict.fromkeys(s for s, file in named if s is not None and sensor_table(file)))


def may_hold(file: Path) -> bool:
    """Return whether a file may hold samples as text, by its name; never raises."""
    return file.suffix.lower() in SUFFIXES and file.is_file() and not file.name.startswith(".")


def text_files(folder: Path) -> list[tuple[Path, list[str]]]:
    """Return the files of a folder that may hold samples, each with the words of its name."""
    return [(file, words_of(file.stem)) for file in sorted(folder.iterdir()) if may_hold(file)]


def _merged_groups(groups: list[PhoneFiles]) -> PhoneFiles:
    """Merge groups into one recording; it is empty if they have a sensor twice or other devices."""
    merged = PhoneFiles("")
    if len({frozenset(_DEVICES.intersection(group.key.split())) for group in groups}) > 1:
        return merged
    for group in groups:
        for sensor, tables in group.tables.items():
            if sensor in merged.tables:
                return PhoneFiles("")
            merged.tables[sensor] = tables
    return merged


def app_of(files: PhoneFiles) -> str:
    """Return the name of the app that wrote the files, or else the kind of logger; for display."""
    header = "\n".join(head_lines(files.gyro)[:8])
    for words, app in _BY_HEADER.items():
        if words in header:
            return app
    names = {file.name.lower() for file in files.gyro.parent.iterdir()}
    for name, app in _BY_FILE.items():
        if name in names:
            return app
    accel = files.first("accel") or files.first("linear")
    one = accel is not None and accel.file == files.gyro
    return "logger with all sensors in one file" if one else "logger with one file per sensor"
