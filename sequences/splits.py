"""Which recordings train, validate and test: here, in the paper, by the data sets' own lists."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stario.sequences.errors import InputError, ReadError

TEST = (
    "oxiod/handheld/data1/syn/imu3.csv",
    "oxiod/multi users/user2/syn/imu5.csv",
    "oxiod/trolley/data2/syn/imu5.csv",
    "tumvi/dataset-room4_512_16",
)
"""Test recordings, in the order of every table; nothing is ever tuned on them."""

VALIDATION = (
    "oxiod/handheld/data1/syn/imu7.csv",
    "oxiod/multi users/user2/syn/imu4.csv",
    "oxiod/trolley/data2/syn/imu1.csv",
    "tumvi/dataset-room3_512_16",
)
"""Recordings kept from training: early stop, calibration of the covariance."""

TRAINING = (
    "oxiod/handheld/data1/syn/imu2.csv",
    "oxiod/multi users/user2/syn/imu6.csv",
    "oxiod/trolley/data1/syn/imu7.csv",
    "oxiod/trolley/data2/syn/imu2.csv",
    "oxiod/trolley/data2/syn/imu3.csv",
    "oxiod/trolley/data2/syn/imu4.csv",
    "tumvi/dataset-room1_512_16",
    "tumvi/dataset-room2_512_16",
)

_SPLITS = {"test": TEST, "validation": VALIDATION, "training": TRAINING}

OFFICIAL: dict[str, dict[str, str]] = {
    "ronin": {
        "training": "list_train.txt",
        "validation": "list_val.txt",
        "test_seen": "list_test_seen.txt",
        "test_unseen": "list_test_unseen.txt",
    },
    "ridi": {"training": "list_train_publish_v2.txt", "test": "list_test_publish_v2.txt"},
    "imunet": {"training": "list_train.txt", "test": "list_test.txt"},
    "tlio": {
        "training": "train_list.txt",
        "validation": "val_list.txt",
        "test": "test_list.txt",
    },
    "oxiod": {"training": "Train.txt", "test": "Test.txt"},
    "rnin": {"training": "data_train", "validation": "data_val", "test": "data_test"},
}
"""Each data set's parts and the list (or, of RNIN, the folder) that names their recordings."""

_PAPER_SHARES = (8, 1, 1)


def split_paths(data: Path, split: str) -> list[Path]:
    """Paths of a split's recordings under the data folder.

    Raises:
        InputError: the split is unknown or one of its recordings is not there.
    """
    if split not in _SPLITS:
        raise InputError("split", repr(split), f"one of {', '.join(_SPLITS)}")
    paths = [data / name for name in _SPLITS[split]]
    for path in paths:
        if not path.exists():
            raise InputError(
                str(path),
                "nothing there",
                "the development recordings",
                "name their folder: --data",
            )
    return paths


@dataclass(frozen=True)
class Split:
    """Recordings to train on, to stop early by, and to test on; each in sorted order."""

    training: tuple[Path, ...]
    validation: tuple[Path, ...]
    test: tuple[Path, ...]


def random_split(recordings: Iterable[Path], seed: int) -> Split:
    """The paper's split: at random, 8:1:1, by whole recordings.

    The same recordings and seed give the same split, in whatever order they come. With three
    recordings or more no part is empty.

    Raises:
        InputError: there are fewer than three recordings.
    """
    known = sorted(set(recordings))
    if len(known) < 3:
        raise InputError("recordings", str(len(known)), "at least 3 to split")
    order = np.random.default_rng(seed).permutation(len(known))
    each = max(1, round(len(known) * _PAPER_SHARES[1] / sum(_PAPER_SHARES)))
    parts = order[2 * each :], order[:each], order[each : 2 * each]
    return Split(*(tuple(known[k] for k in sorted(part)) for part in parts))


def official_split(
    dataset: str,
    root: Path,
    part: str,
    on_error: Callable[[ReadError], None] | None = None,
) -> list[Path]:
    """The recordings that a data set's own list names for a part.

    The list is looked for in the root and in the folders in it (`lists/`, OxIOD's carriages, of
    which each has its own).

    Args:
        dataset: a name in `OFFICIAL`.
        root: the data set's folder.
        part: one of the data set's parts in `OFFICIAL`.
        on_error: called for each entry that is empty or not there, as in `find_recordings`;
            without it such an entry is raised.

    Raises:
        InputError: data set or part is unknown.
        ReadError: there is no list, or an entry is wrong.
    """
    from stario.sequences.readers import find_recordings

    if dataset not in OFFICIAL:
        raise InputError("data set", repr(dataset), f"one of {', '.join(OFFICIAL)}")
    if part not in OFFICIAL[dataset]:
        raise InputError(f"{dataset}'s part", repr(part), f"one of {', '.join(OFFICIAL[dataset])}")
    name = OFFICIAL[dataset][part]
    lists = [root / name] if (root / name).exists() else sorted(root.glob(f"*/{name}"))
    if not lists:
        raise ReadError(root, name, "no such list", "in the folder or one below")
    return [path for one in lists for path in find_recordings(one, on_error)]
