"""Recordings that are first written anew, as files in a folder that other readers know.

A zip holds a folder's files, or such zips. Sensor Logger's JSON export is an array with one object
per sample that names its sensor, and has the same data as the app's folder of CSV files:

    [{"sensor": "Gyroscope", "time": "1698501144401773000", "z": "0.1", "y": "0.2", "x": "0.3"}, ...

In a table of all sensors a column names the sensor of each row:

    time,sensor,x,y,z
    0.000,gyroscope,0.01,-0.02,0.03
    0.002,accelerometer,0.1,0.2,9.8

A table without a column of times gets one. The times are in two or more columns (`UTC_Second` and
`UTC_Nano` of Xsens, `sec` and `nanosec` of ROS), in a file of their own (`time.csv` next to
`gyro-0.csv` and `accel-0.csv`, joined by row), or nowhere: then the user gives the rate.
`ros2 topic echo --csv` has no titles, but always the same columns.
"""

from __future__ import annotations

import csv
import logging
import math
import re
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from stario.sequences.arrays import number_in
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers.checked import finite_rows
from stario.sequences.readers.phones.files import (
    SUFFIXES,
    is_complete,
    may_hold,
    names_both_sensors,
    text_files,
)
from stario.sequences.readers.phones.sensor_layout import clock_of
from stario.sequences.readers.phones.sensor_words import sensor_of, words_of
from stario.sequences.readers.table_head import TableHead, first_row, table_heads
from stario.sequences.readers.text import (
    Column,
    IntArray,
    RowFormat,
    first_bytes,
    head_lines,
    is_row,
    read_json,
    read_lines,
)

_log = logging.getLogger(__name__)

_PACKAGE = "stario.sequences"
_SUFFIXES = (".csv", ".txt", ".tsv", ".log", ".json", ".properties", ".zip")
_MAX_BYTES = 4 * 2**30
"""Maximum unpacked text [bytes], more than any recording has; guards against zip bombs."""

_MAX_FILES = 5000
"""Maximum number of text files, far more than any export has; unpacking 70,000 takes long."""

_DAMAGED = (OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError, NotImplementedError)
"""Exceptions raised for a zip that is damaged, encrypted or compressed in a rare way."""

_FIRST = re.compile(r"\ufeff?\s*\[\s*\{[^{}]*\"sensor\"\s*:")
_NAME = re.compile(r"\w+")
_HEAD_ROWS = 50
_MIN_SHARE = 0.5
"""Share of the first rows that must name a known sensor; others are of other sensors."""


def is_zip(path: Path) -> bool:
    """Return whether a file is a zip with text files in it; never raises."""
    if first_bytes(path, 4) != b"PK\x03\x04":
        return False
    try:
        with zipfile.ZipFile(path) as file:
            return any(_is_wanted(info) for info in file.infolist())
    except (OSError, zipfile.BadZipFile):
        return False


def unpack_zip(path: Path, folder: Path) -> None:
    """Unpack a zip's text files, and those of the zips in it, into a folder."""
    try:
        left = _extract(path, path, folder, _MAX_BYTES)
        for inner in sorted(folder.rglob("*.zip")):
            left = _extract(path, inner, inner.with_suffix(""), left)
            inner.unlink()
    except _DAMAGED as error:
        found = " ".join(str(error).split())
        raise ReadError(path, "zip", found, "an intact zip", "is the zip complete?") from None


def _extract(path: Path, inner: Path, folder: Path, max_bytes: int) -> int:
    """Unpack the wanted files of a zip in `path`; return how many more bytes are allowed."""
    with zipfile.ZipFile(inner) as file:
        wanted = [info for info in file.infolist() if _is_wanted(info)]
        if len(wanted) > _MAX_FILES:
            raise ReadError(path, "zip", f"{len(wanted)} files", "those of one recording")
        left = max_bytes - sum(info.file_size for info in wanted)
        if left < 0:
            found = f"more than {_MAX_BYTES / 2**30:.0f} GiB of text"
            raise ReadError(path, "zip", found, "a recording")
        file.extractall(folder, wanted)
    return left


def _is_wanted(info: zipfile.ZipInfo) -> bool:
    parts = PurePosixPath(info.filename).parts
    hidden = any(part.startswith((".", "__MACOSX")) for part in parts)
    return not info.is_dir() and not hidden and info.filename.lower().endswith(_SUFFIXES)


