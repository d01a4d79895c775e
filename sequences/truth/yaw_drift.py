"""Causes of the gyroscope's yaw drift: scale error and bias.

Rotated by the true attitude, a gyroscope with a scale error s and a constant bias b in its axes
turns by psi about the vertical, which drifts from the true turn:

    psi_true - psi = -s / (1 + s) (psi - psi_0) - b . integral of up_B + const

Along the levelled attitude instead, a scale error that tilts the device is mistaken for a bias in
its axes, and the removal of that bias hides part of the error or feigns one.

Phones whose system removes the bias still have scale errors of a few percent; on a walk in loops
these add up, and neither gravity nor the network makes them observable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from stario.sequences.arrays import trapezoids
from stario.sequences.attitude.levelling import BIAS_SIGMA
from stario.sequences.attitude.stacks import composed
from stario.sequences.clean_samples import clean_samples, longest_unbroken
from stario.sequences.sequence import ImuSequence
from stario.sequences.truth.fit import TruthFit
from stario.sequences.truth.part import middle_part

_MIN_TURNED_RAD = 0.3
"""Minimum deviation of the true yaw from an even rotation that separates scale from bias."""

_RESIDUAL_RAD, _LASTING_S = math.radians(0.5), 5.0
"""Typical residual of a recording [rad] and the time for which it lasts [s]."""


@dataclass(frozen=True)
class YawDrift:
    """Drift of the gyroscope's yaw relative to the true one.

    Attributes:
        scale: scale error of the gyroscope, positive if it reads too high.
        bias: its mean bias about the vertical [rad/s].
        residual_rms: root mean square of the residual yaw [rad].
    """

    scale: float
    bias: float
    residual_rms: float


def yaw_drift(sequence: ImuSequence, fit: TruthFit) -> YawDrift | None:
    """Fit scale and bias over the longest unbroken stretch of the part that `fit_truth` uses.

    Args:
        sequence: recording with ground truth.
        fit: fit of that truth.

    Returns:
        The drift; None if the device turned too little.

    Raises:
        InputError: as for `clean_samples`.
    """
    assert sequence.truth is not None  # a fit of it exists
    time, gyro, _ = clean_samples(middle_part(sequence))
    part = longest_unbroken(time)
    time, gyro = time[part], gyro[part]
    truth = replace(sequence.truth, time=sequence.truth.time + fit.time_offset)
    pose = truth.at(time)
    attitude_WB = composed(pose.attitude_WB, fit.R_TB)
    both = pose.valid[1:] & pose.valid[:-1]
    if both.sum() < 3:
        return None
    up_B = attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
    turns = trapezoids(time, np.sum(gyro * up_B, axis=1, keepdims=True))[both]
    true_turns = composed(attitude_WB[1:], attitude_WB[:-1].inv()).as_rotvec()[both, 2]
    psi_true, psi = np.cumsum(true_turns), np.cumsum(turns)
    even = np.column_stack([np.ones(len(psi)), np.cumsum(np.diff(time)[both])])
    # The true turn is tested, so that a gyroscope that measures only a fiftieth is reported too.
    uneven = psi_true - even @ np.linalg.lstsq(even, psi_true, rcond=None)[0]
    if float(uneven.std()) < _MIN_TURNED_RAD:
        return None
    upward = np.cumsum(trapezoids(time, up_B)[both], axis=0)
    columns = np.column_stack([even[:, 0], upward, psi])
    # Components of the bias that hardly show are held near zero: they would absorb anything else.
    weight = math.sqrt(even[-1, 1] / _LASTING_S / len(psi)) / _RESIDUAL_RAD
    rows = np.concatenate([weight * columns, np.eye(5)[1:4] / BIAS_SIGMA])
    drift = np.append(weight * (psi_true - psi), np.zeros(3))
    fitted, *_ = np.linalg.lstsq(rows, drift, rcond=None)
    residual_rms = math.sqrt(float(np.square(psi_true - psi - columns @ fitted).mean()))
    return YawDrift(
        scale=float(-fitted[4] / (1.0 + fitted[4])),
        bias=float(-fitted[1:4] @ up_B[pose.valid].mean(axis=0)),
        residual_rms=residual_rms,
    )
