"""Splits of recordings for training, validation and testing: lists, groups, the paper's split."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stario.sequences.errors import InputError
from stario.sequences.readers.archive import split_name
from stario.sequences.readers.text import read_lines


@dataclass(frozen=True)
class ListEntry:
    """A recording of a list and the group that it belongs to.

    Attributes:
        path: path of the recording.
        group: words from coarse to fine, such as "ilc site2 F1"; empty if the list gives none.
    """

    path: Path
    group: str

    def within(self, group: str) -> bool:
        """Return whether the recording belongs to a group or to a part of it."""
        return f"{self.group} ".startswith(f"{group} ")


def read_list(file: Path, data: Path) -> list[ListEntry]:
    """Read a list of recordings whose names are relative to a data folder.

    Each line is `name` or `name, group`; a name may be that of a recording in an archive,
    `file.h5:name`. Text from `#` on is a comment.

    Raises:
        ReadError: the list cannot be read.
        InputError: a recording of the list does not exist.
    """
    listed = []
    for line in read_lines(file):
        name, _, group = (part.strip() for part in line.split("#")[0].partition(","))
        if not name:
            continue
        path = data / name
        if not split_name(path)[0].exists():
            expected = f"a recording of {file.name}"
            fix = "set the data folder: --data (examples/guides/data.md)"
            raise InputError(str(path), "no such file", expected, fix)
        listed.append(ListEntry(path, group))
    return listed


def hold_out_group(
    recordings: Iterable[ListEntry], group: str
) -> tuple[list[ListEntry], list[ListEntry]]:
    """Return the recordings outside a group, for training, and those within it, for evaluation.

    Raises:
        InputError: the group contains no recording, or all of them.
    """
    known = list(recordings)
    outside = [entry for entry in known if not entry.within(group)]
    inside = [entry for entry in known if entry.within(group)]
    if not inside or not outside:
        groups = ", ".join(sorted({entry.group for entry in known}))
        raise InputError("group", repr(group), f"a prefix of some, but not all, of {groups}")
    return outside, inside


@dataclass(frozen=True)
class Split:
    """Recordings for training, for early stopping and for testing, each in sorted order."""

    training: tuple[Path, ...]
    validation: tuple[Path, ...]
    test: tuple[Path, ...]


def random_split(recordings: Iterable[Path], seed: int) -> Split:
    """Split whole recordings at random 8:1:1, as the paper does.

    The same recordings and seed give the same split, whatever their order. With three recordings
    or more no part is empty.

    Raises:
        InputError: there are fewer than three recordings.
    """
    known = sorted(set(recordings))
    if len(known) < 3:
        raise InputError("recordings", str(len(known)), "at least 3 to split")
    order = np.random.default_rng(seed).permutation(len(known))
    each = max(1, round(len(known) / 10))
    parts = order[2 * each :], order[:each], order[each : 2 * each]
    return Split(*(tuple(known[k] for k in sorted(part)) for part in parts))