@contextmanager
def named_after(path: Path, folder: Path) -> Iterator[None]:
    """Let errors and log records of the block name `path` instead of where it is unpacked to.

    `walk.zip/Gyroscope.csv` is the file of that name in the zip.
    """

    def shown(text: str) -> str:
        for inside in (folder / f"{path.stem}.csv", folder):  # the only file is `path` itself
            text = text.replace(str(inside), str(path))
        return text.replace(folder.name, path.stem)

    def rename(record: logging.LogRecord) -> bool:
        record.msg, record.args = shown(record.getMessage()), ()
        return True

    known = logging.root.manager.loggerDict
    # A filter sees only its own logger's records, not those of the loggers below it.
    loggers = [logging.getLogger(name) for name in known if name.startswith(_PACKAGE)]
    for logger in loggers:
        logger.addFilter(rename)
    try:
        yield
    except ReadError as error:
        field = error.field.removeprefix(f"{error.path}: ")
        found, fix = (text.replace(f"{folder}/", "") for text in (error.found, error.fix))
        raise ReadError(shown(str(error.path)), field, found, error.expected, fix) from None
    finally:
        for logger in loggers:
            logger.removeFilter(rename)


def is_json_export(path: Path) -> bool:
    """Return whether a file begins with such an array; never raises."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    return _FIRST.match("\n".join(head_lines(path))) is not None


def unpack_json(path: Path, folder: Path) -> None:
    """Write a file for each sensor into a folder."""
    objects = read_json(path)
    if not isinstance(objects, list) or not all(isinstance(row, dict) for row in objects):
        raise ReadError(path, "file", "other JSON", "an array of objects, one for each sample")
    sensors: dict[str, list[dict[str, Any]]] = {}
    for row in objects:
        name = row.get("sensor")
        if isinstance(name, str) and _NAME.fullmatch(name):  # skips notes and the like
            sensors.setdefault(name, []).append(row)
    if not sensors:
        raise ReadError(path, "sensor", "no name", "a sensor name in each object")
    for name, rows in sensors.items():
        titles = [title for title in rows[0] if title != "sensor"]
        _write(folder / name, [titles, *([row.get(title) for title in titles] for row in rows)])


def _write(file: Path, rows: Iterable[Sequence[Any]]) -> None:
    """Write rows of cells into a CSV of that name."""
    with file.with_name(f"{file.name}.csv").open("w", newline="", encoding="utf-8") as text:
        csv.writer(text, lineterminator="\n").writerows(rows)


def is_long_form(path: Path) -> bool:
    """Return whether a file's rows name their sensors; never raises."""
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    lines = [line for line in head_lines(path)[:-1] if is_row(line)]
    return not is_echo(lines) and _column_of_sensors(lines) is not None


def is_echo(lines: list[str]) -> bool:
    """Return whether lines are the text of `rostopic echo`, which names sensors as well."""
    return lines[:1] != [] and lines[0].rstrip() == "header:"


def unpack_long_form(path: Path, folder: Path) -> None:
    """Write a file for each sensor into a folder."""
    lines = [line for line in read_lines(path) if is_row(line)]
    found = _column_of_sensors(lines)
    if found is None:
        raise ReadError(path, "rows", "none that name a sensor", "a column of sensors' names")
    written, column = found
    rows = [[cell.strip() for cell in written.cells(line)] for line in lines]
    titles, below = rows[max(written.skip - 1, 0) : written.skip], rows[written.skip :]
    sensors: dict[str, list[list[str]]] = {}
    for row in below:
        stem = re.sub(r"\W+", "_", "".join(row[column : column + 1])) or "unnamed"
        sensors.setdefault(stem, []).append(row)
    for stem, own in sensors.items():
        _write(folder / stem, ([*row[:column], *row[column + 1 :]] for row in [*titles, *own]))


def _column_of_sensors(lines: list[str]) -> tuple[RowFormat, int] | None:
    """Return how rows among non-blank lines are written, and the column that names sensors."""
    written = first_row(lines[:_HEAD_ROWS], least=3)  # the time may be a date
    if written is None:
        return None
    rows = [written.cells(line) for line in lines[written.skip : written.skip + _HEAD_ROWS]]
    rows = [row for row in rows if len(row) == len(rows[0])]
    for column, cells in enumerate(zip(*rows, strict=True)):
        # By more than a letter or two: not `n/a`.
        words = ([word for word in words_of(cell) if len(word) > 2] for cell in cells)
        named = sum(sensor_of(some) is not None for some in words)
        if len(rows) > 1 and named >= _MIN_SHARE * len(cells):
            return written, column
    return None


