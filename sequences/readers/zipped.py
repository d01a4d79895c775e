"""Recordings as apps export them: a zip of the files that would be in a folder."""

from __future__ import annotations

import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from stario.sequences.errors import ReadError
from stario.sequences.readers.text import magic

_SUFFIXES = (".csv", ".txt", ".tsv", ".json", ".properties")
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
            with zipfile.ZipFile(path) as file:
                wanted = [info for info in file.infolist() if _is_wanted(info)]
                size = sum(info.file_size for info in wanted)
                if size > _LARGEST:
                    raise ReadError(path, "zip", f"{size / 2**30:.0f} GiB of text", "a recording")
                for info in wanted:
                    file.extract(info, folder)
        except (OSError, zipfile.BadZipFile, RuntimeError, NotImplementedError) as error:
            found = " ".join(str(error).split())
            raise ReadError(path, "zip", found, "a whole zip", "is it complete?") from None
        yield Path(folder)


def _is_wanted(info: zipfile.ZipInfo) -> bool:
    parts = PurePosixPath(info.filename).parts
    hidden = any(part.startswith((".", "__MACOSX")) for part in parts)
    return not info.is_dir() and not hidden and info.filename.lower().endswith(_SUFFIXES)
