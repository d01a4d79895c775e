"""Calibration of predicted standard deviations on recordings kept from training.

With sigma from the network, the factor s per axis that makes the mean of e^2 / (s sigma)^2 equal
to one is the root of that mean. Windows whose error is beyond what any sigma explains would rule
a plain mean, so normalised errors are clipped at a generous quantile first.
"""

from __future__ import annotations

import numpy as np

from stario.network.card import Calibration
from stario.sequences.sequence import FloatArray

_FLOOR_M = 0.01
_CLIP = 25.0


def calibrate(error: FloatArray, log_sigma: FloatArray) -> Calibration:
    """Fit factors to errors (M, 3) [m] and log sigmas (M, 3); x and y share theirs."""
    normalised = np.maximum(error**2 - _FLOOR_M**2, 0.0) / np.exp(2.0 * log_sigma)
    horizontal = _factor(normalised[:, :2].ravel())
    vertical = _factor(normalised[:, 2])
    return Calibration(scale=(horizontal, horizontal, vertical), floor=(_FLOOR_M,) * 3)


def _factor(normalised: FloatArray) -> float:
    scale = float(np.mean(normalised))
    for _ in range(20):
        scale = float(np.mean(np.minimum(normalised, _CLIP * scale)))
    return float(np.sqrt(scale))
