"""Packaged lists of recordings: names below a data folder, each with its group.

`test` and `validation` list development recordings; `training` the 36 minutes of the first
weights; `holdout` the people, devices and places used to evaluate weights trained on the rest of
`all`; `open` those of `all` whose licence allows any use.
"""

from __future__ import annotations

import importlib.resources
from collections.abc import Iterable
from pathlib import Path

from stario.sequences.datasets.splits import ListEntry, read_list
from stario.sequences.errors import InputError

NAMES = ("test", "validation", "training", "holdout", "all", "open")


def read_packaged_list(name: str, data: Path) -> list[ListEntry]:
    """Return the recordings of a packaged list or of a list file.

    Args:
        name: one of `NAMES`, or a list file with `name, group` on each line.
        data: folder that the names are relative to.

    Raises:
        InputError: there is no such list, or one of its recordings is missing.
    """
    if Path(name).is_file():
        return read_list(Path(name), data)
    if name not in NAMES:
        raise InputError("split", repr(name), f"one of {', '.join(NAMES)}, or a list file")
    folder = importlib.resources.files("stario.network.training.splits")
    return read_list(Path(str(folder.joinpath(f"{name}.txt"))), data)


def without_holdout(
    recordings: Iterable[ListEntry], data: Path
) -> tuple[list[ListEntry], list[ListEntry]]:
    """Return the recordings outside the list `holdout`, and those on it.

    Raises:
        InputError: a recording of that list is missing.
    """
    known = list(recordings)
    held_out = {entry.path for entry in read_packaged_list("holdout", data)}
    outside = [entry for entry in known if entry.path not in held_out]
    return outside, [entry for entry in known if entry.path in held_out]
