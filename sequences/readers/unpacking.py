"""Recordings in a zip of a folder's files, or of such zips; names in messages about them."""

from __future__ import annotations

import logging
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

from stario.sequences.errors import ReadError
from stario.sequences.readers.lines import first_bytes

_PACKAGE = "stario.sequences"

_SUFFIXES = (".csv", ".txt", ".tsv", ".log", ".json", ".properties", ".zip")
_MAX_BYTES = 4 * 2**30
"""Maximum unpacked text [bytes], more than any recording has; guards against zip bombs."""

_MAX_FILES = 5000
"""Maximum number of text files, far more than any export has; unpacking 70,000 takes long."""


def is_zip(path: Path) -> bool:
    """Return whether a file is a zip with text files in it; never raises."""
    if first_bytes(path, 4) != b"PK\x03\x04":
        return False
    try:
        with zipfile.ZipFile(path) as file:
            return any(_is_wanted(info) for info in file.infolist())
    except (OSError, zipfile.BadZipFile):
        return False


def unpack_zip(path: Path, folder: Path) -> None:
    """Unpack a zip's text files, and those of the zips in it, into a folder.

    Raises:
        ReadError: the zip is damaged, encrypted or far too large.
    """
    try:
        left = _extract(path, path, folder, _MAX_BYTES)
        for inner in sorted(folder.rglob("*.zip")):
            left = _extract(path, inner, inner.with_suffix(""), left)
            inner.unlink()
    except _DAMAGED as error:
        found = " ".join(str(error).split())
        raise ReadError(path, "zip", found, "an intact zip", "is the zip complete?") from None


_DAMAGED = (OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError, NotImplementedError)
"""Exceptions raised for a zip that is damaged, encrypted or compressed in a rare way."""


def _extract(path: Path, inner: Path, folder: Path, max_bytes: int) -> int:
    """Unpack the wanted files of a zip in `path`; return how many more bytes are allowed."""
    with zipfile.ZipFile(inner) as file:
        wanted = [info for info in file.infolist() if _is_wanted(info)]
        if len(wanted) > _MAX_FILES:
            raise ReadError(path, "zip", f"{len(wanted)} files", "those of one recording")
        left = max_bytes - sum(info.file_size for info in wanted)
        if left < 0:
            found = f"more than {_MAX_BYTES / 2**30:.0f} GiB of text"
            raise ReadError(path, "zip", found, "a recording")
        file.extractall(folder, wanted)
    return left


def _is_wanted(info: zipfile.ZipInfo) -> bool:
    parts = PurePosixPath(info.filename).parts
    hidden = any(part.startswith((".", "__MACOSX")) for part in parts)
    return not info.is_dir() and not hidden and info.filename.lower().endswith(_SUFFIXES)


@contextmanager
def named_after(path: Path, folder: Path) -> Iterator[None]:
    """Let errors and log records of the block name `path` instead of where it is unpacked to.

    `walk.zip/Gyroscope.csv` is the file of that name in the zip.
    """

    def shown(text: str) -> str:
        for inside in (folder / f"{path.stem}.csv", folder):  # the only file is `path` itself
            text = text.replace(str(inside), str(path))
        return text.replace(folder.name, path.stem)

    def rename(record: logging.LogRecord) -> bool:
        record.msg, record.args = shown(record.getMessage()), ()
        return True

    known = logging.root.manager.loggerDict
    # A filter sees only its own logger's records, not those of the loggers below it.
    loggers = [logging.getLogger(name) for name in known if name.startswith(_PACKAGE)]
    for logger in loggers:
        logger.addFilter(rename)
    try:
        yield
    except ReadError as error:
        field = error.field.removeprefix(f"{error.path}: ")
        found, fix = (text.replace(f"{folder}/", "") for text in (error.found, error.fix))
        raise ReadError(shown(str(error.path)), field, found, error.expected, fix) from None
    finally:
        for logger in loggers:
            logger.removeFilter(rename)
