"""Samples that cannot be right by themselves: their times, or values that no sensor gives."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.sequence import ABSURD, MAX_IMU_GAP, BoolArray, FloatArray, ImuSequence
from stario.sequences.windows import MIN_RATE, runs

_log = logging.getLogger(__name__)

_OUT_OF_ORDER = 0.05
"""Beyond this share of steps that go back the rows are in disorder."""

_SET_BACK = 5.0
"""A step back by more than this [s] is of a clock that was set."""

_STUCK_S = 1.0
"""A sensor whose values repeat exactly for so long [s] is stuck; recorded ones do for 0.1 s."""

_LARGE_RAD_S, _LARGE_M_S2 = 3.0, 15.0
"""A sensor whose largest values are smaller is not at its limit: coarse digits repeat as well."""

_OFTEN_AT_LIMIT, _NO_CHANCE = 0.005, 3
"""Share of samples from which on that deserves a word, and their least number."""

_SHAKEN_M_S2 = 0.5
_TILTING_RAD_S = 0.1
"""Scatter of the force, and of the rate across it, from which on a device moves."""


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
    return problems + _stuck_problems(sequence) + _limit_problems(sequence)


def _stuck_problems(sequence: ImuSequence) -> list[str]:
    """Which sensor repeats itself while the other moves; a `dead_gyro` is left to `check_units`."""
    given = usable(sequence) & np.isfinite(sequence.time)
    time, gyro, accel = sequence.time[given], sequence.gyro[given], sequence.accel[given]
    problems = []
    for sensor, values, other, moves in (
        ("gyroscope", gyro, "accelerometer", _shaken),
        ("accelerometer", accel, "gyroscope", _tilting),
    ):
        repeated = np.asarray(~np.diff(values, axis=0).any(axis=1))
        stuck = [
            (float(time[a] - time[0]), float(time[b] - time[0]))
            for a, b in runs(repeated)
            if time[b] - time[a] >= _STUCK_S
            and b - a >= MIN_RATE * _STUCK_S  # times in another unit make seconds of two samples
            and moves(time[a : b + 1], gyro[a : b + 1], accel[a : b + 1])
        ]
        if stuck and not (moves is _shaken and repeated.all()):
            start, stop = max(stuck, key=lambda stretch: stretch[1] - stretch[0])
            problems.append(
                f"{sequence.name}: {sensor}: its values repeat exactly for "
                f"{sum(b - a for a, b in stuck):.1f} s while the {other} moves, "
                f"longest from {start:.1f} to {stop:.1f} s"
            )
    return problems


def _limit_problems(sequence: ImuSequence) -> list[str]:
    """Which sensor is at its limit, by the values that repeat at an axis' largest size.

    The rule of streams (`fusion.imu.outliers`), here with all of a recording to look at.
    """
    problems = []
    given = usable(sequence)
    for sensor, values, unit, large in (
        ("gyroscope", sequence.gyro[given], "rad/s", _LARGE_RAD_S),
        ("accelerometer", sequence.accel[given], "m/s^2", _LARGE_M_S2),
    ):
        size = np.abs(values)
        largest = size.max(axis=0, initial=0.0)
        at_limit = (values[1:] == values[:-1]) & (size[1:] >= largest) & (largest > large)
        count = int(at_limit.any(axis=1).sum())
        share = count / max(len(at_limit), 1)
        if share >= _OFTEN_AT_LIMIT and count >= _NO_CHANCE:
            limit = float(largest[at_limit.any(axis=0)].max())
            problems.append(
                f"{sequence.name}: {sensor}: {share:.1%} of its samples are at its limit of "
                f"{limit:.3g} {unit}: what it missed nobody knows"
            )
    return problems


def dead_gyro(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Whether the rate (n, 3) never changes and the force (n, 3) is that of another motion."""
    return not np.diff(gyro, axis=0).any() and _shaken(time, gyro, accel)


def _shaken(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Whether a force (n, 3) is neither of a device at rest nor of one at the first rate.

    Turning evenly it stays the same in the device's axes (a circle) or in the world's (in place).
    """
    turned = Rotation.from_rotvec(np.outer(time - time[0], gyro[0])).apply(accel)
    scatter = min(float(np.linalg.norm(force.std(axis=0))) for force in (accel, turned))
    return scatter > _SHAKEN_M_S2


def _tilting(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Whether a rate (n, 3) turns a force that stays the same in the device; an even one may."""
    up = accel[0] / max(float(np.linalg.norm(accel[0])), 1e-9)
    return float(np.linalg.norm(np.cross(gyro, up).std(axis=0))) > _TILTING_RAD_S


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
