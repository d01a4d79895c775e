"""The `StarioError` family: exceptions for input that the library cannot use."""

from __future__ import annotations

import copyreg
from pathlib import Path
from typing import Any


class StarioError(Exception):
    """Base class of all errors raised on purpose; the text is one line for a user."""

    def __reduce__(self) -> tuple[Any, ...]:
        # By default, unpickling calls the class with the text, which is not what these take.
        return copyreg.__newobj__, (type(self), *self.args), vars(self)  # type: ignore[attr-defined]


class InputError(StarioError, ValueError):
    """Invalid value passed to a public function.

    Args:
        field: name of the argument, column or option that is wrong.
        found: the actual value.
        expected: what a valid value is.
        fix: what the caller can do about it; empty if `expected` is enough.
    """

    def __init__(self, field: str, found: str, expected: str, fix: str = "") -> None:
        self.field, self.found, self.expected, self.fix = field, found, expected, fix
        text = f"{field}: found {found}, expected {expected}"
        super().__init__(f"{text}; {fix}" if fix else text)


class MissingPackageError(InputError):
    """Optional package that is not installed: it concerns all recordings that need it."""


class ReadError(InputError):
    """Unreadable or invalid file; names the file in addition to field, found and expected."""

    def __init__(
        self, path: Path | str, field: str, found: str, expected: str, fix: str = ""
    ) -> None:
        self.path = Path(path)
        super().__init__(f"{path}: {field}", found, expected, fix)


class ConfigError(InputError):
    """Invalid configuration file or value."""


class WeightsError(ReadError):
    """Weights file or card that does not match the other, the model or the checksum."""
