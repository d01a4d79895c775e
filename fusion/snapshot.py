"""Snapshots of a stream as bytes, without pickle, to continue it in another process.

Format: an npz (a zip of arrays). Its member `tree` is the UTF-8 text, as bytes, of a JSON value in
which `{"array": k}` stands for the member `a<k>`, `{"tuple": [...]}` and
`{"deque": [...], "maxlen": n}` for such sequences, `{"map": [[key, value], ...]}` for a
dictionary whose keys are not strings, and `{"is": name, "has": {...}}` for an object of a class in
`_PACKAGES` and `_MODULES`; NaN and infinity are written as NaN and Infinity. The member
`sha256` is the checksum of all others. The tree contains

    format     "stario snapshot"
    version    version of this layout; others are refused
    backend    "ekf" or "graph"
    config     effective configuration, which must equal that of the restoring navigator
    model      checksum of the weights, which must be equal too; empty for models without a card
    prior      prior on the first pose, or null
    front end  samples, windows and counts
    network    memory of the network, or null
    continuous the continuous pose, or null
    fixes      waiting fixes, and counts of those refused
    estimator  state of the back end, or null during the first second

Arrays and numbers keep every bit, so the continued stream gives the same states.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import pkgutil
import zipfile
from collections import deque
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from stario.sequences.errors import InputError

FORMAT, VERSION = "stario snapshot", 27


_PACKAGES = ("fusion.filter", "fusion.graph", "fusion.imu")
_MODULES = """
fusion.config fusion.fixes fusion.health fusion.state sequences.attitude.levelling sequences.noise
"""
"""Packages and modules whose classes a snapshot may hold: plain data, rebuilt from attributes."""


@cache
def _classes() -> dict[str, type]:
    """Return every class that a snapshot may hold, by name."""
    names = _MODULES.split()
    for package in _PACKAGES:
        path = importlib.import_module(f"stario.{package}").__path__
        names += [f"{package}.{module.name}" for module in pkgutil.iter_modules(path)]
    modules = [importlib.import_module(f"stario.{name}") for name in names]
    return {
        name: each
        for module in modules
        for name, each in vars(module).items()
        if isinstance(each, type) and each.__module__ == module.__name__
    }


def pack(tree: dict[str, Any]) -> bytes:
    """Convert a tree of dicts, sequences, arrays, plain values and known objects to bytes."""
    # By identity: states share unchanged arrays.
    arrays: dict[int, tuple[int, np.ndarray[Any, Any]]] = {}

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            k, _ = arrays.setdefault(id(value), (len(arrays), value))
            return {"array": k}
        if isinstance(value, np.generic):
            return value.item()
        name = type(value).__name__
        if name in _classes():
            has = value._asdict() if hasattr(value, "_asdict") else value.__getstate__()
            return {"is": name, "has": {key: plain(entry) for key, entry in has.items()}}
        if isinstance(value, deque):
            return {"deque": [plain(entry) for entry in value], "maxlen": value.maxlen}
        if isinstance(value, tuple):
            return {"tuple": [plain(entry) for entry in value]}
        if isinstance(value, list):
            return [plain(entry) for entry in value]
        if isinstance(value, dict) and all(isinstance(key, str) for key in value):
            return {key: plain(entry) for key, entry in value.items()}
        if isinstance(value, dict):
            return {"map": [[plain(key), plain(entry)] for key, entry in value.items()]}
        return value

    text = json.dumps(plain({"format": FORMAT, "version": VERSION, **tree}))
    members = {f"a{k}": array for k, array in arrays.values()}
    members["tree"] = np.frombuffer(text.encode(), dtype=np.uint8)
    file = io.BytesIO()
    np.savez(file, sha256=_checksum(members), **members)  # type: ignore[arg-type]
    return file.getvalue()


def _checksum(members: Mapping[str, np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
    """Return the SHA-256 of the names, types, shapes and values of arrays, (32,) bytes."""
    digest = hashlib.sha256()
    for name, array in sorted(members.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode() + array.tobytes())
    return np.frombuffer(digest.digest(), dtype=np.uint8)


def unpack(data: bytes) -> dict[str, Any]:
    """Return the tree given to `pack`.

    Raises:
        InputError: the bytes are not a snapshot, one of another version, or edited or damaged.
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise InputError("snapshot", type(data).__name__, f"bytes of a {FORMAT}")
    if bytes(data[:2]) != b"PK" or not zipfile.is_zipfile(io.BytesIO(data)):
        raise InputError("snapshot", "bytes of something else", f"all bytes of a {FORMAT}")
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        tree = json.loads(arrays["tree"].tobytes().decode())
        if tree["format"] != FORMAT:
            raise ValueError(f"the format {tree['format']!r}")
        if tree["version"] != VERSION:
            raise InputError("snapshot: version", repr(tree["version"]), str(VERSION))
        if not np.array_equal(arrays.pop("sha256"), _checksum(arrays)):
            found, fix = "edited or damaged content", "use another snapshot or begin a new stream"
            raise InputError("snapshot", found, "the bytes as they were written", fix)
        return {key: _whole(value, arrays) for key, value in tree.items()}
    except InputError:
        raise
    except Exception as error:  # corrupt bytes may fail anywhere in zip, NumPy or JSON
        found = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError("snapshot", found, f"all bytes of a {FORMAT}") from error


def _whole(value: Any, arrays: dict[str, Any]) -> Any:
    if isinstance(value, list):
        return [_whole(entry, arrays) for entry in value]
    if not isinstance(value, dict):
        return value
    match value:
        case {"array": k}:
            return arrays[f"a{k}"]
        case {"is": name, "has": has}:
            return _rebuilt(_classes()[name], {k: _whole(v, arrays) for k, v in has.items()})
        case {"deque": entries, "maxlen": maxlen}:
            return deque((_whole(entry, arrays) for entry in entries), maxlen=maxlen)
        case {"tuple": entries}:
            return tuple(_whole(entry, arrays) for entry in entries)
        case {"map": entries}:
            return {_whole(key, arrays): _whole(entry, arrays) for key, entry in entries}
    return {key: _whole(entry, arrays) for key, entry in value.items()}


def _rebuilt(kind: type, has: dict[str, Any]) -> Any:
    if issubclass(kind, tuple):
        return kind(**has)
    new = kind.__new__(kind)
    set_state = getattr(new, "__setstate__", vars(new).update)
    set_state(has)
    return new


def check_same(name: str, found: object, expected: object) -> None:
    """Check that a value of a snapshot equals that of this navigator.

    Raises:
        InputError: the values differ; names the first that does.
    """
    if isinstance(found, dict) and isinstance(expected, dict) and found.keys() == expected.keys():
        for key, value in expected.items():
            check_same(f"{name}.{key}", found[key], value)
    elif found != expected:
        remedy = "restore with the same configuration and weights"
        raise InputError(f"snapshot: {name}", repr(found), repr(expected), remedy)