# --- tables without a column of times ----------------------------------------------------------

_FIELDS = {
    "nano": {"nano", "nanos", "nanosec", "nanosecs", "nanosecond", "nanoseconds", "nsec", "nsecs"},
    "second": {"sec", "secs", "second", "seconds"},
    "minute": {"min", "minute", "minutes"},
    "hour": {"hour", "hours"},
    "day": {"day"},
    "month": {"month"},
    "year": {"year"},
}
"""Words of titles that name a part of the time; those of the first two are needed."""

_TIMES = {"time", "times", "timestamp", "timestamps"}
"""Names of a file of times."""

_COVARIANCE = [f"covariance{k}" for k in range(9)]
_ECHO_TITLES = [
    *("sec", "nanosec", "frame"),
    *(f"attitude_{axis}" for axis in "xyzw"),
    *_COVARIANCE,
    *(f"angular_velocity_{axis}" for axis in "xyz"),
    *_COVARIANCE,
    *(f"accel_{axis}" for axis in "xyz"),
    *_COVARIANCE,
]
"""Columns of sensor_msgs/Imu as `ros2 topic echo --csv` writes them."""

_LEAST_ROWS = 20
"""Number of rows that tell a recording without times from another table of both sensors."""

_UNEQUAL = 0.01
"""Share by which the numbers of rows of files joined by row may differ."""


def is_joined(path: Path) -> bool:
    """Return whether a file or folder has times in several columns or a file of their own."""
    if path.is_dir():
        return bool(_time_files(path)) and is_complete(_sensor_files(path))
    head = _head(path) if may_hold(path) else None
    return head is not None and bool(_clock_columns(head))


def is_untimed(path: Path) -> bool:
    """Return whether a file holds samples of both sensors, but no times; never raises."""
    head = _head(path) if may_hold(path) else None
    return head is not None and len(head.rows) >= _LEAST_ROWS and names_both_sensors(path)


def unpack_joined(path: Path, folder: Path, rate: str = "") -> None:
    """Write the table with its times, or those of a rate [samples/s], into a folder.

    InputError: the rate is not a number above zero.
    """
    if path.is_dir():
        rows = _joined_files(path, rate)
    elif head := _head(path):
        rows = _with_rate(head, rate) if rate or not _clock_columns(head) else _with_clock(head)
    else:
        raise ReadError(path, "rows", "none of numbers", "samples of both sensors")
    _write(folder / path.stem, rows)


def _head(path: Path, least: int = 4) -> TableHead | None:
    return next(table_heads(path, least), None)


def _titles(head: TableHead) -> list[str]:
    """Return the titles of a table; those of ROS if it has none but the same columns."""
    echoed = not head.titles and head.rows.shape[1] == len(_ECHO_TITLES)
    return _ECHO_TITLES if echoed else head.titles


def _clock_columns(head: TableHead) -> dict[str, int]:
    """Return the columns of the parts of the time; none if there is a whole clock as well."""
    titles, found = _titles(head), dict[str, int]()
    for k, title in enumerate(titles):
        for field, names in _FIELDS.items():
            if names & set(words_of(title)):
                found.setdefault(field, k)
    if not {"nano", "second"} <= set(found):
        return {}
    parts = head.rows[:, list(found.values())]
    nano = head.rows[:, found["nano"]]
    whole = bool((parts == np.floor(parts)).all() and (nano >= 0).all() and (nano < 1e9).all())
    others = ["" if k in found.values() else title for k, title in enumerate(titles)]
    return found if whole and clock_of(others, head.rows) is None else {}


def _with_clock(head: TableHead) -> list[list[str]]:
    """Return the rows of a table with one column of times in place of several."""
    columns = _clock_columns(head)
    used, titles = list(columns.values()), _titles(head)
    values = head.read([Column(k) for k in used]).values
    finite_rows(head.file, ", ".join(titles[k] for k in used), values, all_of_them=True)
    stamps = _stamps_ns(dict(zip(columns, values.T.astype(np.int64), strict=True)))
    return _rewritten(head, "time [ns]", map(str, stamps.tolist()), used)


