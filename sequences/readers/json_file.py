"""Reading of JSON files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from stario.sequences.errors import ReadError
from stario.sequences.files import opened_text


def read_json(path: Path) -> Any:
    """Return the content of a JSON file.

    Raises:
        ReadError: the file is missing or not JSON.
    """
    try:
        return json.loads(opened_text(path))
    except FileNotFoundError:
        raise ReadError(path, "file", "no such file", "a JSON file") from None
    except (OSError, ValueError, RecursionError) as error:
        found = " ".join(str(error).split())
        raise ReadError(path, "file", found, "JSON", "is the download complete?") from None
