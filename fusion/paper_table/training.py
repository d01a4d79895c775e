"""Training of a run: one recipe and number of steps for all networks, resumable."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from stario.fusion.paper_table.sets import DataSet
from stario.network.training.config import TrainingConfig, training_config
from stario.network.training.data import (
    RecordingStreams,
    mix_sources,
    recording_streams,
    validation_data,
)
from stario.network.training.history import EpochReport, History
from stario.network.training.made import cached_walks
from stario.network.training.train import train
from stario.sequences.datasets.batch import Skipped
from stario.sequences.datasets.stream_cache import recorded, recording_stamps
from stario.sequences.files import write_json
from stario.sequences.sequence import ImuSequence
from stario.sequences.windows import WINDOW_SAMPLES, Attitude

_EPOCH_STEPS = 250
"""Maximum steps between two checkpoints: what an interrupted run loses."""

_VALIDATION_SAMPLES = 60 * WINDOW_SAMPLES
"""Maximum samples of each validation stretch: all are evaluated after every epoch."""

TEMPORARY_FILES = ("checkpoint.safetensors", "clock.json")
"""Files of a training run that are not needed once its result is recorded."""

_WALKS, _VALIDATION_WALKS = 40, 8
"""Simulated walks for training and validation windows where no recording has poses: the same for
every run, so that only the networks differ."""


@dataclass(frozen=True)
class ReaderConfig:
    """How recordings are read, on any machine that works on a run; told apart by the cache alone.

    Attributes:
        read: function that reads the recording at a path; must be picklable.
        options: what `read` depends on besides the path, as plain values.
        cache: folder that caches windows for later runs.
    """

    read: Callable[[Path], ImuSequence] = field(compare=False)
    options: dict[str, object] = field(compare=False)
    cache: Path


def run_recipe(
    values: dict[str, object], network: str, seed: int, steps: int | None
) -> TrainingConfig:
    """Return the recipe of a run: the common values with a network, a seed and a number of steps.

    It is approximate, since epochs have equal lengths; None for the common recipe's.

    Raises:
        ConfigError: a setting is unknown or out of range.
    """
    recipe = training_config({**values, "architecture": network, "seed": seed})
    steps = recipe.steps if steps is None else steps
    epochs = max(1, math.ceil(steps / _EPOCH_STEPS))
    per_epoch = max(1, round(steps / epochs))
    lengths = {"epochs": epochs, "epoch_windows": per_epoch * recipe.batch, "patience": epochs}
    return training_config({**values, "architecture": network, "seed": seed, **lengths})


def train_run(
    dataset: DataSet, recipe: TrainingConfig, folder: Path, reading: ReaderConfig
) -> dict[str, object]:
    """Train a run's network, resuming from its checkpoint; write the model and `TEMPORARY_FILES`.

    Returns:
        Plain values: training error of the last epoch and validation error of the best one, whose
        weights are kept [m^2], number of steps, windows per second, computing time over all
        processes that continued the run in turn [s], the recipe, and the skipped recordings.

    Raises:
        InputError, ConfigError: as for `stario.network.training.train.train`.
    """
    streams, skipped = _streams(dataset.training, recipe.attitude, reading)
    held_out, missing = _streams(dataset.validation, recipe.attitude, reading)
    simulated = partial(cached_walks, folder=reading.cache, attitude=recipe.attitude)
    walks = [] if any(recording.has_poses for recording in streams) else simulated(_WALKS, 0)
    data = mix_sources(streams, walks, recipe.shares, recipe.reach)
    validation = validation_data(held_out, partial(simulated, _VALIDATION_WALKS, 1))
    began, clock = process_time(), folder / TEMPORARY_FILES[1]
    before = float(json.loads(clock.read_text())) if clock.exists() else 0.0  # of killed processes
    train(
        recipe,
        data,
        replace(validation, streams=[s.part(0, _VALIDATION_SAMPLES) for s in validation.streams]),
        folder,
        on_epoch=lambda report: write_json(clock, before + process_time() - began),
    )
    rows: list[dict[str, Any]] = json.loads((folder / "log.json").read_text(encoding="utf-8"))
    for row in rows:  # in JSON, errors that are not finite are null
        row.update({name: math.nan for name, value in row.items() if value is None})
    reports = [EpochReport(**row) for row in rows]
    return {
        "steps": recipe.steps,
        "windows_per_s": float(np.mean([report.windows_per_second for report in reports])),
        "seconds": before + process_time() - began,
        "training_error_m2": reports[-1].training_error,
        "validation_error_m2": History(recipe, reports).best().validation_error,
        "recipe": asdict(recipe),
        "skipped": [asdict(failure) for failure in skipped + missing],
    }


def recipe_digest(recipe: TrainingConfig, dataset: DataSet) -> str:
    """Return the digest of everything that a run's training depends on except the code."""
    inputs = [
        asdict(recipe),
        [[*map(recording_state, part)] for part in (dataset.training, dataset.validation)],
    ]
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()


def recording_state(path: Path) -> list[object]:
    """Return a recording's path and the stamps of its files, which tell that it has changed."""
    return [str(path), *recording_stamps(path)]


@lru_cache(maxsize=2)  # training and validation part of the set that runs are completed for
def _streams(
    files: tuple[Path, ...], attitude: Attitude, reading: ReaderConfig
) -> tuple[list[RecordingStreams], list[Skipped]]:
    """Return the streams of each recording; later runs of the same set reuse them."""
    outcomes = recorded(files, reading.read, reading.options, reading.cache, 1, attitude)
    return recording_streams(zip(files, outcomes, strict=True))
