"""Reference points next to a logger's files: places that the user passed at known times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stario.sequences.readers.clocks import unit_within
from stario.sequences.readers.phones.sensor_words import words_of
from stario.sequences.readers.table_head import table_heads
from stario.sequences.readers.text import seconds
from stario.sequences.sequence import PositionTrack
from stario.sequences.time_order import increasing_mask

_NAMES = {"ref", "reference", "references", "waypoints", "waypoint", "checkpoints", "landmarks"}


def reference_points(
    folder: Path, key: str, start_ns: np.int64, stop_ns: np.int64
) -> PositionTrack | None:
    """Return the waypoints of a file such as `*_ref.csv` (time, x, y [m]), or None without one.

    Args:
        folder: the folder to search.
        key: the words that the names of all files of the recording share.
        start_ns: time of the recording's first sample on the sensors' clock [ns].
        stop_ns: time of its last sample [ns].

    Raises:
        ReadError: a row is malformed.
    """
    for file in sorted(folder.iterdir()):
        words = set(words_of(file.stem))
        if file.suffix.lower() not in (".csv", ".txt") or not _NAMES & words:
            continue
        head = next(table_heads(file, least=3), None)
        if head is None or not set(key.split()) <= words:
            continue
        table = head.read(3)
        unit = unit_within(file, table.values[:, 0], start_ns, stop_ns)
        time = seconds(table.stamps_ns(0, unit), start_ns)
        kept = increasing_mask(time)
        return PositionTrack(time[kept], table.values[kept, 1:3], "waypoints")
    return None
