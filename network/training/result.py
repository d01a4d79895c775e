"""The result of a training run: weights with their card, calibrated on held-out recordings.

A network predicts which windows are hard better than how hard they are. Its log sigma is therefore
stretched and shifted, sigma = scale * exp(exponent * log_sigma), with the pair of highest
likelihood on the errors of validation windows. No sigma explains the errors of a few windows; the
squared normalised error is clipped so that these do not dominate.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from stario.network.card import Calibration, Card
from stario.network.displacement import DisplacementNetwork
from stario.network.model import save_model
from stario.network.training.config import TrainingConfig
from stario.network.training.validation import ValidationSet
from stario.sequences.sequence import FloatArray

_FLOOR_M = 0.01
_CLIP = 25.0
_MAX_EXPONENT = 4.0


def write_result(
    path: Path,
    network: DisplacementNetwork,
    config: TrainingConfig,
    held_out: ValidationSet,
    trained_on: list[str],
    kept: Calibration | None,
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
        learned: whether the network was also trained on `held_out`: its errors then say nothing
            about other recordings, and are named accordingly.
    """
    residuals, log_sigma = held_out.residuals(network)
    errors = "validation_mse_m2" + ("_after_it_was_learned" if learned else "")
    card = Card(
        architecture=config.architecture,
        calibration=kept or calibrate(residuals, log_sigma),
        trained_on=trained_on,
        recipe=json.loads(json.dumps(asdict(config))),
        figures={errors: held_out.errors(network, residuals)},
    )
    save_model(path, network, card)


def calibrate(error: FloatArray, log_sigma: FloatArray) -> Calibration:
    """Fit a calibration to errors (M, 3) [m] and log sigmas (M, 3).

    x and y share scale and exponent.
    """
    scale_h, exponent_h = _fit(error[:, :2].ravel(), log_sigma[:, :2].ravel())
    scale_z, exponent_z = _fit(error[:, 2], log_sigma[:, 2])
    return Calibration(
        scale=(scale_h, scale_h, scale_z),
        exponent=(exponent_h, exponent_h, exponent_z),
        floor=(_FLOOR_M,) * 3,
    )


def _fit(error: FloatArray, log_sigma: FloatArray) -> tuple[float, float]:
    """Return the scale and exponent that minimise the clipped negative log-likelihood."""

    def cost(parameters: FloatArray) -> float:
        log_scale, exponent = parameters
        variance = np.exp(2.0 * (log_scale + exponent * log_sigma)) + _FLOOR_M**2
        normalised = np.minimum(error**2 / variance, _CLIP)
        return float(np.mean(normalised + np.log(variance)))

    # An uninformative sigma is ignored (exponent 0), never used with its sign reversed.
    bounds = [(-10.0, 10.0), (0.0, _MAX_EXPONENT)]
    log_scale, exponent = minimize(cost, [0.0, 1.0], method="Nelder-Mead", bounds=bounds).x
    return float(np.exp(log_scale)), float(exponent)
