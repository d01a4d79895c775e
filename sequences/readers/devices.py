"""Rows of several devices in one table, told apart by a column that names or numbers them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path

from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import is_row, read_lines, unquoted
from stario.sequences.readers.phones.sensor_words import words_of
from stario.sequences.readers.text import is_missing

_TITLES = {
    *map("".join, product(("device", "imu", "node"), ("", "id", "name", "number", "address"))),
    *("i", "instance", "mac", "macaddress", "serial", "serialnumber"),
    *("side", "limb", "placement", "bodypart", "sensorlocation", "sensorplacement"),
}
"""Titles, without blanks and the like, of such a column; `I` is that of ArduPilot's logs."""

_MOST = 9
"""Number of different values above which a column says something else."""


def refuse_several_devices(
    path: Path, titles: Sequence[str], skip: int, delimiter: str | None, column: int
) -> None:
    """Refuse rows of several devices, whose samples must not be mixed.

    Args:
        path: the file, which is read if a title is that of such a column.
        titles: titles of its columns.
        skip: number of lines above its rows.
        delimiter: separator of the cells; None for blanks.
        column: index of a column of the sensor; rows in which it is blank do not count.

    Raises:
        ReadError: there are at least two devices.
    """
    for index, title in enumerate(titles):
        if "".join(words_of(title)) not in _TITLES:
            continue
        devices: dict[str, None] = {}
        for line in filter(is_row, read_lines(path)[skip:]):
            cells = unquoted(line, delimiter).split(delimiter)
            if max(index, column) < len(cells) and not is_missing(cells[column]):
                devices.setdefault(cells[index].strip())
            if len(devices) > _MOST:
                break
        if 1 < len(devices) <= _MOST:
            names = ", ".join(name or "blank" for name in devices)
            found = f"several devices ({names})"
            raise ReadError(path, title.strip(), found, "one", "keep the rows of one")
