"""The part of a recording that the truth is compared with: its middle, without spikes."""

from __future__ import annotations

import numpy as np

from stario.sequences.clean_samples import clean_samples
from stario.sequences.sequence import BoolArray, FloatArray, ImuSequence

LONGEST_S = 600.0
"""Length of the middle part that is used of a longer recording [s], which bounds the cost."""

_SPIKE = 30.0
"""Multiple of the median force that no motion reaches: a single one would tilt the mean force."""


def middle_part(sequence: ImuSequence) -> ImuSequence:
    """Return the part of a recording that is used, at most `LONGEST_S` from its middle."""
    if sequence.duration <= LONGEST_S:
        return sequence
    centre = float(np.nanmedian(sequence.time))
    return sequence.slice(centre - LONGEST_S / 2, centre + LONGEST_S / 2)


def compared_samples(sequence: ImuSequence) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return time, gyroscope and accelerometer of the middle part, without spikes.

    Raises:
        InputError: as for `clean_samples`.
    """
    time, gyro, accel = clean_samples(middle_part(sequence))
    used = without_spikes(accel)
    return time[used], gyro[used], accel[used]


def without_spikes(accel: FloatArray) -> BoolArray:
    """Return which specific forces (N, 3) in any unit are no spikes of the sensor's reading."""
    size = np.linalg.norm(accel, axis=1)
    return np.asarray(size <= _SPIKE * np.median(size))
