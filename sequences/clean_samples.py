"""Usable samples of a recording: measurable values at increasing times, in unbroken stretches."""

from __future__ import annotations

import logging
from dataclasses import replace
from itertools import pairwise

import numpy as np

from stario.sequences.errors import InputError
from stario.sequences.sequence import MAX_SENSOR_VALUE, BoolArray, FloatArray, ImuSequence
from stario.sequences.time_order import MAX_IMU_GAP, ahead_mask, disorder, increasing_mask

log = logging.getLogger(__name__)

MIN_RATE, MAX_RATE = 40.0, 1200.0
"""Limits of accepted sampling rates [Hz] (50 Hz to 1 kHz, with a margin for jitter)."""

SHARED_TIMES = 1.5
"""Least number of samples that share a time on average if times are rounded or of batches."""


def usable(sequence: ImuSequence) -> BoolArray:
    """Return which samples (N,) are numbers that a sensor can measure, whatever their time."""
    values = np.column_stack([sequence.gyro, sequence.accel])
    return np.asarray((np.abs(values) < MAX_SENSOR_VALUE).all(axis=1))


def finite_samples(sequence: ImuSequence) -> BoolArray:
    """Return which samples (N,) have a finite time and finite values."""
    columns = np.column_stack([sequence.time, sequence.gyro, sequence.accel])
    return np.asarray(np.isfinite(columns).all(axis=1))


def clean_samples(sequence: ImuSequence) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return time, gyroscope and accelerometer without bad, repeated and out-of-order samples.

    A few samples that jump ahead of later ones are dropped as well, and their number is logged.

    Raises:
        InputError: fewer than two samples are left, or their rate is not accepted.
    """
    index = np.flatnonzero(np.isfinite(sequence.time) & usable(sequence))
    if lost := len(sequence) - len(index):
        log.warning(
            "%s: samples that are not finite or too large dropped: %d of %d",
            sequence.name, lost, len(sequence),
        )  # fmt: skip
    kept = increasing_mask(sequence.time[index])
    if ahead := int(ahead_mask(sequence.time[index], kept).sum()):
        log.warning("%s: samples ahead of their time dropped: %d", sequence.name, ahead)
    index = index[kept]
    if len(index) < 2:
        raise InputError(f"{sequence.name}: samples", f"{len(index)} usable", "at least 2")
    time = sequence.time[index]
    rate = float(1.0 / np.median(np.diff(time)))
    if not MIN_RATE <= rate <= MAX_RATE:
        found, fix = f"{rate:.1f} Hz", "is the time column in seconds?"
        if lost > len(sequence) / 2:
            fix = "most samples are not finite"
        raise InputError(f"{sequence.name}: rate", found, "50 Hz to 1 kHz", fix)
    return time, sequence.gyro[index], sequence.accel[index]


def cleaned(sequence: ImuSequence) -> ImuSequence:
    """Return a recording with the samples of `clean_samples` alone; raises what that does."""
    time, gyro, accel = clean_samples(sequence)
    return replace(sequence, time=time, gyro=gyro, accel=accel)


def in_order(sequence: ImuSequence) -> ImuSequence:
    """Sort a recording by time if many rows are out of order, each by little.

    Some loggers write samples of a few milliseconds in any order. Dropping them, as is done with a
    few, would lose a twentieth of the samples. Rows that are far out of order are not sorted.
    """
    time = sequence.time
    if not disorder(time):
        return sequence
    back = float((np.maximum.accumulate(time) - time).max())
    if not back < MAX_IMU_GAP:
        return sequence
    log.warning(
        "%s: %s, by up to %.0f ms: sorted by time", sequence.name, disorder(time), 1e3 * back
    )
    return sequence.select(np.argsort(time, kind="stable"))


def unbroken(time: FloatArray) -> list[tuple[int, int]]:
    """Return stretches [start, stop) of increasing times (N,) [s] without a gap of the IMU."""
    breaks = np.flatnonzero(np.diff(time) > MAX_IMU_GAP) + 1
    return list(pairwise([0, *breaks.tolist(), len(time)]))


def longest_unbroken(time: FloatArray) -> slice:
    """Return the longest of the stretches of `unbroken`, by its samples."""
    return slice(*max(unbroken(time), key=lambda piece: piece[1] - piece[0]))


LONGEST_S = 600.0
"""Length of the middle part that is used of a longer recording [s], which bounds the cost."""

_SPIKE = 30.0
"""Multiple of the median force that no motion reaches: a single one would tilt the mean force."""


def middle_part(sequence: ImuSequence) -> ImuSequence:
    """Return the part of a recording that is used, at most `LONGEST_S` from its middle."""
    if sequence.duration <= LONGEST_S:
        return sequence
    # Of a sample: the average of the middle two may lie in a gap of hours.
    centre = float(np.nanquantile(sequence.time, 0.5, method="lower"))
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


SPIKE = np.array([12.0, 12.0, 12.0, 60.0, 60.0, 60.0])
"""A sample that differs from both neighbours by more than this is a spike [rad/s], [m/s^2]; heel
strikes stay below half of it at 50 Hz."""


def replace_spikes(values: FloatArray, first: bool = True) -> BoolArray:
    """Replace spikes in place by the mean of their neighbours; return where they were (n, 6).

    The samples at both ends, which have one neighbour, are compared with the nearest two.

    Args:
        values: (n, 6) consecutive gyroscope [rad/s] and specific force [m/s^2], at least two.
        first: whether the first sample may be one.
    """
    found = np.zeros(values.shape, dtype=np.bool_)
    n = len(values)
    steps = np.flatnonzero((np.abs(values[1:] - values[:-1]) > SPIKE).any(axis=1))
    for k in np.union1d(steps, steps + 1).tolist():
        if not (k or first):
            continue
        before = values[k - 1] if k else values[min(2, n - 1)]
        after = values[k + 1] if k + 1 < n else values[max(k - 2, 0)]
        found[k] = np.minimum(np.abs(values[k] - before), np.abs(values[k] - after)) > SPIKE
        if found[k].any():
            near = before if k else after
            # A neighbour may be a spike as well.
            agree = (np.abs(after - before) <= SPIKE) & (0 < k < n - 1)
            values[k] = np.where(found[k], np.where(agree, 0.5 * (before + after), near), values[k])
    return found


def spike_free_samples(sequence: ImuSequence) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the samples of `clean_samples` with spikes replaced.

    Raises:
        InputError: as for `clean_samples`.
    """
    time, gyro, accel = clean_samples(sequence)
    values = np.column_stack([gyro, accel])
    if replace_spikes(values).any():
        gyro, accel = values[:, :3].copy(), values[:, 3:].copy()
    return time, gyro, accel
