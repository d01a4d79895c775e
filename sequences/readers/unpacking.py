"""Recordings to be unpacked into a folder of files: zips, JSON exports, sensors row by row.

A zip holds a folder's files, or such zips. Sensor Logger's JSON export is an array with one object
per sample that names its sensor, and has the same data as the app's folder of CSV files:

    [{"sensor": "Gyroscope", "time": "1698501144401773000", "z": "0.1", "y": "0.2", "x": "0.3"}, ...

In a table of all sensors a column names the sensor of each row:

    time,sensor,x,y,z
    0.000,gyroscope,0.01,-0.02,0.03
    0.002,accelerometer,0.1,0.2,9.8
"""

from __future__ import annotations

import csv
import logging
import re
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import first_bytes, head_lines, is_row, read_json, read_lines
from stario.sequences.readers.phones.files import SUFFIXES
from stario.sequences.readers.phones.sensor_words import sensor_of, words_of
from stario.sequences.readers.table_head import first_row
from stario.sequences.readers.text import RowFormat

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
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as text:
            writer = csv.DictWriter(text, titles, extrasaction="ignore")
            writer.writeheader()
            writer.writerows(rows)


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
        kept = ([*row[:column], *row[column + 1 :]] for row in [*titles, *own])
        text = "".join((written.delimiter or " ").join(row) + "\n" for row in kept)
        (folder / f"{stem}.csv").write_text(text, encoding="utf-8")


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
