"""Rows of several devices in one table, told apart by a column that names or numbers them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

from stario.sequences.errors import ReadError
from stario.sequences.readers.phones.sensor_words import words_of
from stario.sequences.readers.text import Table, is_missing

_TITLES = {
    *map("".join, product(("device", "imu", "node"), ("", "id", "name", "number", "address"))),
    *("i", "instance", "mac", "macaddress", "serial", "serialnumber"),
    *("side", "limb", "placement", "bodypart", "sensorlocation", "sensorplacement"),
}
"""Titles, without blanks and the like, of such a column; `I` is that of ArduPilot's logs."""

_MOST = 9
"""Number of different values above which a column says something else."""


def refuse_several_devices(table: Table, titles: Sequence[str], column: int) -> None:
    """Refuse rows of several devices, whose samples must not be mixed.

    Args:
        table: the rows.
        titles: titles of the file's columns.
        column: index of a column of the sensor; rows in which it is blank do not count.

    Raises:
        ReadError: there are at least two devices.
    """
    for index, title in enumerate(titles):
        if "".join(words_of(title)) not in _TITLES:
            continue
        pairs = zip(table.cells(index), table.cells(column), strict=True)
        devices = dict.fromkeys(device for device, cell in pairs if not is_missing(cell))
        if 1 < len(devices) <= _MOST:
            names = ", ".join(name or "blank" for name in devices)
            found = f"several devices ({names})"
            raise ReadError(table.path, title.strip(), found, "one", "keep the rows of one")
