"""Training: on CPU or GPU, in one process or several, resumable from its checkpoint."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path

import numpy as np

from stario.network.card import Calibration
from stario.network.model import DisplacementModel
from stario.network.training.augment import WindowSampler
from stario.network.training.checkpoint import exclusive
from stario.network.training.config import TrainingConfig
from stario.network.training.history import EpochReport
from stario.network.training.legs import leg_samplers
from stario.network.training.parallel import workers
from stario.network.training.result import write_result
from stario.network.training.run import TrainingRun
from stario.network.training.validation import ValidationSet
from stario.sequences.errors import InputError
from stario.sequences.legs import LegStream
from stario.sequences.windows import WorldStream

log = logging.getLogger(__name__)


def train(
    config: TrainingConfig,
    streams: Sequence[WorldStream],
    weights: Sequence[float],
    validation: Sequence[WorldStream],
    folder: Path,
    on_step: Callable[[int, float], None] = lambda step, loss: None,
    on_epoch: Callable[[EpochReport], None] = lambda report: None,
    trained_on: Sequence[str] = (),
    start_from: DisplacementModel | None = None,
    calibration: Calibration | None = None,
    legs: Sequence[LegStream] = (),
    validation_legs: Sequence[LegStream] = (),
    chosen_by_legs: bool = False,
) -> Path:
    """Train a network, continuing from the folder's checkpoint where there is one.

    Args:
        config: the recipe; a checkpoint made with another one is rejected.
        streams: training stretches with full truth.
        weights: relative frequency of each stretch, per second of its length.
        validation: stretches that select the weights and calibrate the covariance.
        folder: folder for `checkpoint.safetensors`, `model.safetensors`, its card and `log.json`.
        on_step: called after each step with the step and its mean squared error [m^2], for a
            progress bar.
        on_epoch: called after each validation; for initial weights before the first epoch, too.
        trained_on: description of the training data, for the card; that of the initial weights is
            added to it.
        start_from: model that provides the initial weights.
        calibration: calibration of other weights, used if the errors on `validation` are
            meaningless: a last stage also trains on it, and weak truth alone has no such windows.
        legs: additional stretches of weak truth, positions or waypoints.
        validation_legs: additional stretches of weak truth that select the weights.
        chosen_by_legs: whether `validation_legs` alone select the weights, for example if
            `validation` is only simulated.

    Returns:
        Path of the model's weights.

    Raises:
        InputError: no stretch to learn from or to validate on, or the loss of a step is not
            finite. In the latter case the folder keeps the last epoch's checkpoint.
        ConfigError: the checkpoint belongs to another recipe or other recordings, the batch
            cannot be divided evenly among the processes that the launcher started, or another run
            is training in the folder.
    """
    if not streams or not validation:
        fix = "positions and waypoints can only be learned alongside them" if legs else ""
        raise InputError("streams", "none", "stretches of at least 2 s with poses", fix)
    with (
        workers(config.device, config.batch // config.successive) as processes,
        exclusive(folder) if processes.is_leader else nullcontext(),
    ):
        sampler = WindowSampler(
            streams, weights, config.augmentation, config.seed, config.successive, processes.device
        )
        material = _material([streams, validation, legs, validation_legs], weights, start_from)
        run = TrainingRun(
            config, sampler, leg_samplers(config, legs, sampler), material, folder, processes
        )
        recurrent = run.network.is_recurrent
        held_out = ValidationSet(validation, config, validation_legs, chosen_by_legs, recurrent)
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
            sources = [*trained_on, *_inherited(start_from)]
            validating = {id(stream) for stream in (*validation, *validation_legs)}
            learned = any(id(stream) in validating for stream in (*streams, *legs))
            write_result(path, run.best_network(), config, held_out, sources, calibration, learned)
        return path


def _inherited(start_from: DisplacementModel | None) -> list[str]:
    """Return the sources of the initial weights, whose licences hold for the result as well."""
    sources = [] if start_from is None else start_from.card.trained_on
    before = "initial weights, "
    return list(dict.fromkeys(before + words.removeprefix(before) for words in sources))


def _material(
    streams: Sequence[Sequence[WorldStream | LegStream]],
    weights: Sequence[float],
    start_from: DisplacementModel | None,
) -> str:
    """Return the digest of training data, validation data and initial weights."""
    content = [
        [[(stream.name, len(stream), _moments(stream)) for stream in part] for part in streams],
        [f"{weight:.6g}" for weight in weights],
        start_from.card.sha256 if start_from else "",
    ]
    return hashlib.sha256(json.dumps(content).encode()).hexdigest()


def _moments(stream: WorldStream | LegStream) -> list[str]:
    """Return the sums over time of t x, for every column x of a stream: they tell corrected data.

    Unlike a digest of the bytes, they are the same on processors that round differently.
    """
    arrays = [value for value in vars(stream).values() if isinstance(value, np.ndarray)]
    return [
        f"{moment:.6g}"
        for array in arrays
        for moment in np.atleast_1d(np.linspace(0.0, 1.0, len(array)) @ array.astype(np.float64))
    ]
