"""Axes of a sensor that never change although the device moves: broken, or from a wrong column.

Data simulated in a plane have constant axes too. So an axis of the gyroscope counts as dead only if
the rates about both others vary, and one of the accelerometer only if the gyroscope turns gravity
into it.
"""

from __future__ import annotations

import logging

import numpy as np

from stario.sequences.sequence import STANDARD_GRAVITY, BoolArray, FloatArray, ImuSequence
from stario.sequences.windows import usable

_log = logging.getLogger(__name__)

_VARIES_RAD_S = 0.01
"""Scatter of a rate above which it varies: far above rounding, below any hand or vehicle."""

_TILTS_RAD_S = 0.1
"""Scatter of the rate that turns gravity into an axis above which that axis must change."""


def dead_axis_problems(sequence: ImuSequence) -> list[str]:
    """Return one line for each sensor with a dead axis."""
    given = usable(sequence)
    gyro, accel = sequence.gyro[given], sequence.accel[given]
    if len(gyro) < 2:
        return []
    found = {"gyroscope": _dead_gyro_axes(gyro), "accelerometer": _dead_accel_axes(gyro, accel)}
    return [
        f"{sequence.name}: {sensor}: its {axis} axis never changes, although the device turns: "
        "is another column meant, or is the sensor broken?"
        for sensor, dead in found.items()
        for axis in np.array(["x", "y", "z"])[dead]
    ]


def warn_of_dead_axes(sequence: ImuSequence) -> None:
    """Log a warning for each sensor with a dead axis: data simulated in a plane may be meant."""
    for problem in dead_axis_problems(sequence):
        _log.warning("%s", problem)


def _dead_gyro_axes(gyro: FloatArray) -> BoolArray:
    """Return which axes (3,) of rates (n, 3) are constant while both others vary."""
    varies = gyro.std(axis=0) > _VARIES_RAD_S
    return np.asarray(_constant(gyro) & (varies.sum() == 2))


def _dead_accel_axes(gyro: FloatArray, accel: FloatArray) -> BoolArray:
    """Return which axes (3,) of forces (n, 3) are constant while gravity turns into them."""
    turned = np.cross(accel.mean(axis=0), gyro).std(axis=0)  # the force's rate of change
    constant = _constant(accel)
    alone = constant.sum() < 3  # otherwise the whole sensor is dead
    return np.asarray(constant & alone & (turned > _TILTS_RAD_S * STANDARD_GRAVITY))


def _constant(values: FloatArray) -> BoolArray:
    return np.asarray((values == values[0]).all(axis=0))
