"""Text files: decoding, a look at the first lines, dates as seconds, and rows of numbers.

Numbers are read exactly; errors name file, line and column.
"""

from __future__ import annotations

import csv
import json
import logging
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from decimal import Decimal, InvalidOperation
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stario.sequences.errors import ReadError
from stario.sequences.files import opened, opened_text
from stario.sequences.sequence import FloatArray
from stario.sequences.units import FILETIME_1970, FILETIME_NS

_log = logging.getLogger(__name__)

_HEAD_BYTES = 32768
_TAIL_BYTES = 16384
_MARK = re.compile(r'(?:^|[;\t"])\s*[-+]?\d*([.,])\d+(?:[eE][-+]?\d+)?\s*(?=[;\t"]|$)')
_BLANKS_MARK = re.compile(_MARK.pattern.replace(r"\t", r"\s"))
_QUOTED_MARK = re.compile(
    r'(?:^|[,"])\s*[-+]?\d*(\.|,(?=\d+(?:[eE][-+]?\d+)?\s*"))\d'  # a comma only within quotes
)
_UTF_16 = (b"\xff\xfe", b"\xfe\xff")
"""Byte order marks, with which spreadsheets begin a file of Unicode text."""

_DAY_S = 86400
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_TIME = re.compile(
    r"(?<![\w:.])"
    r"(?:(?:(?P<date>\d{4}[-/]\d\d[-/]\d\d|\d\d-[a-z]{3}-\d{4})"
    r"|\d\d?[./]\d\d?[./]\d\d(?:\d\d)?)[t _])?"
    r"(?P<clock>\d?\d:\d\d:\d\d)"
    r"(?:(?::(?P<count>\d+))|(?:\.|,(?=\d+[;\t]))(?P<fraction>\d+))?"
    r"(?: ?(?P<half>am|pm)\b)?"
    r"(?P<zone> ?(?:z|(?:utc|gmt)?[+-]\d\d:?\d\d|utc|gmt)|[+-]\d\d)?"
    r"(?![\w:])",
    flags=re.IGNORECASE,
)
"""A time of day, with a date before it or a zone after it if there is one."""

