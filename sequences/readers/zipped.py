"""Recordings exported by apps as a zip of the files of a folder, or as a zip of such zips."""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from stario.sequences.errors import ReadError
from stario.sequences.readers.text import first_bytes

_SUFFIXES = (".csv", ".txt", ".tsv", ".log", ".json", ".properties", ".zip")
_MAX_BYTES = 4 * 2**30
"""Maximum unpacked text [bytes], more than any recording has; guards against zip bombs."""


def is_zip(path: Path) -> bool:
    """Return whether a file is a zip with text files in it; never raises."""
    if path.suffix.lower() != ".zip" or first_bytes(path, 4) != b"PK\x03\x04":
        return False
    try:
        with zipfile.ZipFile(path) as file:
            return any(_is_wanted(info) for info in file.infolist())
    except (OSError, zipfile.BadZipFile):
        return False


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """Unpack a zip's text files into a temporary folder, which is deleted after the block.

    Raises:
        ReadError: the zip is damaged, encrypted or far too large.
    """
    with tempfile.TemporaryDirectory(prefix="stario-") as folder:
        try:
            size = _extract(path, Path(folder), _MAX_BYTES)
            for inner in sorted(Path(folder).rglob("*.zip")):
                size += _extract(inner, inner.with_suffix(""), _MAX_BYTES - size)
                inner.unlink()
        except _DAMAGED as error:
            found = " ".join(str(error).split())
            raise ReadError(path, "zip", found, "an intact zip", "is the zip complete?") from None
        except _TooLargeError:
            found = f"more than {_MAX_BYTES / 2**30:.0f} GiB of text"
            raise ReadError(path, "zip", found, "a recording") from None
        yield Path(folder)


_DAMAGED = (OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError, NotImplementedError)
"""Exceptions raised for a zip that is damaged, encrypted or compressed in a rare way."""


class _TooLargeError(Exception):
    """Error for a zip that unpacks to more than the maximum size."""


def _extract(path: Path, folder: Path, max_size: int) -> int:
    """Unpack the wanted files of a zip; return their size [bytes]."""
    with zipfile.ZipFile(path) as file:
        wanted = [info for info in file.infolist() if _is_wanted(info)]
        size = sum(info.file_size for info in wanted)
        if size > max_size:
            raise _TooLargeError
        for info in wanted:
            file.extract(info, folder)
    return size


def _is_wanted(info: zipfile.ZipInfo) -> bool:
    parts = PurePosixPath(info.filename).parts
    hidden = any(part.startswith((".", "__MACOSX")) for part in parts)
    return not info.is_dir() and not hidden and info.filename.lower().endswith(_SUFFIXES)
