"""Recognising HDF5 files, and opening those that may be damaged."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stario.sequences.errors import ReadError, StarioError
from stario.sequences.lazy import optional_package
from stario.sequences.readers.lines import first_bytes

_MAGIC = b"\x89HDF\r\n\x1a\n"

DAMAGED = (OSError, RuntimeError, KeyError, ValueError, TypeError, IndexError, AttributeError)
"""Exceptions of h5py and NumPy for a damaged file, or for one with other content."""


def is_hdf5(path: Path) -> bool:
    """Return whether a file is HDF5, by its first bytes; never raises."""
    return first_bytes(path, len(_MAGIC)) == _MAGIC


@contextmanager
def opened_hdf5(path: Path, expected: str) -> Iterator[Any]:
    """Open a file for reading; damage or other content found in the block becomes a ReadError.

    Args:
        path: the file.
        expected: what the file should be, for the error.

    Raises:
        ReadError: the file or what the block reads from it is damaged.
        MissingPackageError: h5py is not installed.
    """
    h5py = optional_package("h5py", "readers")
    try:
        with h5py.File(path) as file:
            yield file
    except StarioError:
        raise
    except DAMAGED as error:
        found = " ".join(str(error).split())[:200] or type(error).__name__
        locked = isinstance(error, BlockingIOError) or "already open for write" in found
        fix = "close it in the program that writes it" if locked else "is the download complete?"
        raise ReadError(path, "content", found, expected, fix) from error
