"""Lists of recordings in the package: names below a data folder, with the group of each.

`test` and `validation` are of the development recordings; `training` are the 36 minutes of the
first weights; `holdout` are the people, devices and places that judge weights trained on the rest
of `all`; `open` are those of `all` whose licence allows any use.
"""

from __future__ import annotations

import importlib.resources
from pathlib import Path

from stario.sequences.datasets.splits import Listed, read_list
from stario.sequences.errors import InputError

NAMES = ("test", "validation", "training", "holdout", "all", "open")


def listed(name: str, data: Path) -> list[Listed]:
    """The recordings of a list of the package, or of one's own.

    Args:
        name: one of `NAMES`, or a list file: `name, group` on each line.
        data: folder that the names count from.

    Raises:
        InputError: there is no such list, or one of its recordings is not there.
    """
    if Path(name).is_file():
        return read_list(Path(name), data)
    if name not in NAMES:
        raise InputError("split", repr(name), f"one of {', '.join(NAMES)}, or a list file")
    folder = importlib.resources.files("stario.network.training.splits")
    return read_list(Path(str(folder.joinpath(f"{name}.txt"))), data)


def split_paths(data: Path, split: str) -> list[Path]:
    """Paths of the recordings of a list of the package; arguments and errors as of `listed`."""
    return [one.path for one in listed(split, data)]
