"""Calibration of a network's sigma on held-out recordings.

A network predicts which windows are hard better than how hard they are. Its log sigma is therefore
stretched and shifted, sigma = scale * exp(exponent * log_sigma), with the pair of highest
likelihood on the errors of validation windows. No sigma explains the errors of a few windows; the
squared normalised error is clipped so that these do not dominate.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize

from stario.network.card import Calibration
from stario.sequences.sequence import FloatArray

_FLOOR_M = 0.01
_CLIP = 25.0
_MAX_EXPONENT = 4.0


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
