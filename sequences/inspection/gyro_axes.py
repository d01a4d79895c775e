"""Comparison of the gyroscope's axes and signs with the accelerometer's, without ground truth.

Averaged over a second, the specific force of a carried device is close to gravity. When the device
tilts, gravity turns in its axes as the gyroscope says. Rotated by it into a frame that does not
turn, the averages of successive seconds agree; with other axes or signs they differ by about as
much as they do in the device's axes. A wrong sign of the whole accelerometer changes neither.
"""

from __future__ import annotations

import math

import numpy as np

from stario.sequences.arrays import samples_in
from stario.sequences.attitude.rotations import integrated_gyro
from stario.sequences.clean_samples import clean_samples, unbroken
from stario.sequences.findings import Assessment, Finding
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, ImuSequence

COMPARED = "units, signs and axes: compared"

_MIN_TILT = 0.2
"""Change of gravity between successive seconds in the device's axes that counts, relative to it."""

_MAX_FORCE = 1.15
"""Mean magnitude of the force, relative to gravity, above which a runner hides it."""

_MIN_SECONDS = 2.5
"""Minimum length of an unbroken stretch [s]: two averages and a margin."""

_MIN_TILTS = 5
"""Number of such changes needed for a verdict."""

_MAX_UNEXPLAINED = 0.65
"""Share of the squared changes left unexplained above which the axes differ. Of 46 recordings of
all sets one exceeds it (median 0.1); with two axes swapped or all signs changed, nine in ten do,
with one sign changed two in three."""


def compare_gyro_axes(sequence: ImuSequence) -> Assessment:
    """Compare how gravity turns in the device's axes with the gyroscope.

    The figure "tilts" is the number of changes of gravity, "unexplained" the share of them that
    the gyroscope does not explain, by sums of squares; NaN without any.
    """
    time, gyro, accel = clean_samples(sequence)
    rows = [
        _changes(time[start:stop], gyro[start:stop], accel[start:stop])
        for start, stop in unbroken(time)
        if time[stop - 1] - time[start] > _MIN_SECONDS
    ]
    changes = np.concatenate([np.empty((0, 2)), *rows])
    left, total = changes.sum(axis=0)
    tilts, unexplained = len(changes), float(left / total) if len(changes) else math.nan
    figures = {"tilts": tilts, "unexplained": unexplained}
    if tilts < _MIN_TILTS:
        line = "units: compared; the device tilts too seldom to compare the sensors' axes"
        return Assessment(figures, [line], [])
    found = []
    if unexplained > _MAX_UNEXPLAINED:
        text = (
            f"gyroscope: leaves {unexplained:.0%} of gravity's changes in {tilts} tilts "
            "unexplained, expected less than half"
        )
        fix = "are its axes and signs the accelerometer's? (On rides, accelerations look like "
        found.append(Finding("gyro_axes", text, f"{fix}tilts.)", values=figures))
    return Assessment(figures, [COMPARED], found)


def _changes(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
    """Return unexplained and all squared changes (M, 2) of successive mean forces that count."""
    size = samples_in(1.0, time)
    count = len(time) // size
    R_0B = integrated_gyro(time, gyro)
    whole = slice(0, count * size)
    force_0 = R_0B.apply(accel)[whole].reshape(count, size, 3).mean(axis=1)
    magnitude = np.linalg.norm(accel[whole], axis=1).reshape(count, size).mean(axis=1)
    middle = R_0B[size // 2 : count * size : size]
    change_0 = np.linalg.norm(np.diff(force_0, axis=0), axis=1)
    change_B = np.linalg.norm(np.diff(middle.inv().apply(force_0), axis=0), axis=1)
    calm = magnitude < _MAX_FORCE * STANDARD_GRAVITY
    counts = calm[1:] & calm[:-1] & (change_B > _MIN_TILT * STANDARD_GRAVITY)
    changes: FloatArray = np.square(np.column_stack([change_0, change_B])[counts])
    return changes
