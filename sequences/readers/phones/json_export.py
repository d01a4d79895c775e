"""Sensor Logger's JSON export: an array with one object per sample that names its sensor.

    [{"sensor": "Gyroscope", "time": "1698501144401773000", "z": "0.1", "y": "0.2", "x": "0.3"}, ...

It holds the same data as the app's folder of CSV files, so it is converted to such a folder.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path
from typing import Any

from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import head_lines, read_json

_FIRST = re.compile(r"\ufeff?\s*\[\s*\{[^{}]*\"sensor\"\s*:")
_NAME = re.compile(r"\w+")


def is_json_export(path: Path) -> bool:
    """Return whether a file begins with such an array; never raises."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    return _FIRST.match("\n".join(head_lines(path))) is not None


def unpack_json(path: Path, folder: Path) -> None:
    """Write a file for each sensor into a folder.

    Raises:
        ReadError: the file is not a JSON array of objects that name sensors.
    """
    sensors: dict[str, list[dict[str, Any]]] = {}
    for row in _rows(path):
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


def _rows(path: Path) -> list[dict[str, Any]]:
    rows = read_json(path)
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ReadError(path, "file", "other JSON", "an array of objects, one for each sample")
    return rows
