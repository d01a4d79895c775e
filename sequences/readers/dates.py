"""Times written as dates or as times of day, converted to seconds."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import UTC, datetime, timedelta
from functools import lru_cache

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
    """Return the seconds since 1970, or without a date since a midnight.

    Raises:
        ValueError: there is no such time.
    """
    hour, minute, second = map(int, clock.split(":"))
    if half:
        hour = hour % 12 + 12 * (half.lower() == "pm")
    if not date:
        datetime(2000, 1, 1, hour, minute, second)  # refuses what is no time
        # Counted from the midnight before, so that a step back across one stays positive.
        return _DAY_S + (60 * hour + minute) * 60 + second
    time = datetime(*_day(date), hour, minute, second, tzinfo=UTC)
    return int((time - _offset(zone or "")).timestamp())


def _day(date: str) -> tuple[int, int, int]:
    first, middle, last = re.split("[-/]", date)
    if middle.isdecimal():
        return int(first), int(middle), int(last)
    return int(last), _MONTHS.index(middle.lower()) + 1, int(first)


def _offset(zone: str) -> timedelta:
    """Return how far a zone such as `+02:00`, `UTC-0330` or `Z` is ahead of UTC."""
    digits = re.sub(r"\D", "", zone)
    ahead = timedelta(hours=int(digits[:2] or 0), minutes=int(digits[2:] or 0))
    return -ahead if "-" in zone else ahead
