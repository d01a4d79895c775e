"""Checkpoints of a training run, written atomically, and exclusive use of its folder.

Two runs in one folder would overwrite each other's files.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import IO

import safetensors
import safetensors.torch
from torch import Tensor

from stario.network.model import first_mismatch
from stario.network.training.config import TrainingConfig
from stario.network.training.history import EpochReport, History
from stario.sequences.errors import ConfigError, InputError, ReadError
from stario.sequences.files import atomic_write, remove_abandoned


def write_checkpoint(
    path: Path, history: History, material: str, step: int, tensors: Mapping[str, Tensor]
) -> None:
    """Write everything that a run needs to resume.

    Args:
        path: path of the file.
        history: the run's recipe and the reports of its epochs so far.
        material: identifier of the run's recordings and initial weights.
        step: number of steps done.
        tensors: tensors by name.
    """
    metadata = {
        "config": json.dumps(asdict(history.config)),
        "material": material,
        "step": str(step),
        "history": json.dumps([asdict(report) for report in history.reports]),
    }
    whole = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
    with atomic_write(path, "wb") as file:
        file.write(safetensors.torch.save(whole, metadata=metadata))


def read_checkpoint(
    path: Path, config: TrainingConfig, material: str
) -> tuple[int, list[EpochReport], dict[str, Tensor]]:
    """Return the number of steps, the reports of the epochs and the tensors of a run.

    Raises:
        ConfigError: the file belongs to another recipe or to other material.
        ReadError: the file cannot be read.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
        recipe, step = dict(json.loads(metadata["config"])), int(metadata["step"])
        reports = [EpochReport(**report) for report in json.loads(metadata["history"])]
    except (safetensors.SafetensorError, OSError, KeyError, TypeError, ValueError) as error:
        raise damaged(path, error) from error
    for name, expected in json.loads(json.dumps(asdict(config))).items():
        if recipe.get(name) != expected:
            raise ConfigError(
                f"{path}: {name}",
                repr(recipe.get(name)),
                f"{expected!r}, as in this run",
                "resume with the same settings or train into another folder",
            )
    if metadata.get("material") != material:
        raise ConfigError(
            str(path),
            "a run with other recordings or other initial weights",
            "those of this run",
            "resume with the same ones or train into another folder (--out)",
        )
    return step, reports, tensors


def damaged(path: Path, error: Exception) -> ReadError:
    """Return the error of a checkpoint that cannot be used."""
    found = f"{type(error).__name__}: {first_mismatch(error)}"[:120]
    fix = "remove it to train anew, or train into another folder (--out)"
    return ReadError(path, "checkpoint", found, "a complete checkpoint", fix)


LOCK_FILE = ".lock"
"""Stays in the folder: removing it could let two runs lock two files of that name."""

_ABANDONED_S = 600.0
"""Age of temporary files that are removed [s]: without locks, younger ones may be in use."""
_TAKEN = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Create a run's folder and keep other runs out of it within the block.

    The system releases the lock when the process ends, even if it is killed. Where it has none
    (Windows, some network drives), runs are not kept apart. Temporary files that killed runs have
    left are removed.

    Raises:
        ConfigError: another run is using the folder.
        InputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / LOCK_FILE).open("ab")
    except OSError as error:
        found = f"{folder}: {error.strerror or error}"
        raise InputError("folder", found, "a writable folder", "choose another (--out)") from error
    with file:
        _lock(file, folder)
        remove_abandoned(folder, _ABANDONED_S)
        yield


def _lock(file: IO[bytes], folder: Path) -> None:
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _TAKEN:
            return
        raise ConfigError(
            "folder",
            f"{folder}, in which another run is training",
            "a folder for this run alone",
            "wait for that run or train into another folder (--out)",
        ) from error
