"""Values of options: names, assignments, and files with the settings of a recipe."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stario.sequences.errors import ConfigError, InputError


def recipe_values(path: Path) -> dict[str, Any]:
    """Read the settings of a training recipe from a JSON file.

    Raises:
        ConfigError: the file cannot be read, or is not a table of settings.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError) as error:
        found = "no such file" if isinstance(error, FileNotFoundError) else str(error)
        raise ConfigError(str(path), found, "a JSON file with settings") from error
    if not isinstance(values, dict):
        raise ConfigError(str(path), type(values).__name__, "a table of settings")
    return values


def assignment(option: str, word: str, expected: str, example: str) -> tuple[str, str]:
    """Return what is left and right of the first `=` in the value of an option.

    Raises:
        InputError: there is no `=`, or nothing on one side of it.
    """
    key, _, value = word.partition("=")
    if not (key and value):
        raise InputError(option, repr(word), expected, example)
    return key, value


def names_in(text: str) -> list[str]:
    """Return the names in a comma-separated list."""
    return [name.strip() for name in text.split(",")]