_COUNT = re.compile(r"\d:\d\d:\d\d:(\d+)")


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file; ReadError if it is missing, empty or not text."""
    try:
        with opened(path) as file:
            content = file.read()
    except FileNotFoundError:
        raise ReadError(path, "file", "no such file", "a readable file") from None
    except OSError as error:
        found = (error.strerror or "an error").lower()
        raise ReadError(path, "file", found, "a readable file") from None
    if not content.startswith(_UTF_16):
        size, content = len(content), content.rstrip(b"\0")
        if b"\0" in content:
            raise ReadError(path, "file", "binary data", "UTF-8 text")
        if count := size - len(content):
            words = "%s: skipped %d zero bytes at the end: did the recorder lose power?"
            _log.warning(words, path, count)
    lines = _decoded(content).splitlines()
    if not any(line.strip() for line in lines):
        raise ReadError(path, "file", "no lines", "rows of numbers", "is the download complete?")
    return lines


def read_json(path: Path) -> Any:
    """Return the content of a JSON file; ReadError if it is missing or not JSON."""
    try:
        return json.loads(opened_text(path))
    except FileNotFoundError:
        raise ReadError(path, "file", "no such file", "a JSON file") from None
    except (OSError, ValueError, RecursionError) as error:
        found = " ".join(str(error).split())
        raise ReadError(path, "file", found, "JSON", "is the download complete?") from None


def may_be_read(path: Path) -> bool:
    """Return whether permissions allow to read a file, or to list a folder."""
    return os.access(path, os.R_OK | (os.X_OK if path.is_dir() else 0))


def first_line(path: Path, comments: bool = False) -> str:
    """Return the first line as in `first_lines`, empty if there is none."""
    return next(iter(first_lines(path, 1, comments)), "")


def first_lines(path: Path, count: int, comments: bool = False) -> list[str]:
    """Return up to `count` lines of a text file that are neither blank nor (by default) comments.

    Reads little of the file, and never raises: used to recognise formats.
    """
    return [x for x in head_lines(path) if is_row(x) or (comments and x.strip())][:count]


def head_lines(path: Path) -> list[str]:
    """Return the lines at the start of a text file, the last possibly cut; never raises."""
    try:
        with opened(path) as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return []
    if head.startswith(_UTF_16):
        return _decoded(head).splitlines()
    head = head.rstrip(b"\0")
    if b"\0" in head:
        return []
    # The head may end within a character: decode its last line, cut anyway, separately.
    end = max(head.rfind(b"\n"), 0)
    return _decoded(head[:end]).splitlines() + _decoded(head[end:].lstrip(b"\r\n")).splitlines()


def first_bytes(path: Path, count: int = 16) -> bytes:
    """Return the first bytes of a file, empty if it does not exist; never raises."""
    try:
        with opened(path) as file:
            return file.read(count)
    except OSError:
        return b""


def numbers_in(line: str, delimiter: str | None = ",") -> list[float]:
    """Return the numbers of a line, or an empty list if it holds anything else."""
    try:
        return [float(cell) for cell in line.split(delimiter)]
    except ValueError:
        return []


def is_row(line: str) -> bool:
    """Return whether a line is neither blank nor a comment."""
    text = line.strip()
    return bool(text) and text[0] != "#"


def _decoded(content: bytes) -> str:
    """Decode UTF-8, UTF-16 with its mark, or else Latin-1, in which old apps write units."""
    if content.startswith(_UTF_16):
        return content.decode("utf-16", errors="replace")  # the head may end within a character
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def decimal_mark(lines: Iterable[str], delimiter: str | None) -> str:
    """Return the decimal mark of a file's numbers, that of the first one with a fraction.

    A comma that separates cells is one only within quotes.
    """
    mark = {",": _QUOTED_MARK, None: _BLANKS_MARK}.get(delimiter, _MARK)
    return next((match[1] for line in lines if (match := mark.search(line))), ".")


def unquoted(line: str, delimiter: str | None, decimal: str = ".") -> str:
    """Write a line's cells without quotes and with decimal points.

    A delimiter within a cell becomes a point if it is the decimal mark, otherwise a blank.
    """
    if '"' in line and delimiter is None:
        line = line.replace('"', " ")
    elif '"' in line and delimiter:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
        inner = "." if delimiter == decimal else " "
        line = delimiter.join(cell.replace(delimiter, inner) for cell in cells)
    return line if decimal in (".", delimiter) else line.replace(decimal, ".")


def ends_within_a_row(path: Path, delimiter: str | None) -> bool:
    """Return whether a killed recorder left a last row without its end; never raises.

    Such a row has no line end, and fewer cells than the one before it or a last cell that is
    shorter than that of every other row near the end.
    """
    try:
        with opened(path) as file:
            text = file.read().replace(b"\0", b"")  # of UTF-16, or left by a loss of power
    except OSError:
        return False
    if text.endswith((b"\n", b"\r")):
        return False
    tail = text[-_TAIL_BYTES:].decode("latin-1")
    rows = [row.split(delimiter) for row in tail.splitlines() if is_row(row)]
    *earlier, last = rows[1:] if len(text) > _TAIL_BYTES else rows or [[]]
    if len(earlier) < 2:
        return False
    ends = [cells[-1].strip(' "') for cells in earlier]
    shortest = min((len(end) for end in ends if not end[:1].isalpha()), default=0)  # no titles
    return len(last) < len(earlier[-1]) or len(last[-1].strip(' "')) < shortest


def with_seconds(lines: Iterable[str]) -> list[str]:
    """Replace the dates and times of day in a file's lines by seconds.

    Dates become seconds since 1970, without a zone as if it were UTC. Times of day, and those with
    a date whose day and month may be either (`01/05/2024`), become seconds since a midnight; a step
    of more than half a day from the line before is taken for one across midnight. After a colon,
    milliseconds may lack zeros at the left: `12:00:00:5`, if others have more digits.
    """
    lines = list(lines)
    digits = max((len(count) for line in lines for count in _COUNT.findall(line)), default=0)
    last: dict[int, int] = {}  # the time of day that comes first in a line, second, ...

    def replaced(line: str) -> str:
        place = 0

        def seconds(match: re.Match[str]) -> str:
            nonlocal place
            try:
                whole = _whole_seconds(*match.group("date", "clock", "half", "zone"))
            except ValueError:  # such as 24:60:00
                return match[0]
            if not match["date"]:
                whole += _DAY_S * round((last.get(place, whole) - whole) / _DAY_S)
                last[place] = whole
            place += 1
            fraction = match["fraction"] or (match["count"] or "").rjust(digits, "0")
            return f"{whole}.{fraction}" if fraction else f"{whole}"  # its digits stay exact

        return _TIME.sub(seconds, line)

    return [replaced(line) if ":" in line else line for line in lines]


@lru_cache(maxsize=4096)  # the samples within a second share it
def _whole_seconds(date: str | None, clock: str, half: str | None, zone: str | None) -> int:
    """Return the seconds since 1970, or without a date since a midnight; ValueError for no time."""
    hour, minute, second = map(int, clock.split(":"))
    if half:
        hour = hour % 12 + 12 * (half.lower() == "pm")
    if not date:
        datetime(2000, 1, 1, hour, minute, second)  # refuses what is no time
        # Counted from the midnight before, so that a step back across one stays positive.
        return _DAY_S + (60 * hour + minute) * 60 + second
    first, middle, last = re.split("[-/]", date)
    month = int(middle) if middle.isdecimal() else _MONTHS.index(middle.lower()) + 1
    year, day = (first, last) if len(first) == 4 else (last, first)
    time = datetime(int(year), month, int(day), hour, minute, second, tzinfo=UTC)
    digits = re.sub(r"\D", "", zone or "")
    ahead = timedelta(hours=int(digits[:2] or 0), minutes=int(digits[2:] or 0))
    return int((time + ahead if "-" in (zone or "") else time - ahead).timestamp())


IntArray = NDArray[np.int64]

Row = tuple[int, str]
"""Number of a row's line in its file, counted from 1, and its text."""


