"""Reference points beside a logger's files: places that the user passed at known times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.readers.phones.sensor_table import first_row
from stario.sequences.readers.phones.sensor_words import words_of
from stario.sequences.readers.text import head_lines, read_table, seconds
from stario.sequences.sequence import PositionTrack
from stario.sequences.time_order import advancing
from stario.sequences.units import TIME_UNITS

_NAMES = {"ref", "reference", "references", "waypoints", "waypoint", "checkpoints", "landmarks"}

_BESIDE_S = 60.0
"""Reference points lie within a recording, or so little before or behind it."""


def reference_points(
    folder: Path, key: str, start_ns: np.int64, stop_ns: np.int64
) -> PositionTrack | None:
    """Waypoints of `*_ref.csv` and the like: rows of time, x and y [m]; None without such a file.

    Args:
        folder: where to look.
        key: the words that all files of the recording share.
        start_ns: the recording's first sample on the sensors' clock [ns].
        stop_ns: its last one.

    Raises:
        ReadError: a row is malformed.
    """
    for file in sorted(folder.iterdir()):
        words = set(words_of(file.stem))
        if file.suffix.lower() not in (".csv", ".txt") or not _NAMES & words:
            continue
        lines = [(k, line) for k, line in enumerate(head_lines(file)) if line.strip()]
        found = first_row(lines, least=3)
        if found is None or not set(key.split()) <= words:
            continue
        first, delimiter, decimal = found
        table = read_table(file, 3, lines[first][0], delimiter, None, decimal, killed=True)
        start, stop = float(start_ns) * 1e-9 - _BESIDE_S, float(stop_ns) * 1e-9 + _BESIDE_S
        stamps = table.values[:, 0]
        # Of stamps from zero on finer units fit as well, with all points at the start.
        fitting = {
            unit: int(((stamps / unit > start) & (stamps / unit < stop)).sum())
            for unit in sorted(TIME_UNITS.values())
        }
        unit = max(fitting, key=lambda unit: fitting[unit])
        if not fitting[unit]:
            raise ReadError(file, "time", "other times", "those of the sensors' files")
        time = seconds(table.stamps_ns(0, unit), start_ns)
        kept = advancing(time)
        return PositionTrack(time[kept], table.values[kept, 1:3], "waypoints")
    return None
