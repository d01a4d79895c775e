"""Live recording on disk: a generic CSV, complete up to the last batch at any moment.

Each batch is one unbuffered write of whole lines, so that a killed program loses nothing that it
accepted. `read_recording` can also read the file while it grows. The last column, the time of
receipt, does not come from the device: a truncated line lacks it and can thus be recognised.
"""

from __future__ import annotations

import csv
import errno
import io
import itertools
import math
import os
import re
from collections.abc import Iterable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from stario.fusion.live.merging import Sample
from stario.fusion.live.payload import BAROMETER, LOCATION, MAG, Reading
from stario.fusion.values.fixes import Fix
from stario.sequences.errors import InputError
from stario.sequences.readers.columns import MAGNETIC_HEADER, PRESSURE_HEADER, SATELLITE_HEADER

_ASIDE = {
    MAG: MAGNETIC_HEADER.split(","),
    BAROMETER: [PRESSURE_HEADER],
    LOCATION: [*SATELLITE_HEADER.values()],
}
"""Columns of sensors that may start later; their readings have rows of their own."""

_IMU = ["gx [rad/s]", "gy [rad/s]", "gz [rad/s]", "ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]"]

_HEADER = ["t [ns]", *_IMU, *itertools.chain(*_ASIDE.values()), "received [unix s]"]
_FIXES_HEADER = ("t", "kind", *"xyz", "sx", "sy", "sz")


class LiveFile:
    """Growing recording of a device in a folder, with its fixes, once there are, next to it.

    Raises:
        InputError: the folder or file cannot be created.
    """

    def __init__(self, folder: Path, device: str) -> None:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.path, self._file = _new_file(folder, device)
        except OSError as error:
            found = f"{folder}: {error.strerror or error}"
            raise InputError("out", found, "a writable folder") from error
        self.fixes_path = self.path.with_name(f"{self.path.stem}-fixes.csv")

    def append(
        self, samples: Sequence[Sample], received: float, aside: Sequence[Reading] = ()
    ) -> None:
        """Append samples, and readings of other sensors, received at a time [s since 1970].

        Raises:
            OSError: they could not all be written; the file is then unchanged.
        """
        end = f"{received:.3f}"
        rows = [(each.time_ns, *[""] * len(_IMU), *_cells(each), end) for each in aside]
        blank = [""] * (len(_HEADER) - 2 - len(_IMU))
        rows += [(time, *gyro, *accel, *blank, end) for time, gyro, accel in samples]
        _write_whole(self._file, rows)

    def append_fix(self, fix: Fix) -> None:
        """Append a position fix for `stario run --fixes`; its time counts from the first sample."""
        sigma = fix.covariance.diagonal() ** 0.5
        row = (fix.time, "position", *fix.value.tolist(), *sigma.tolist())
        with self.fixes_path.open("ab", buffering=0) as file:
            # An attempt on a full disk may have left an empty file.
            _write_whole(file, [row] if file.tell() else [_FIXES_HEADER, row])

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _cells(reading: Reading) -> list[object]:
    """Return a reading in the columns of `_ASIDE`, blank where it is unknown."""
    cells: list[object] = []
    for sensor, titles in _ASIDE.items():
        values = reading.value if sensor == reading.sensor else [math.nan] * len(titles)
        cells += ["" if math.isnan(value) else value for value in values]
    return cells


def _write_whole(file: BinaryIO, rows: Iterable[Sequence[object]]) -> None:
    """Append all rows or nothing, as a nearly full disk may take only a part."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    before, data = file.tell(), text.getvalue().encode()
    if file.write(data) < len(data):
        file.truncate(before)
        file.seek(before)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _new_file(folder: Path, device: str) -> tuple[Path, BinaryIO]:
    """Create a new file with the header, named by time and device."""
    slug = re.sub(r"[^A-Za-z0-9]+", "-", device).strip("-")[:32] or "device"
    stem = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{slug}"
    for number in itertools.count(1):
        path = folder / (f"{stem}.csv" if number == 1 else f"{stem}-{number}.csv")
        with suppress(FileExistsError):
            file = path.open("xb", buffering=0)
            break
    try:
        _write_whole(file, [_HEADER])
    except OSError:  # on a full disk; each attempt would leave another empty file
        file.close()
        path.unlink()
        raise
    return path, file
