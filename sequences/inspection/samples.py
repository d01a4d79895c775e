"""Samples that cannot be right by themselves: their times, or values that no sensor gives."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from stario.sequences.sequence import ABSURD, MAX_IMU_GAP, BoolArray, FloatArray, ImuSequence

_log = logging.getLogger(__name__)

_OUT_OF_ORDER = 0.05
"""Beyond this share of steps that go back the rows are in disorder."""

_SET_BACK = 5.0
"""A step back by more than this [s] is of a clock that was set."""


def sample_problems(sequence: ImuSequence) -> list[str]:
    """What is wrong with them, one line each; rows in disorder are left to `disorder`."""
    time, problems = sequence.time[np.isfinite(sequence.time)], []
    steps = np.diff(time)
    if len(steps) and steps.min() < -_SET_BACK and not disorder(time):
        k = int(np.argmin(steps))
        problems.append(
            f"{sequence.name}: time: the clock goes back by {-steps[k]:.3g} s at "
            f"{time[k] - time[0]:.1f} s; split the recording there"
        )
    wild = int((np.isfinite(_values(sequence)).all(axis=1) & ~usable(sequence)).sum())
    if wild:
        problems.append(f"{sequence.name}: values that no sensor gives, in {wild} samples")
    return problems


def disorder(time: FloatArray) -> str:
    """How many of the times (n,) [s] go back; empty where few do."""
    back = int((np.diff(time[np.isfinite(time)]) < 0.0).sum())
    many = back > _OUT_OF_ORDER * len(time)
    return f"{back} of {len(time)} times before the one above" if many else ""


def in_order(sequence: ImuSequence) -> ImuSequence:
    """The recording sorted by time where many rows are out of order, each by little.

    Some loggers write what comes within a few milliseconds in any order: left out, as a few are, a
    twentieth of the samples were lost. Rows that lie far off are of no order to be guessed.
    """
    time = sequence.time
    if not disorder(time):
        return sequence
    back = float((np.maximum.accumulate(time) - time).max())
    if not back < MAX_IMU_GAP:
        return sequence
    _log.warning(
        "%s: %s, by %.0f ms at most: sorted by time", sequence.name, disorder(time), 1e3 * back
    )
    order = np.argsort(time, kind="stable")
    return replace(
        sequence, time=time[order], gyro=sequence.gyro[order], accel=sequence.accel[order]
    )


def usable(sequence: ImuSequence) -> BoolArray:
    """Which samples (n,) are numbers that a sensor may give."""
    return np.asarray((np.abs(_values(sequence)) < ABSURD).all(axis=1))


def _values(sequence: ImuSequence) -> FloatArray:
    return np.column_stack([sequence.gyro, sequence.accel])
