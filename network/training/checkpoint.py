"""Checkpoints of a training run: one safetensors file, written atomically."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import safetensors
import safetensors.torch
from torch import Tensor

from stario.network.model import first_mismatch
from stario.network.training.config import TrainingConfig
from stario.sequences.errors import ConfigError, ReadError
from stario.sequences.files import atomic_write


def write_checkpoint(
    path: Path,
    config: TrainingConfig,
    material: str,
    step: int,
    history: list[dict[str, Any]],
    tensors: Mapping[str, Tensor],
) -> None:
    """Write everything that a run needs to resume.

    Args:
        path: path of the file.
        config: the run's recipe.
        material: identifier of the run's recordings and initial weights.
        step: number of steps done.
        history: reports of the epochs so far, as plain values.
        tensors: tensors by name.
    """
    metadata = {
        "config": json.dumps(asdict(config)),
        "material": material,
        "step": str(step),
        "history": json.dumps(history),
    }
    whole = {k: v.detach().cpu().contiguous().clone() for k, v in tensors.items()}
    with atomic_write(path, "wb") as file:
        file.write(safetensors.torch.save(whole, metadata=metadata))


def read_checkpoint(
    path: Path, config: TrainingConfig, material: str
) -> tuple[int, list[dict[str, Any]], dict[str, Tensor]]:
    """Return the number of steps, the history and the tensors of a run.

    Raises:
        ConfigError: the file belongs to another recipe or to other material.
        ReadError: the file cannot be read.
    """
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
    except (safetensors.SafetensorError, OSError) as error:
        raise damaged(path, error) from error
    if "config" not in metadata:
        raise ReadError(path, "checkpoint", "no recipe in it", "a checkpoint of a training run")
    try:
        recipe, history = dict(json.loads(metadata["config"])), json.loads(metadata["history"])
        step = int(metadata["step"])
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(path, error) from error
    _check_same(path, recipe, config)
    if metadata.get("material") != material:
        raise ConfigError(
            str(path),
            "a run with other recordings or other initial weights",
            "those of this run",
            "resume with the same ones or train into another folder (--out)",
        )
    return step, history, tensors


def damaged(path: Path, error: Exception) -> ReadError:
    """Return the error of a checkpoint that cannot be used."""
    found = f"{type(error).__name__}: {first_mismatch(error)}"[:120]
    fix = "remove it to train anew, or train into another folder (--out)"
    return ReadError(path, "checkpoint", found, "a complete checkpoint", fix)


def _check_same(path: Path, found: dict[str, Any], config: TrainingConfig) -> None:
    expected = json.loads(json.dumps(asdict(config)))
    for name in expected:
        if found.get(name) != expected[name]:
            raise ConfigError(
                f"{path}: {name}",
                repr(found.get(name)),
                f"{expected[name]!r}, as in this run",
                "resume with the same settings or train into another folder",
            )
