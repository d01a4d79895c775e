"""Recordings as apps export them: a zip of the files that would be in a folder, or of such zips."""

from __future__ import annotations

import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from stario.sequences.errors import ReadError
from stario.sequences.readers.text import magic

_SUFFIXES = (".csv", ".txt", ".tsv", ".log", ".json", ".properties", ".zip")
_LARGEST = 4 * 2**30
"""More text [bytes] than any recording has: a zip that unpacks to it is a trap."""


def is_zip(path: Path) -> bool:
    """Whether a file is a zip with text files in it; never raises."""
    if path.suffix.lower() != ".zip" or magic(path, 4) != b"PK\x03\x04":
        return False
    try:
        with zipfile.ZipFile(path) as file:
            return any(_is_wanted(info) for info in file.infolist())
    except (OSError, zipfile.BadZipFile):
        return False


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """A temporary folder with a zip's text files, gone after the block.

    Raises:
        ReadError: the zip is broken, encrypted or far too large.
    """
    with tempfile.TemporaryDirectory(prefix="stario-") as folder:
        try:
            size = _extract(path, Path(folder), _LARGEST)
            for inner in sorted(Path(folder).rglob("*.zip")):
                size += _extract(inner, inner.with_suffix(""), _LARGEST - size)
                inner.unlink()
        except _BROKEN as error:
            found = " ".join(str(error).split())
            raise ReadError(path, "zip", found, "a whole zip", "is it complete?") from None
        except _TooLargeError:
            found = f"more than {_LARGEST / 2**30:.0f} GiB of text"
            raise ReadError(path, "zip", found, "a recording") from None
        yield Path(folder)


_BROKEN = (OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError, NotImplementedError)
"""What a damaged zip raises, and one that is encrypted or packed in a rare way."""


class _TooLargeError(Exception):
    """A zip that unpacks to more than is allowed."""


def _extract(path: Path, folder: Path, most: int) -> int:
    """Unpack what is wanted of a zip; its size [bytes]."""
    with zipfile.ZipFile(path) as file:
        wanted = [info for info in file.infolist() if _is_wanted(info)]
        size = sum(info.file_size for info in wanted)
        if size > most:
            raise _TooLargeError
        for info in wanted:
            file.extract(info, folder)
    return size


def _is_wanted(info: zipfile.ZipInfo) -> bool:
    parts = PurePosixPath(info.filename).parts
    hidden = any(part.startswith((".", "__MACOSX")) for part in parts)
    return not info.is_dir() and not hidden and info.filename.lower().endswith(_SUFFIXES)
