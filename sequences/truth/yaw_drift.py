"""Causes of the gyroscope's yaw drift: scale error and bias.

A scale error s and a bias b about the vertical make the levelled yaw psi drift from the true one:

    psi_true - psi = -s / (1 + s) (psi - psi_0) - b (t - t_0) + const

Phones whose system removes the bias still have scale errors of a few percent; on a walk in loops
these add up, and neither gravity nor the network makes them observable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.levelling import levelled_attitudes
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.clean_samples import clean_samples, longest_unbroken
from stario.sequences.sequence import ImuSequence
from stario.sequences.truth.fit import TruthFit
from stario.sequences.truth.part import middle_part

_STEP_S = 0.1
_MIN_TURNED_RAD = 0.3
"""Minimum deviation of the true yaw from an even rotation that separates scale from bias."""


@dataclass(frozen=True)
class YawDrift:
    """Drift of the gyroscope's yaw relative to the true one.

    Attributes:
        scale: scale error of the gyroscope, positive if it reads too high.
        bias: its bias about the vertical [rad/s].
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
    time, gyro, accel = clean_samples(middle_part(sequence))
    truth = replace(sequence.truth, time=sequence.truth.time + fit.time_offset)
    part = longest_unbroken(time)
    time = time[part]
    R_NB = levelled_attitudes(time, gyro[part], accel[part])
    # Without the last sample, which rounding may place before the grid's last time.
    grid = np.arange(time[0], time[-1], _STEP_S)
    at = np.unique(np.searchsorted(time[:-1], grid))
    pose = truth.at(time[at])
    attitude_NB = Rotation.from_matrix(R_NB[at])
    yaw = np.unwrap(yaw_of(attitude_NB))[pose.valid]
    off = np.unwrap(yaw_of(pose.attitude_WB[pose.valid] * fit.R_TB * attitude_NB[pose.valid].inv()))
    seconds = time[at][pose.valid] - time[0]
    if len(off) < 3:
        return None
    even = np.column_stack([np.ones(len(off)), seconds])
    # The true yaw is tested, so that a gyroscope that measures only a fiftieth is reported as well.
    turned = yaw + off - even @ np.linalg.lstsq(even, yaw + off, rcond=None)[0]
    if float(turned.std()) < _MIN_TURNED_RAD:
        return None
    columns = np.column_stack([even, yaw])
    fitted, *_ = np.linalg.lstsq(columns, off, rcond=None)
    residual_rms = math.sqrt(float(np.square(off - columns @ fitted).mean()))
    _, rate, share = fitted.tolist()
    return YawDrift(-share / (1.0 + share), -rate, residual_rms)
