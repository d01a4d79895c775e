"""Live recording on disk: a generic CSV, complete up to the last batch at any moment.

Each batch is one unbuffered write of whole lines, so that a killed program loses nothing that it
accepted. `read_recording` can also read the file while it grows. The last column, the time of
receipt, does not come from the device: a truncated line lacks it and can thus be recognised.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO

from stario.fusion.fixes import Fix
from stario.fusion.live.merging import Field, Sample
from stario.sequences.errors import InputError

HEADER = (
    "t [ns],gx [rad/s],gy [rad/s],gz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2],"
    "mx [uT],my [uT],mz [uT],received [unix s]\n"
)
"""Header; a magnetometer, which may start later, has rows of its own."""

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
        self, samples: Sequence[Sample], received: float, fields: Sequence[Field] = ()
    ) -> None:
        """Append samples and magnetic fields received at a time [s since 1970].

        Raises:
            OSError: they could not all be written; the file is then unchanged.
        """
        end = f"{received:.3f}\n"
        rows = [f"{time},,,,,,,{m[0]!r},{m[1]!r},{m[2]!r},{end}" for time, m in fields]
        rows += [
            f"{time},{g[0]!r},{g[1]!r},{g[2]!r},{a[0]!r},{a[1]!r},{a[2]!r},,,,{end}"
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
