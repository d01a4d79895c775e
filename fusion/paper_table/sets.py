"""The data sets of the table: split into training, validation and test; the paper's errors."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from stario.network.architectures import ARCHITECTURES
from stario.network.training.splits import read_packaged_list, without_holdout
from stario.sequences.arrays import check_choice, evenly_spaced
from stario.sequences.datasets.splits import ListEntry, random_split
from stario.sequences.readers import find_recordings

ALL = "all"
"""All development recordings together, with the groups of the list `holdout` held out."""

FIRST = ("oxiod", "ridi", ALL)
"""The sets that are completed first."""

_SETS: dict[str, tuple[str, tuple[str, ...]]] = {
    "oxiod": ("OxIOD", ("oxiod",)),
    "ridi": ("RIDI", ("ridi",)),
    ALL: ("All together, held out by group", ()),
    "tyrex": ("tyrex", ("tyrex",)),
    "kipd": ("KIPD and rfbr", ("kipd", "rfbr")),
    "ilc": ("Indoor Location", ("ilc",)),
}
"""Title of each set, and the first words of its recordings' groups; the most important first."""

Key = TypeVar("Key")

_VALIDATION_SHARE = 0.05
"""Share of each set's walks outside the held-out groups that is used for validation."""


@dataclass(frozen=True)
class DataSet:
    """One set of the table.

    Attributes:
        name: short name, also of its folder.
        training: recordings to train on.
        validation: recordings that select a run's epoch and calibrate sigma.
        test: recordings that the table reports on, each with its group, which begins with its
            set; sets, and the groups of a set, have equal weights.
        words: description of the split.
    """

    name: str
    training: tuple[Path, ...]
    validation: tuple[Path, ...]
    test: tuple[ListEntry, ...]
    words: str

    @property
    def title(self) -> str:
        """Title for readers."""
        return _SETS[self.name][0] if self.name in _SETS else self.name


def development_sets(
    data: Path, seed: int, per_group: int, chosen: Sequence[str] | None = None
) -> list[DataSet]:
    """Return the sets among the development recordings, the most important first.

    All of them, or those `chosen` by name, split with a seed; `ALL` has at most `per_group` test
    recordings of a group.

    Raises:
        InputError: a name is unknown, or a recording of the packaged lists is missing.
    """
    for name in chosen or ():
        check_choice("--sets", name, _SETS)
    recordings = read_packaged_list("all", data) + read_packaged_list("test", data)
    return [
        _combined(data, seed, per_group)
        if name == ALL
        else _split(name, [entry for entry in recordings if set_of(entry) in words], seed)
        for name, (_, words) in _SETS.items()
        if chosen is None or name in chosen
    ]


def folder_set(name: str, folder: Path, seed: int) -> DataSet:
    """Return a published data set from its folder, split 8:1:1.

    Raises:
        InputError: it has fewer than three recordings.
        ReadError: it cannot be read.
    """
    return _split(name, [ListEntry(path, name) for path in find_recordings(folder)], seed)


def _split(name: str, recordings: Sequence[ListEntry], seed: int) -> DataSet:
    """Apply the paper's split, by walks: two phones on one walk stay together."""
    walks = _by(recordings, _walk)
    split = random_split(walks, seed)

    def members(part: tuple[Path, ...]) -> list[ListEntry]:
        return [entry for walk in part for entry in walks[walk]]

    return DataSet(
        name,
        tuple(entry.path for entry in members(split.training)),
        tuple(entry.path for entry in members(split.validation)),
        tuple(members(split.test)),
        f"random 8:1:1 split by recording, seed {seed}",
    )


def _walk(entry: ListEntry) -> Path:
    """Return the walk: KIPD's S9 and S20 recordings of one name are two phones on one walk."""
    return entry.path.with_name(re.sub(r"(?<=\w)S(9|20)$", "", entry.path.name))


