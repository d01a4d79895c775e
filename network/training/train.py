"""Training: on CPU or GPU, in one process or several, resumable from its checkpoint."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from stario.network.card import Calibration
from stario.network.model import DisplacementModel
from stario.network.training.checkpoint import exclusive
from stario.network.training.config import TrainingConfig
from stario.network.training.data import TrainingData
from stario.network.training.history import EpochReport
from stario.network.training.parallel import workers
from stario.network.training.result import write_result
from stario.network.training.run import TrainingRun
from stario.network.training.validation import ValidationSet
from stario.sequences.datasets.stream_cache import Stream
from stario.sequences.errors import InputError

log = logging.getLogger(__name__)


def train(
    config: TrainingConfig,
    data: TrainingData,
    validation: TrainingData,
    folder: Path,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
    on_epoch: Callable[[EpochReport], None] = lambda report: None,
    start_from: DisplacementModel | None = None,
    calibration: Calibration | None = None,
) -> Path:
    """Train a network, continuing from the folder's checkpoint where there is one.

    Args:
        config: the recipe; a checkpoint made with another one is rejected.
        data: what is learned from. Its description is written on the card, with that of the initial
            weights.
        validation: what selects the weights and calibrates the covariance.
        folder: folder for `checkpoint.safetensors`, `model.safetensors`, its card and `log.json`.
        on_step: called after each step with the step and its mean squared error [m^2], for a
            progress bar.
        on_epoch: called after each validation; for initial weights before the first epoch, too.
        start_from: model that provides the initial weights.
        calibration: calibration of other weights, used if the errors on `validation` are
            meaningless: a last stage also trains on it, and weak truth alone has no such windows.

    Returns:
        Path of the model's weights.

    Raises:
        InputError: no stretch to learn from or to validate on, or the loss of a step is not
            finite. In the latter case the folder keeps the last epoch's checkpoint.
        ConfigError: the checkpoint belongs to another recipe or other recordings, the batch
            cannot be divided evenly among the processes that the launcher started, or another run
            is training in the folder.
    """
    if not data.streams or not validation.streams:
        fix = "positions and waypoints can only be learned alongside them" if data.legs else ""
        raise InputError("streams", "none", "stretches of at least 2 s with poses", fix)
    with (
        workers(config.device, config.batch // config.successive) as processes,
        exclusive(folder) if processes.is_leader else nullcontext(),
    ):
        material = _material(data, validation, start_from)
        run = TrainingRun(config, data, material, folder, processes)
        held_out = ValidationSet(validation, config, run.network.is_recurrent)
        before: dict[str, float] = {}
        if start_from is not None:
            run.start_from(start_from)
            if processes.is_leader:
                before = held_out.errors(run.averaged)
                on_epoch(EpochReport(0, math.nan, held_out.selection_error(before), before))
        run.resume()
        if run.step >= config.steps:
            log.warning("%s: all %d epochs are done, nothing left to train", folder, config.epochs)
        while run.step < config.steps and not run.history.should_stop():
            report = run.validate(run.epoch(on_step), held_out)
            if processes.is_leader:
                on_epoch(report)
        if before and (words := held_out.worse(before, run.history.best().validation_by_recording)):
            log.warning("%s: %s", folder, words)
        path = folder / "model.safetensors"
        if processes.is_leader:
            sources = [*data.words, *_inherited(start_from)]
            validating = {id(stream) for stream in (*validation.streams, *validation.legs)}
            learned = any(id(stream) in validating for stream in (*data.streams, *data.legs))
            write_result(path, run.best_network(), config, held_out, sources, calibration, learned)
        return path


def _inherited(start_from: DisplacementModel | None) -> list[str]:
    """Return the sources of the initial weights, whose licences hold for the result as well."""
    sources = [] if start_from is None else start_from.card.trained_on
    before = "initial weights, "
    return list(dict.fromkeys(before + words.removeprefix(before) for words in sources))


def _material(
    data: TrainingData, validation: TrainingData, start_from: DisplacementModel | None
) -> str:
    """Return the digest of training data, validation data and initial weights."""
    parts = data.streams, validation.streams, data.legs, validation.legs
    content = [
        [[(stream.name, len(stream), _moments(stream)) for stream in part] for part in parts],
        [f"{weight:.6g}" for weight in data.weights],
        start_from.card.sha256 if start_from else "",
    ]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _moments(stream: Stream) -> list[str]:
    """Return the sums over time of t x, for every column x of a stream: they tell corrected data.

    Unlike a digest of the bytes, they are the same on processors that round differently.
    """
    arrays = [value for value in vars(stream).values() if isinstance(value, np.ndarray)]
    return [
        f"{moment:.6g}"
        for array in arrays
        for moment in np.atleast_1d(np.linspace(0.0, 1.0, len(array)) @ array.astype(np.float64))
    ]
