"""Packaged lists of recordings: names below a data folder, each with its group.

`test` and `validation` list development recordings; `training` the 36 minutes of the first
weights; `holdout` the people, devices and places used to evaluate weights trained on the rest of
`all`; `open` those of `all` whose licence allows any use.
"""

from __future__ import annotations

import importlib.resources
import logging
from collections.abc import Iterable
from pathlib import Path

from stario.sequences.datasets.splits import ListEntry, read_list
from stario.sequences.errors import InputError

log = logging.getLogger(__name__)

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


def learned_from(data: Path) -> dict[str, frozenset[Path]]:
    """Return the recordings that the packaged weights were trained on, by the weights' name.

    Raises:
        InputError: a recording of the packaged lists is missing.
    """
    everything = read_packaged_list("all", data)
    learned = {
        "default": everything,
        "first-stage": without_holdout(everything, data)[0],
        "open": without_holdout(read_packaged_list("open", data), data)[0],
        "walks-36min": [e for n in ("training", "validation") for e in read_packaged_list(n, data)],
    }
    return {name: frozenset(e.path for e in entries) for name, entries in learned.items()}


def warn_of_learned(weights: Iterable[str], judging: Iterable[Path], data: Path) -> None:
    """Log a warning for packaged weights that were trained on recordings that are to judge them.

    Args:
        weights: names of weights; files are of unknown origin.
        judging: recordings of a data folder that errors or sigma will be taken from.
        data: that folder; without all recordings of the packaged lists, nothing is known.
    """
    try:
        learned = learned_from(data)
    except InputError:
        return
    known = frozenset(judging)
    for name in weights:
        if both := known & learned.get(name, frozenset()):
            log.warning(
                "%s: trained on %d of the %d recordings that judge it: its errors on others are "
                "larger; first-stage and open were trained without the list holdout",
                name, len(both), len(known),
            )  # fmt: skip