def _combined(data: Path, seed: int, per_group: int) -> DataSet:
    """Combine all sets, tested on people, devices and places unseen in training."""
    outside, held_out = without_holdout(read_packaged_list("all", data), data)
    rng = np.random.default_rng(seed)
    validation = set()
    for members in _by(outside, set_of).values():
        walks = list(_by(members, _walk).values())
        count = max(1, round(_VALIDATION_SHARE * len(walks)))
        chosen = rng.permutation(len(walks))[:count]
        validation |= {entry.path for k in chosen for entry in walks[k]}
    test = [
        entry
        for members in _by(held_out, lambda entry: entry.group).values()
        for entry in (members[k] for k in evenly_spaced(len(members), per_group))
    ]
    return DataSet(
        ALL,
        tuple(entry.path for entry in outside if entry.path not in validation),
        tuple(entry.path for entry in outside if entry.path in validation),
        tuple(test),
        f"tested on people, devices and places of the list `holdout`, at most {per_group} "
        f"recordings of each; validated on a random {_VALIDATION_SHARE:.0%} of each set's other "
        f"walks, seed {seed}",
    )


def set_of(entry: ListEntry) -> str:
    """Return the set that a recording belongs to: the first word of its group."""
    return entry.group.split(" ")[0]


def _by(
    recordings: Iterable[ListEntry], key: Callable[[ListEntry], Key]
) -> dict[Key, list[ListEntry]]:
    parts: dict[Key, list[ListEntry]] = {}
    for entry in recordings:
        parts.setdefault(key(entry), []).append(entry)
    return parts


_PUBLISHED = {
    "ronin": (
        (4.165, 8.103, 4.781, 4.755, 4.883, 4.077, 4.629, 4.374, 5.805, 4.471, 3.948),
        (3.724, 4.836, 3.705, 3.736, 3.713, 3.572, 3.681, 3.665, 4.276, 3.572, 3.554),
    ),
    "ridi": (
        (2.080, 3.839, 2.103, 2.486, 2.500, 2.290, 2.379, 2.047, 2.563, 2.118, 2.033),
        (2.383, 3.589, 2.445, 2.644, 2.584, 2.573, 2.406, 2.395, 2.929, 2.446, 2.274),
    ),
    "rnin": (
        (1.844, 3.182, 1.605, 2.174, 3.119, 3.142, 2.648, 2.478, 2.428, 1.250, 1.455),
        (1.836, 3.726, 1.593, 2.114, 1.568, 1.842, 1.613, 1.499, 1.979, 1.213, 1.370),
    ),
    "imunet": (
        (6.428, 8.108, 6.445, 9.130, 6.846, 8.593, 6.479, 6.918, 10.240, 6.577, 4.964),
        (4.802, 6.381, 4.463, 6.404, 4.809, 5.609, 4.458, 5.638, 5.735, 4.601, 3.815),
    ),
    "tlio": (
        (1.333, 2.145, 1.300, 1.354, 1.369, 1.373, 1.724, 1.258, 1.832, 1.254, 1.108),
        (3.705, 3.685, 3.627, 4.060, 0.842, 0.806, 0.959, 0.818, 5.162, 3.525, 3.145),
    ),
    "oxiod": (
        (4.336, 7.282, 2.780, 2.325, 2.381, 2.163, 1.982, 1.696, 3.855, 1.502, 1.484),
        (1.595, 2.301, 1.082, 1.135, 1.142, 1.103, 0.979, 1.100, 1.270, 0.878, 0.856),
    ),
}
"""ATE and RTE [m] published in the paper, by data set, in the order of `ARCHITECTURES`."""


def published(dataset: str, network: str) -> tuple[float, float] | None:
    """Return ATE and RTE [m] from the paper; None if it gives none."""
    if dataset not in _PUBLISHED or network not in ARCHITECTURES:
        return None
    ate, rte = _PUBLISHED[dataset]
    column = list(ARCHITECTURES).index(network)
    return ate[column], rte[column]
