"""Calibration of predicted standard deviations on recordings kept from training.

A network knows better which windows are hard than how hard they are: its log sigma is stretched
and shifted, sigma = scale * exp(exponent * log_sigma), by the pair of highest likelihood on the
errors of validation windows. A few windows are wrong beyond what any sigma explains; the squared
normalised error counts up to a limit, so that these do not rule.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from stario.network.card import Calibration
from stario.sequences.sequence import FloatArray

_FLOOR_M = 0.01
_CLIP = 25.0
_STEEPEST = 4.0


def calibrate(error: FloatArray, log_sigma: FloatArray) -> Calibration:
    """Fit to errors (M, 3) [m] and log sigmas (M, 3); x and y share their pair."""
    scale_h, exponent_h = _fit(error[:, :2].ravel(), log_sigma[:, :2].ravel())
    scale_z, exponent_z = _fit(error[:, 2], log_sigma[:, 2])
    return Calibration(
        scale=(scale_h, scale_h, scale_z),
        exponent=(exponent_h, exponent_h, exponent_z),
        floor=(_FLOOR_M,) * 3,
    )


def _fit(error: FloatArray, log_sigma: FloatArray) -> tuple[float, float]:
    """Scale and exponent of least clipped negative log-likelihood."""

    def cost(parameters: FloatArray) -> float:
        log_scale, exponent = parameters
        variance = np.exp(2.0 * (log_scale + exponent * log_sigma)) + _FLOOR_M**2
        normalised = np.minimum(error**2 / variance, _CLIP)
        return float(np.mean(normalised + np.log(variance)))

    # A sigma that says nothing is ignored (exponent 0), never believed the wrong way round.
    bounds = [(-10.0, 10.0), (0.0, _STEEPEST)]
    log_scale, exponent = minimize(cost, [0.0, 1.0], method="Nelder-Mead", bounds=bounds).x
    return float(np.exp(log_scale)), float(exponent)
