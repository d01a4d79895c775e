"""Checkpoints of a training run: one safetensors file, written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from torch import Tensor

from stario.network.recipe import TrainingConfig
from stario.sequences.errors import ConfigError, ReadError
from stario.sequences.files import atomic_write


def write_checkpoint(
    path: Path,
    config: TrainingConfig,
    step: int,
    history: list[dict[str, Any]],
    tensors: Mapping[str, Tensor],
) -> None:
    """Write everything that a run needs to go on.

    Args:
        path: of the file.
        config: the run's recipe.
        step: steps done.
        history: reports of the epochs so far, as plain values.
        tensors: by name.
    """
    metadata = {
        "config": json.dumps(asdict(config)),
        "step": str(step),
        "history": json.dumps(history),
    }
    whole = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
    with atomic_write(path, "wb") as file:
        file.write(safetensors.torch.save(whole, metadata=metadata))


def read_checkpoint(
    path: Path, config: TrainingConfig
) -> tuple[int, list[dict[str, Any]], dict[str, Tensor]]:
    """The steps done, the history and the tensors of a run with this recipe.

    Raises:
        ConfigError: the file was written by another recipe.
        ReadError: it cannot be read.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata()
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except safetensors.SafetensorError as error:
        raise ReadError(path, "checkpoint", str(error), "a whole checkpoint") from error
    if not metadata or "config" not in metadata:
        raise ReadError(path, "checkpoint", "no recipe in it", "a checkpoint of this command")
    _check_same(path, json.loads(metadata["config"]), config)
    return int(metadata["step"]), json.loads(metadata["history"]), tensors


def _check_same(path: Path, found: dict[str, Any], config: TrainingConfig) -> None:
    expected = json.loads(json.dumps(asdict(config)))
    # Checkpoints older than this setting are of runs without it.
    found = {"successive": 1, **found}
    for name in expected:
        if found.get(name) != expected[name]:
            raise ConfigError(
                f"{path}: {name}",
                repr(found.get(name)),
                f"{expected[name]!r} as in this run",
                "resume with the same settings or train into another folder",
            )
