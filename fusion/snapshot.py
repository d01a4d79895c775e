"""Snapshots of a stream as bytes, without pickle, to continue it in another process.

Format: a line with `FORMAT` and `VERSION`, the SHA-256 of the rest, and an npz. Its `tree` is
the JSON of the stream's parts (`Stream.parts`), of its back end, configuration and weights, in
which `{"array": k}` stands for its array `k`, and other objects for a sequence, a dictionary or an
instance of a class of `_PACKAGES` and `_MODULES`. Arrays and numbers keep every bit, so the
continued stream gives the same states.
"""

from __future__ import annotations

import hashlib
import importlib
import io
import json
import pkgutil
from collections import deque
from functools import cache
from typing import Any

import numpy as np

from stario.sequences.errors import InputError

FORMAT, VERSION = "stario snapshot", 43

_PACKAGES = ("fusion.filter", "fusion.graph", "fusion.imu")
_MODULES = """
fusion.values.config fusion.values.fixes fusion.values.health fusion.values.state
sequences.attitude.levelling sequences.noise
"""
"""Packages and modules whose classes a snapshot may hold: plain data, rebuilt from attributes."""


Arrays = dict[int, tuple[int, np.ndarray[Any, Any]]]
"""Numbered arrays by identity, since states share those that are unchanged."""


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
    arrays: Arrays = {}
    text = json.dumps(plain(tree, arrays))
    members = {str(k): array for k, array in arrays.values()}
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, tree=np.frombuffer(text.encode(), np.uint8), **members)
    content = file.getvalue()
    head = f"{FORMAT} {VERSION}\n".encode()
    return head + hashlib.sha256(content).digest() + content


def plain(value: Any, arrays: Arrays) -> Any:
    """Return a value for JSON; add its arrays to `arrays`."""

    def each(values: Any) -> list[Any]:
        return [plain(entry, arrays) for entry in values]

    if isinstance(value, np.ndarray):
        return {"array": arrays.setdefault(id(value), (len(arrays), value))[0]}
    if isinstance(value, np.generic):
        return value.item()
    if type(value).__name__ in _classes():
        has = value._asdict() if hasattr(value, "_asdict") else value.__getstate__()
        return {"is": type(value).__name__, "has": plain(has, arrays)}
    if isinstance(value, dict):
        return {"map": [each(item) for item in value.items()]}
    if isinstance(value, deque):
        return {"deque": each(value), "maxlen": value.maxlen}
    if isinstance(value, tuple):
        return {"tuple": each(value)}
    return each(value) if isinstance(value, list) else value


def unpack(data: bytes) -> dict[str, Any]:
    """Return the tree given to `pack`.

    Raises:
        InputError: the bytes are not a snapshot, one of another version, or edited or damaged.
    """
    if not isinstance(data, bytes | bytearray | memoryview):
        raise InputError("snapshot", type(data).__name__, f"bytes of a {FORMAT}")
    head, _, rest = bytes(data).partition(b"\n")
    name, _, version = head.rpartition(b" ")
    if name != FORMAT.encode():
        raise InputError("snapshot", "bytes of something else", f"all bytes of a {FORMAT}")
    if version != str(VERSION).encode():
        raise InputError("snapshot: version", version.decode(errors="replace"), str(VERSION))
    digest, content = rest[:32], rest[32:]
    if digest != hashlib.sha256(content).digest():
        found, fix = "edited or damaged content", "use another snapshot or begin a new stream"
        raise InputError("snapshot", found, "the bytes as they were written", fix)
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = dict(file)
    tree: dict[str, Any] = _whole(json.loads(arrays["tree"].tobytes()), arrays)
    return tree


def _whole(value: Any, arrays: dict[str, Any]) -> Any:
    def each(values: Any) -> list[Any]:
        return [_whole(entry, arrays) for entry in values]

    match value:
        case list():
            return each(value)
        case {"array": k}:
            return arrays[str(k)]
        case {"is": name, "has": has}:
            return _rebuilt(_classes()[name], _whole(has, arrays))
        case {"map": entries}:
            return dict(each(entries))
        case {"deque": entries, "maxlen": maxlen}:
            return deque(each(entries), maxlen)
        case {"tuple": entries}:
            return tuple(each(entries))
    return value


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