@dataclass(frozen=True)
class RowFormat:
    """How the rows of a file are written.

    Attributes:
        skip: number of lines above the rows; below, lines that start with `#` are skipped.
        delimiter: separator of the cells; None for blanks.
        decimal: decimal mark, a point or a comma.
        dated: whether dates and times of day are read as seconds, as `with_seconds` does.
    """

    skip: int = 0
    delimiter: str | None = ","
    decimal: str = "."
    dated: bool = False

    def cells(self, line: str) -> list[str]:
        """Return a line's cells without quotes, with decimal points."""
        return unquoted(line, self.delimiter, self.decimal).split(self.delimiter)

    def rows(self, path: Path, lines: list[str] | None = None) -> list[Row]:
        """Return the rows of a file, or of its lines if they are read already, without quotes."""
        lines = lines or read_lines(path)
        if self.decimal != "." or any('"' in line for line in lines):
            lines = [unquoted(line, self.delimiter, self.decimal) for line in lines]
        lines = with_seconds(lines) if self.dated else lines
        rows = [row for row in enumerate(lines[self.skip :], self.skip + 1) if is_row(row[1])]
        if not rows:
            raise ReadError(path, "rows", "none below the header", "rows of numbers")
        return rows


@dataclass(frozen=True)
class Column:
    """A column's index, its title, and the unit in that in the tables' spelling, if any."""

    index: int
    title: str = ""
    unit: str = ""

    @property
    def name(self) -> str:
        """Name for messages."""
        return self.title or f"column {self.index + 1}"


