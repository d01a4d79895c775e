"""A cell's training: one recipe, as many steps for every network, resumed from its checkpoint."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from time import process_time

from stario.fusion.table.sets import DataSet
from stario.network.training.config import TrainingConfig, training_config
from stario.network.training.data import Recorded, cached_walks, gather
from stario.network.training.run import EpochReport
from stario.network.training.train import train
from stario.sequences.datasets.batch import Skipped
from stario.sequences.datasets.stream_cache import recorded
from stario.sequences.files import write_json
from stario.sequences.sequence import ImuSequence
from stario.sequences.windows import WINDOW_SAMPLES, WorldStream

_EPOCH_STEPS = 250
"""Most steps between two checkpoints: what a killed run loses."""

_VALIDATION_SAMPLES = 60 * WINDOW_SAMPLES
"""Most of each stretch that validates: all are asked after every epoch."""

SPARE = ("checkpoint.safetensors", "clock.json")
"""Files of a training that nobody needs once its end is noted."""

_WALKS, _VALIDATION_WALKS = 40, 8
"""Simulated walks that teach and test windows where no recording has poses: alike for every cell,
since what differs are the networks."""


@dataclass(frozen=True)
class Reading:
    """How recordings are read, on whatever machine a cell is filled.

    Attributes:
        read: a path's recording; can be pickled.
        options: what it depends on besides the path, as plain values.
        cache: folder that keeps windows for the next cell.
    """

    read: Callable[[Path], ImuSequence]
    options: dict[str, object]
    cache: Path


def cell_recipe(
    values: dict[str, object], network: str, seed: int, steps: int | None
) -> TrainingConfig:
    """The recipe of a cell: the common one with a network, a seed and a number of steps.

    Args:
        values: settings in common, as of a parsed JSON file.
        network: name of the architecture.
        seed: of initial weights and draws.
        steps: about so many, in epochs of equal length; None for the common recipe's.

    Raises:
        ConfigError: a setting is unknown or out of range.
    """
    recipe = training_config({**values, "architecture": network, "seed": seed})
    steps = recipe.steps if steps is None else steps
    epochs = max(1, math.ceil(steps / _EPOCH_STEPS))
    per_epoch = max(1, round(steps / epochs))
    timed = {"epochs": epochs, "epoch_windows": per_epoch * recipe.batch, "patience": epochs}
    return training_config({**values, "architecture": network, "seed": seed, **timed})


def train_cell(
    dataset: DataSet, recipe: TrainingConfig, folder: Path, reading: Reading
) -> dict[str, object]:
    """Train a cell's network, from its checkpoint on; the folder receives the model and `SPARE`.

    Returns:
        Plain values: errors of the last epoch [m^2], steps, windows in each, seconds of computing
        time, of a step's in the mean, the recipe, and the recordings that could not be used.

    Raises:
        InputError, ConfigError: as of `stario.network.training.train.train`.
    """
    streams, skipped = _streams(dataset.training, recipe, reading)
    held_out, missing = _streams(dataset.validation, recipe, reading)
    simulated = partial(cached_walks, folder=reading.cache, attitude=recipe.attitude)
    poses = any(isinstance(s, WorldStream) for one in streams for s in one.streams)
    material = gather(streams, [] if poses else simulated(_WALKS, 0), reach=recipe.reach)
    kept = gather(held_out, [])
    clock = _Clock(folder / SPARE[1])

    def finished(report: EpochReport) -> None:
        clock.keep()
        clock.pause()

    train(
        recipe,
        material.streams,
        material.weights,
        [s.part(0, _VALIDATION_SAMPLES) for s in kept.streams] or simulated(_VALIDATION_WALKS, 1),
        folder,
        on_step=lambda step, error: clock.step(),
        on_epoch=finished,
        trained_on=material.words,
        legs=material.legs,
        validation_legs=kept.legs,
        chosen_by_legs=not kept.streams,
    )
    clock.keep()
    history = json.loads((folder / "log.json").read_text(encoding="utf-8"))
    return {
        "steps": recipe.steps,
        "windows": recipe.batch + _leg_windows(recipe, material.legs),
        "seconds": clock.seconds,
        "step_seconds": clock.step_seconds,
        "training_error_m2": history[-1]["training_error"],
        "validation_error_m2": history[-1]["validation_error"],
        "recipe": asdict(recipe),
        "skipped": [asdict(one) for one in skipped + missing],
    }


def recipe_digest(recipe: TrainingConfig, dataset: DataSet) -> str:
    """Digest of what a cell's figures depend on besides the code."""
    told = [
        asdict(recipe),
        [[str(path) for path in part] for part in (dataset.training, dataset.validation)],
    ]
    return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()


def _streams(
    files: Sequence[Path], recipe: TrainingConfig, reading: Reading
) -> tuple[list[Recorded], list[Skipped]]:
    """Of each recording; the next cells of a set find them open."""
    key = (tuple(files), recipe.attitude, reading.cache)
    if key not in _open:
        outcomes = recorded(files, reading.read, reading.options, reading.cache, 1, recipe.attitude)
        found = list(zip(files, outcomes, strict=True))
        known = [Recorded(path, one) for path, one in found if not isinstance(one, Skipped)]
        skipped = [one for _, one in found if isinstance(one, Skipped)]
        while len(_open) >= _MOST_OPEN:
            _open.pop(next(iter(_open)))
        _open[key] = known, skipped
    return _open[key]


_MOST_OPEN = 2
"""Parts of sets whose streams a process keeps open: those of one cell."""

_open: dict[object, tuple[list[Recorded], list[Skipped]]] = {}


def _leg_windows(recipe: TrainingConfig, legs: Sequence[object]) -> int:
    kinds = {getattr(stream, "kind", "") for stream in legs}
    waypoints = recipe.waypoint_stretches * recipe.waypoint_seconds if "waypoints" in kinds else 0
    tracks = recipe.track_stretches * recipe.track_seconds if "positions" in kinds else 0
    return waypoints + tracks


class _Clock:
    """Computing time of a training [s], over all the processes that took part one after another."""

    def __init__(self, path: Path) -> None:
        self._path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        before = json.loads(path.read_text(encoding="utf-8")) if path.exists() else 0.0
        self._before, self._began = float(before), process_time()
        self._last: float | None = None
        self._steps: list[float] = []

    @property
    def seconds(self) -> float:
        return self._before + process_time() - self._began

    @property
    def step_seconds(self) -> float:
        """Mean of the steps that were seen whole; nan where there was none."""
        return sum(self._steps) / len(self._steps) if self._steps else float("nan")

    def step(self) -> None:
        """A step is done."""
        if self._last is not None:
            self._steps.append(process_time() - self._last)
        self._last = process_time()

    def pause(self) -> None:
        """What follows is no step."""
        self._last = None

    def keep(self) -> None:
        """Note the time so far."""
        write_json(self._path, self.seconds)