def _stamps_ns(parts: dict[str, IntArray]) -> IntArray:
    """Return times (N,) [ns] from their parts (N,), unwrapped where the larger parts are absent."""
    seconds = parts["second"].copy()
    period = 60
    for field, size in (("minute", 60), ("hour", 3600)):
        if field in parts:
            seconds += size * parts[field]
            period = size * (24 if field == "hour" else 60)
    if {"year", "month", "day"} <= set(parts):
        month = (12 * (parts["year"] - 1970) + parts["month"] - 1).astype("M8[M]")
        day = month.astype("M8[D]").astype(np.int64) + parts["day"] - 1
        seconds += 86400 * day
    elif seconds.max() < period:
        seconds = np.asarray(np.unwrap(seconds, period=period), dtype=np.int64)
    return np.asarray(seconds * 10**9 + parts["nano"], dtype=np.int64)


def _with_rate(head: TableHead, rate: str) -> list[list[str]]:
    """Return the rows of a table whose rows are evenly spaced in time."""
    clock = clock_of(head.titles, head.rows)
    if not rate:
        found, expected = "no column of times that grow", "one next to the sensors'"
        fix = "name one `t [s]`, or pass the samples per second: `--rate 100`; a count is no time"
        raise ReadError(head.file, "time", found, expected, fix)
    if clock is not None:
        fix = "omit the rate"
        raise ReadError(head.file, "time", f"the column {clock.title}", "none next to a rate", fix)
    return _rewritten(head, "t [s]", _even_times(rate))


def _even_times(rate: str) -> Iterator[str]:
    hertz = number_in(rate)
    if not 0.0 < hertz < math.inf:
        raise InputError("rate", repr(rate), "the samples per second")
    return (f"{k / hertz:.9f}" for k in range(2**31))


def _rewritten(
    head: TableHead, title: str, times: Iterator[str], dropped: Collection[int] = ()
) -> list[list[str]]:
    """Return a table's rows with times in front, without some columns; line numbers are kept."""

    def row(time: str, cells: list[str]) -> list[str]:
        return [time, *(cell for k, cell in enumerate(cells) if k not in dropped)]

    above, below = [["#"]] * (head.row_format.skip - 1), read_lines(head.file)
    rows = [
        row(next(times, ""), head.row_format.cells(line)) if is_row(line) else ["#"]
        for line in below[head.row_format.skip :]
    ]
    return [*above, row(title, _titles(head)), *rows]


def _joined_files(folder: Path, rate: str) -> list[list[str]]:
    """Return the rows of a folder's files side by side, their titles after the files' names."""
    tables = [_texts(file) for file in chain(*_sensor_files(folder).values())]
    if not tables or not (rate or _time_files(folder)):
        expected = "files of a gyroscope, an accelerometer and their times"
        raise ReadError(folder, "files", "not all of them", expected, "or pass `--rate`")
    if rate:
        times = islice(_even_times(rate), len(tables[0]) - 1)
        tables.insert(0, [["t [s]"], *([time] for time in times)])
    else:
        tables.insert(0, _texts(_time_files(folder)[0], least=1))
    lengths = [len(table) - 1 for table in tables]
    if max(lengths) - min(lengths) > _UNEQUAL * max(lengths):
        found = f"{' and '.join(map(str, dict.fromkeys(lengths)))} rows"
        raise ReadError(folder, "files", found, "as many in the times as in each sensor's file")
    if len(set(lengths)) > 1:
        _log.warning("%s: its files have %d to %d rows", folder, min(lengths), max(lengths))
    return [list(chain(*row)) for row in zip(*tables, strict=False)]


def _texts(file: Path, least: int = 3) -> list[list[str]]:
    """Return the titles and the rows of a file as text."""
    head = _head(file, least)
    if head is None:
        raise ReadError(file, "rows", "none of numbers", f"rows of {least}")
    width = head.rows.shape[1]
    titles = head.titles or (["time"] if least == 1 else list("xyz")[:width])
    name = "" if least == 1 else f"{file.stem} "
    rows = (row for row in read_lines(file)[head.row_format.skip :] if is_row(row))
    texts = [head.row_format.cells(row) for row in rows]
    return [[name + title for title in titles], *(cells for cells in texts if len(cells) == width)]


def _time_files(folder: Path) -> list[Path]:
    return [file for file, words in text_files(folder) if set(words) <= _TIMES]


def _sensor_files(folder: Path) -> dict[str, list[Path]]:
    """Return a folder's files of gyroscopes, accelerometers and magnetometers."""
    files: dict[str, list[Path]] = {}
    for file, words in text_files(folder):
        if (sensor := sensor_of(words)) in ("gyro", "accel", "mag"):
            files.setdefault(sensor, []).append(file)
    return files
