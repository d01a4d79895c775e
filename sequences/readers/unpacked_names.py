"""Names of files in messages about a temporary folder into which a file was unpacked."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from stario.sequences.errors import ReadError

_PACKAGE = "stario.sequences"


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
