"""The result of a training run: weights with their card."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from stario.network.card import Calibration, Card
from stario.network.displacement import DisplacementNetwork
from stario.network.known_motion import KnownMotion
from stario.network.model import save_model
from stario.network.training.calibrate import calibrate
from stario.network.training.config import TrainingConfig
from stario.network.training.validation import ValidationSet


def write_result(
    path: Path,
    network: DisplacementNetwork,
    config: TrainingConfig,
    held_out: ValidationSet,
    trained_on: list[str],
    kept: Calibration | None,
    known: KnownMotion | None,
    learned: bool,
) -> None:
    """Calibrate a network, unless a calibration is given, and write it with its card.

    Args:
        path: path of the weights.
        network: network to write.
        config: its recipe.
        held_out: recordings to calibrate and report errors on.
        trained_on: description of the training data.
        kept: calibration of other weights, if it is to be kept.
        known: summary of the training windows.
        learned: whether the network was also trained on `held_out`: its errors then say nothing
            about other recordings, and are named accordingly.
    """
    residuals, log_sigma = held_out.residuals(network)
    # Sigma is also widened for unknown motion: the calibration must not widen it again.
    widened = 1.0 if known is None else held_out.variance_factors(known)[:, None]
    errors = "validation_mse_m2" + ("_after_it_was_learned" if learned else "")
    card = Card(
        architecture=config.architecture,
        calibration=kept or calibrate(residuals / np.sqrt(widened), log_sigma),
        trained_on=trained_on,
        recipe=json.loads(json.dumps(asdict(config))),
        figures={errors: held_out.errors(network, residuals)},
        known_motion=known,
    )
    save_model(path, network, card)
