"""Settings from a file: groups of fields with defaults, validated field by field."""

from __future__ import annotations

import json
import math
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass, replace
from numbers import Real
from pathlib import Path
from typing import Any, TypeVar

from stario.sequences.errors import ConfigError, InputError
from stario.sequences.files import opened_text

Group = TypeVar("Group")


def check_number(settings: object, name: str, low: float = 0.0, high: float = math.inf) -> None:
    """Check that a field is a finite number within bounds.

    Raises:
        ConfigError: the field is anything else; the error names it and the bounds.
    """
    value: Any = getattr(settings, name)  # NumPy scalars are Real, too
    if not (isinstance(value, Real) and math.isfinite(value) and low <= float(value) <= high):
        bounds = f"of at least {low:g}" if high == math.inf else f"from {low:g} to {high:g}"
        raise ConfigError(name, repr(value), f"a finite number {bounds}")


def read_settings(path: Path) -> dict[str, Any]:
    """Read settings, a table of values, from a TOML or JSON file.

    Raises:
        ConfigError: the file is missing or malformed.
    """
    expected = "a TOML or JSON file"
    try:
        text = opened_text(path)
        values = json.loads(text) if path.suffix.lower() == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(str(path), "no such file", expected) from None
    except OSError as error:
        raise ConfigError(str(path), error.strerror or "an error", expected) from error
    except ValueError as error:
        raise ConfigError(str(path), str(error), expected) from error
    if not isinstance(values, dict):
        raise ConfigError(str(path), type(values).__name__, "a table of values")
    return values


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Add the name of the file whose settings are used to errors in the block."""
    try:
        yield
    except ConfigError as error:
        field = f"{path}: {error.field}"
        raise ConfigError(field, error.found, error.expected, error.fix) from error


def with_settings(default: Group, values: object, name: str = "") -> Group:
    """Return a frozen dataclass with some of its values replaced, also within nested groups.

    Args:
        default: dataclass with the values not given; its own checks validate the result.
        values: a parsed TOML table or JSON object.
        name: name of the group, for messages.

    Raises:
        ConfigError: `values` is not a table, a key is unknown, or a value is invalid.
    """
    if not isinstance(values, dict):
        raise ConfigError(name, repr(values), "a table of values")
    known = {item.name: getattr(default, item.name) for item in fields(default)}  # type: ignore[arg-type]
    prefix, given = f"{name}." if name else "", {}
    for key, value in values.items():
        if key not in known:
            raise ConfigError(f"{prefix}{key}", "an unknown key", f"one of {', '.join(known)}")
        given[key] = _checked_value(f"{prefix}{key}", value, known[key])
    try:
        return replace(default, **given)  # type: ignore[type-var]
    except InputError as error:
        raise ConfigError(f"{prefix}{error.field}", error.found, error.expected) from error


def _checked_value(name: str, value: Any, default: Any) -> Any:
    if is_dataclass(default):
        return with_settings(default, value, name)
    if isinstance(default, tuple) and isinstance(value, list):
        return tuple(value)
    wanted = (float, int) if isinstance(default, float) else (type(default),)
    # A field that defaults to None may have any type; the group's own checks validate it.
    if default is not None and type(value) not in wanted:
        raise ConfigError(name, repr(value), f"a value of type {type(default).__name__}")
    return value
