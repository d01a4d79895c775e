"""Which recordings train, validate and test: the split that figures are compared on."""

from __future__ import annotations

from pathlib import Path

from stario.sequences.errors import InputError

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