@dataclass(frozen=True)
class Table:
    """Columns of a file as numbers, the first of them times.

    Attributes:
        path: the file.
        row_format: how it is written.
        columns: places of the columns in the file.
        values: (N, K) their numbers; `nan` and empty cells are NaN.
        rows: the rows as text.
    """

    path: Path
    row_format: RowFormat
    columns: Sequence[Column]
    values: FloatArray
    rows: list[Row]

    @property
    def line_numbers(self) -> IntArray:
        """Number (N,) of each row's line."""
        return np.array([number for number, _ in self.rows])

    def cells(self, column: int) -> list[str]:
        """Return the text of a column of the file, empty in rows that are too short."""
        mark = self.row_format.delimiter
        cells = (line.split(mark, column + 1) for _, line in self.rows)
        return [row[column].strip() if column < len(row) else "" for row in cells]

    def stamps_ns(self, unit_ns: int = 1, kept: IntArray | None = None) -> IntArray:
        """Return the times (N,), or those of `kept` rows, in integer nanoseconds.

        Their unit is `unit_ns`; float64 cannot hold them exactly.
        """
        since_1970 = FILETIME_1970 if unit_ns == FILETIME_NS else 0
        times = self._times(range(len(self.rows)) if kept is None else kept.tolist(), finite=True)
        try:
            stamps = [round((time - since_1970) * unit_ns) for time in times]
            return np.array(stamps, dtype=np.int64)
        except OverflowError:
            found = f"a time of {float(max(map(abs, times)) * unit_ns):.3g} ns"
            fix = "is its unit the one that the header names?"
            raise ReadError(self.path, "time", found, "at most 9.2e18 ns", fix) from None

    def seconds(self, unit_ns: int, origin: int) -> FloatArray:
        """Return the times (N,) as seconds since those of a row, exactly as written.

        Args:
            unit_ns: their unit [ns].
            origin: the row; if it has no time, the first one below that has.
        """
        times = self._times(range(len(self.rows)), finite=False)
        start = next((time for time in times[origin:] if time.is_finite()), Decimal(0))
        return np.array([float((time - start) * unit_ns / 10**9) for time in times])

    def _times(self, rows: Iterable[int], finite: bool) -> list[Decimal]:
        clock, times = self.columns[0], list[Decimal]()
        cells = self.cells(clock.index)
        for row in rows:
            try:
                time = Decimal(cells[row])
            except InvalidOperation:
                time = None
            if time is None or (finite and not time.is_finite()):
                where = f"line {self.rows[row][0]}, {clock.title or 'time'}"
                raise ReadError(self.path, where, repr(cells[row]), "a time")
            times.append(time)
        return times


def read_table(
    path: Path,
    columns: int | Sequence[Column],
    row_format: RowFormat = RowFormat(),
    killed: bool = False,
    lines: list[str] | None = None,
) -> Table:
    """Read columns of numbers, their count or places; `nan` and empty cells become NaN.

    A last row that is cut short, because the recorder was `killed`, is then skipped. The file's
    `lines` may be read already.
    """
    places = [Column(k) for k in range(columns)] if isinstance(columns, int) else columns
    rows, mark = row_format.rows(path, lines), row_format.delimiter
    if killed and len(rows) > 1:
        cut = ends_within_a_row(path, mark)
        try:
            _numbers_in_row(path, rows[-1], mark, places)
        except ReadError:
            cut = True
        if cut:
            words = "%s: skipped the last row, line %d, which is cut short"
            _log.warning(words, path, rows.pop()[0])
    try:  # several times as fast, but it neither knows blank cells nor explains what is wrong
        lines = [line for _, line in rows]
        used = [place.index for place in places]
        values = np.loadtxt(lines, delimiter=mark, usecols=used, comments=None, ndmin=2)
    except ValueError:
        values = np.array([_numbers_in_row(path, row, mark, places) for row in rows])
    return Table(path, row_format, places, values, rows)


def _numbers_in_row(
    path: Path, row: Row, mark: str | None, places: Sequence[Column]
) -> list[float]:
    """Return the numbers in some columns of a row, NaN where a cell holds none."""
    (number, line), most = row, max(place.index for place in places)
    cells = line.split(mark)
    if len(cells) <= most:
        fix = "is the file cut short?"
        if len(cells) == 1:
            fix = "separate the values as in the other lines, or remove the line"
        raise ReadError(path, f"line {number}", f"{len(cells)} values", f"{most + 1}", fix)
    numbers = []
    for place in places:
        cell = cells[place.index]
        try:
            numbers.append(float(cell or "nan"))
        except ValueError:
            if not is_missing(cell):
                fix = "write a decimal point" if "," in cell else ""
                where = f"line {number}, {place.name}"
                raise ReadError(path, where, repr(cell.strip()), "a number", fix) from None
            numbers.append(float("nan"))
    return numbers


def is_missing(cell: str) -> bool:
    """Return whether a cell is blank or says that there is no value."""
    return cell.strip().lower() in ("", "na", "n/a", "null", "none")


def seconds(stamps_ns: IntArray, origin_ns: np.int64 | int) -> FloatArray:
    """Convert time stamps [ns] to seconds since an origin."""
    return (stamps_ns - origin_ns).astype(np.float64) * 1e-9
