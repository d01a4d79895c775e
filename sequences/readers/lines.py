"""Lines of text files: decoding, and a look at a file's first lines to recognise its format."""

from __future__ import annotations

from pathlib import Path

from stario.sequences.errors import ReadError

_HEAD_BYTES = 32768


def read_lines(path: Path) -> list[str]:
    """Return the lines of a text file.

    Raises:
        ReadError: the file is missing, empty or not text.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise ReadError(path, "file", "no such file", "a readable file") from None
    except OSError as error:
        raise ReadError(path, "file", type(error).__name__, "a readable file") from None
    if b"\0" in content:
        raise ReadError(path, "file", "binary data", "UTF-8 text")
    lines = _decoded(content).splitlines()
    if not any(line.strip() for line in lines):
        raise ReadError(path, "file", "no lines", "rows of numbers", "is the download complete?")
    return lines


def first_line(path: Path, comments: bool = False) -> str | None:
    """Return the first line as in `first_lines`, None if there is none."""
    return next(iter(first_lines(path, 1, comments)), None)


def first_lines(path: Path, count: int, comments: bool = False) -> list[str]:
    """Return up to `count` lines of a text file that are neither blank nor (by default) comments.

    Reads little of the file, and never raises: used to recognise formats.
    """
    return [x for x in head_lines(path) if is_row(x) or (comments and x.strip())][:count]


def head_lines(path: Path) -> list[str]:
    """Return the lines at the start of a text file, the last possibly cut; never raises."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return []
    if b"\0" in head:
        return []
    # The head may end within a character: decode its last line, cut anyway, separately.
    end = max(head.rfind(b"\n"), 0)
    return _decoded(head[:end]).splitlines() + _decoded(head[end:].lstrip(b"\r\n")).splitlines()


def first_bytes(path: Path, count: int = 16) -> bytes:
    """Return the first bytes of a file, empty if it does not exist; never raises."""
    try:
        with path.open("rb") as file:
            return file.read(count)
    except OSError:
        return b""


def first_numbers(path: Path) -> list[float]:
    """Return the first row's numbers, or an empty list if the first row is anything else."""
    return numbers_in(first_line(path) or "")


def numbers_in(line: str, delimiter: str | None = ",") -> list[float]:
    """Return the numbers of a line, or an empty list if it holds anything else."""
    try:
        return [float(cell) for cell in line.split(delimiter)]
    except ValueError:
        return []


def is_row(line: str) -> bool:
    """Return whether a line is neither blank nor a comment."""
    text = line.strip()
    return bool(text) and text[0] != "#"


def _decoded(content: bytes) -> str:
    """Decode UTF-8, or else Latin-1, in which old apps write the signs of units."""
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")
