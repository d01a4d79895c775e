"""Numbers from JSON files that accompany a recording."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stario.sequences.errors import ReadError
from stario.sequences.sequence import FloatArray


class JsonFields:
    """The object in a JSON file.

    Args:
        path: the file.

    Raises:
        ReadError: the file does not exist or holds no JSON object.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.fields = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ReadError(path, "file", "no such file", "the recording's JSON file") from None
        except (OSError, ValueError) as error:
            found = " ".join(str(error).split())
            raise ReadError(path, "file", found, "JSON", "is the download complete?") from None
        if not isinstance(self.fields, dict):
            raise ReadError(path, "file", type(self.fields).__name__, "a JSON object")

    def get(self, name: str, default: Any = None) -> Any:
        """Return the value at a dotted name, `Gyroscope.Bias.Offset`, or the default."""
        value: Any = self.fields
        for part in name.split("."):
            if not isinstance(value, dict) or part not in value:
                return default
            value = value[part]
        return value

    def array(self, name: str, *shape: int) -> FloatArray:
        """Return finite numbers of a shape; a single number if no shape is given.

        Raises:
            ReadError: the field is missing or holds anything else.
        """
        return as_array(self.path, name, self.get(name), *shape)


def as_array(path: Path, name: str, value: Any, *shape: int) -> FloatArray:
    """Convert the JSON value of a field to finite numbers of a shape.

    Raises:
        ReadError: the value is anything else, or None because the field is missing.
    """
    expected = f"{' x '.join(map(str, shape)) or 'a'} finite number{'s' if shape else ''}"
    if value is None:
        raise ReadError(path, name, "no such field", expected)
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.full(1, np.nan)
    if array.shape != shape or not np.isfinite(array).all():
        raise ReadError(path, name, repr(value)[:60], expected)
    return array
