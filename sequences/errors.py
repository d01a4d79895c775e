"""The `StarioError` family: what the library raises on input it cannot use."""

from __future__ import annotations

from pathlib import Path
from typing import Any


class StarioError(Exception):
    """Base of every error the library raises on purpose; its text is one line for a user."""

    def __reduce__(self) -> tuple[Any, ...]:
        # An exception is unpickled by calling its class with its text: not what these take.
        return _with_text, (type(self), *self.args), vars(self)


def _with_text(kind: type[StarioError], *args: object) -> StarioError:
    """An error as pickle begins it; the fields are put back by pickle itself."""
    return kind.__new__(kind, *args)


class InputError(StarioError, ValueError):
    """A value given to a public function does not fit.

    Args:
        field: name of the argument, column or option that is wrong.
        found: what was there.
        expected: what belongs there.
        fix: what the caller can do about it; empty where `expected` says it all.
    """

    def __init__(self, field: str, found: str, expected: str, fix: str = "") -> None:
        self.field, self.found, self.expected, self.fix = field, found, expected, fix
        text = f"{field}: found {found}, expected {expected}"
        super().__init__(f"{text}; {fix}" if fix else text)


class ReadError(InputError):
    """A file cannot be read: names the file beside field, found and expected."""

    def __init__(
        self, path: Path | str, field: str, found: str, expected: str, fix: str = ""
    ) -> None:
        self.path = Path(path)
        super().__init__(f"{path}: {field}", found, expected, fix)


class ConfigError(InputError):
    """A configuration file or value does not fit."""


class WeightsError(ReadError):
    """A weights file and its card do not match each other, the model or the checksum."""
