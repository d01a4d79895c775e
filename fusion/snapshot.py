"""A stream stopped in one process and continued in another, as bytes without a pickle.

Format: an npz (a zip of arrays). Its member `tree` is the UTF-8 text, as bytes, of a JSON object in
which `{"array": k}` stands for the member `a<k>`; not-a-number and infinity are written as NaN and
Infinity. The object holds

    format    "stario snapshot"
    version   of this layout; another one is refused
    backend   "ekf" or "graph"
    config    the effective configuration, which must equal the restoring navigator's
    model     checksum of the weights, likewise; empty for models without a card
    prior     what was known of the first pose, or null
    intake    samples, windows and counts (`Intake.checkpoint`)
    network   what the network remembers of earlier windows, or null
    fixes     those that wait, and counts of those refused
    recipe    the estimator's state (its `dump`), or null before the first second is over

Arrays and numbers are kept to the last bit, so the continued stream gives the same states.
"""

from __future__ import annotations

import io
import json
import zipfile
from typing import Any

import numpy as np

from stario.sequences.errors import InputError

FORMAT, VERSION = "stario snapshot", 5


def pack(tree: dict[str, Any]) -> bytes:
    """A tree of dictionaries, lists, arrays, numbers, text and None as bytes."""
    arrays: list[np.ndarray[Any, Any]] = []

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return {"array": len(arrays) - 1}
        if isinstance(value, np.generic):
            return value.item()
        if isinstance(value, dict):
            return {str(key): plain(entry) for key, entry in value.items()}
        if isinstance(value, (list, tuple)):
            return [plain(entry) for entry in value]
        return value

    text = json.dumps(plain({"format": FORMAT, "version": VERSION, **tree}))
    members = {f"a{k}": array for k, array in enumerate(arrays)}
    file = io.BytesIO()
    np.savez(file, tree=np.frombuffer(text.encode(), dtype=np.uint8), **members)  # type: ignore[arg-type]
    return file.getvalue()


def unpack(data: bytes) -> dict[str, Any]:
    """The tree that `pack` was given; tuples have become lists.

    Raises:
        InputError: the bytes are no snapshot, or one of another version.
    """
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise InputError("snapshot", "bytes of something else", f"bytes of a {FORMAT}, whole")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        tree = json.loads(arrays["tree"].tobytes().decode())
        if tree["format"] != FORMAT:
            raise ValueError(f"the format {tree['format']!r}")
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        found = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError("snapshot", found, f"bytes of a {FORMAT}, whole") from error
    if tree["version"] != VERSION:
        raise InputError("snapshot: version", repr(tree["version"]), str(VERSION))

    def whole(value: Any) -> Any:
        if isinstance(value, dict):
            if value.keys() == {"array"}:
                return arrays[f"a{value['array']}"]
            return {key: whole(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [whole(entry) for entry in value]
        return value

    result: dict[str, Any] = whole(tree)
    return result


def check_same(name: str, found: object, expected: object) -> None:
    """Refuse a snapshot that belongs to something else; names the first value that differs.

    Raises:
        InputError: the values differ.
    """
    if isinstance(found, dict) and isinstance(expected, dict) and found.keys() == expected.keys():
        for key, value in expected.items():
            check_same(f"{name}.{key}", found[key], value)
    elif found != expected:
        fix = "restore with the same configuration and weights"
        raise InputError(f"snapshot: {name}", repr(found), repr(expected), fix)
