"""Lines of text files: decoding, dates as seconds, and a look at the first lines."""

from __future__ import annotations

import csv
import json
import logging
import os
import re
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Any

from stario.sequences.errors import ReadError
from stario.sequences.files import opened, opened_text

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
        content = _without_padding(path, content)
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


def _without_padding(path: Path, content: bytes) -> bytes:
    """Return a file's text without the zeros that a recorder which lost power left at its end."""
    text = content.rstrip(b"\0")
    if b"\0" in text:
        raise ReadError(path, "file", "binary data", "UTF-8 text")
    if len(text) < len(content):
        count = len(content) - len(text)
        _log.warning(
            "%s: skipped %d zero bytes at the end: did the recorder lose power?", path, count
        )
    return text


def may_be_read(path: Path) -> bool:
    """Return whether permissions allow to read a file, or to list a folder."""
    return os.access(path, os.R_OK | (os.X_OK if path.is_dir() else 0))


def first_line(path: Path, comments: bool = False) -> str | None:
    """Return the first line as in `first_lines`, None if there is none."""
    return next(iter(first_lines(path, 1, comments)), None)


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


def first_numbers(path: Path) -> list[float]:
    """Return the first row's numbers, or an empty list if the first row is anything else."""
    return numbers_in(first_line(path) or "")


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
    elif '"' in line and delimiter is not None:
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
