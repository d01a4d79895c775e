"""Live recording on disk: a generic CSV, complete up to the last batch at any moment.

Each batch is one unbuffered write of whole lines, so that a killed program loses nothing that it
accepted. `read_recording` can also read the file while it grows. The last column, the time of
receipt, does not come from the device: a truncated line lacks it and can thus be recognised.
"""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from stario.fusion.fixes import Fix
from stario.fusion.live.merging import Sample
from stario.fusion.live.payload import BAROMETER, LOCATION, MAG, Reading
from stario.sequences.errors import InputError
from stario.sequences.readers.columns import MAGNETIC_HEADER, PRESSURE_HEADER, SATELLITE_HEADER

_ASIDE = {
    MAG: MAGNETIC_HEADER.split(","),
    BAROMETER: [PRESSURE_HEADER],
    LOCATION: [*SATELLITE_HEADER.values()],
}
"""Columns of sensors that may start later; their readings have rows of their own."""

HEADER = (
    "t [ns],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2],"
    f"{','.join(title for titles in _ASIDE.values() for title in titles)},received [unix s]\n"
)
"""Header of a recording."""

_NO_IMU = "," * 6
_NO_ASIDE = "," * (sum(map(len, _ASIDE.values())) - 1)

FIXES_HEADER = "t,kind,x,y,z,sx,sy,sz\n"


class LiveFile:
    """Growing recording, with its fixes in a file next to it.

    Args:
        folder: folder to write into; created if missing.
        device: part of the file's name.

    Attributes:
        path: path of the recording.
        fixes_path: path of the fixes; the file exists once one was given.

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
        end = f"{received:.3f}\n"
        rows = [f"{reading.time_ns}{_NO_IMU},{_cells(reading)},{end}" for reading in aside]
        rows += [
            f"{time},{g[0]!r},{g[1]!r},{g[2]!r},{a[0]!r},{a[1]!r},{a[2]!r},{_NO_ASIDE},{end}"
            for time, g, a in samples
        ]
        _write_whole(self._file, "".join(rows).encode())

    def append_fix(self, fix: Fix) -> None:
        """Append a position fix for `stario run --fixes`; its time counts from the first sample."""
        (x, y, z), sigma = fix.value.tolist(), fix.covariance.diagonal() ** 0.5
        sx, sy, sz = sigma.tolist()
        line = f"{fix.time!r},position,{x!r},{y!r},{z!r},{sx!r},{sy!r},{sz!r}\n"
        with self.fixes_path.open("ab", buffering=0) as file:
            # An attempt on a full disk may have left an empty file.
            _write_whole(file, (line if file.tell() else FIXES_HEADER + line).encode())

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _cells(reading: Reading) -> str:
    """Return a reading in the columns of `_ASIDE`, blank where it is unknown."""
    cells: list[str] = []
    for sensor, titles in _ASIDE.items():
        values = reading.value if sensor == reading.sensor else [math.nan] * len(titles)
        cells += ["" if math.isnan(value) else repr(value) for value in values]
    return ",".join(cells)


def _write_whole(file: BinaryIO, data: bytes) -> None:
    """Append all data or nothing, as a nearly full disk may take only a part."""
    before = file.tell()
    try:
        if file.write(data) < len(data):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError:
        file.truncate(before)
        file.seek(before)
        raise


def _new_file(folder: Path, device: str) -> tuple[Path, BinaryIO]:
    """Create a new file with the header, named by time and device."""
    slug = re.sub(r"[^A-Za-z0-9]+", "-", device).strip("-")[:32] or "device"
    stem = f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{slug}"
    for number in range(1, 1000):
        path = folder / (f"{stem}.csv" if number == 1 else f"{stem}-{number}.csv")
        try:
            file = path.open("xb", buffering=0)
        except FileExistsError:
            continue
        try:
            _write_whole(file, HEADER.encode())
        except OSError:  # on a full disk; each attempt would leave another empty file
            file.close()
            path.unlink()
            raise
        return path, file
    raise InputError("out", f"999 files named {stem}", "an unused name", "choose another folder")
