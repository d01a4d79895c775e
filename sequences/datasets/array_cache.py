"""Disk cache of arrays: built once, then memory-mapped, so that they need no memory.

A file holds several parts, such as the unbroken stretches of a recording, in the layout of
safetensors: a header, then the numbers of all parts. It gets its name only when it is complete: a
killed writer leaves nothing that would be read, and if two write at once, the second replaces the
first's file by the same content. The folder may be deleted at any time.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray

from stario.sequences.datasets.cache_files import remove_unused
from stario.sequences.errors import InputError
from stario.sequences.files import atomic_write, remove_abandoned

log = logging.getLogger(__name__)

Part = tuple[dict[str, Any], dict[str, NDArray[Any]]]
"""Plain values, and arrays by name; all parts of a file have arrays of the same names."""

Built = TypeVar("Built")

_ABANDONED_S = 3600.0


def kept(
    file: Path, build: Callable[[], Built], parts_of: Callable[[Built], Sequence[Part]]
) -> Built | None:
    """Build what a file lacks and write it there; return it if it could not be, None if it was."""
    if read_parts(file) is not None:
        return None
    built = build()
    return None if write_parts(file, parts_of(built)) else built


def write_parts(file: Path, parts: Sequence[Part]) -> bool:
    """Write parts to the cache; return False, with a warning, if they cannot be written."""
    if not parts:
        return False
    tables = [arrays for _, arrays in parts]
    rows = [{name: len(array) for name, array in table.items()} for table in tables]
    metadata = [{**values, "rows": counts} for (values, _), counts in zip(parts, rows, strict=True)]
    content = safetensors.numpy.save(
        {name: np.concatenate([table[name] for table in tables]) for name in tables[0]},
        metadata={"parts": json.dumps(metadata)},
    )
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        remove_abandoned(file.parent, _ABANDONED_S, file.name)
        remove_unused(file.parent)
        with atomic_write(file, "wb") as target:
            target.write(content)
    except (OSError, InputError) as error:
        log.warning("%s: windows are not kept for the next run: %s", file.parent, error)
        return False
    return True


def read_parts(file: Path) -> list[Part] | None:
    """Return the parts, memory-mapped, or None if the file is missing or incomplete."""
    try:
        mapped = np.memmap(file, dtype=np.uint8, mode="r")  # once: each map keeps a file open
        begin = 8 + int.from_bytes(mapped[:8].tobytes(), "little")
        header = json.loads(mapped[8:begin].tobytes())
        metadata = json.loads(header.pop("__metadata__")["parts"])
        if len(mapped) != begin + max(tensor["data_offsets"][1] for tensor in header.values()):
            raise ValueError(f"{len(mapped)} bytes")
        whole = {name: _array(mapped[begin:], tensor) for name, tensor in header.items()}
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError) as error:
        log.warning("%s: incomplete, will be rebuilt: %s", file, error)
        return None
    first = dict.fromkeys(whole, 0)
    parts: list[Part] = []
    for values in metadata:
        arrays = {}
        for name, rows in values.pop("rows").items():
            arrays[name] = whole[name][first[name] : first[name] + rows]
            first[name] += rows
        parts.append((values, arrays))
    return parts


def _array(content: NDArray[np.uint8], tensor: Mapping[str, Any]) -> NDArray[Any]:
    begin, stop = tensor["data_offsets"]
    dtype = {"F32": "<f4", "F64": "<f8", "I64": "<i8", "C64": "<c8"}[tensor["dtype"]]
    return np.asarray(content[begin:stop].view(dtype).reshape(tensor["shape"]))
