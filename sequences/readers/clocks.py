"""Inference of unnamed time units, and sensors with separate sample times."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stario.sequences.arrays import interpolated
from stario.sequences.errors import ReadError
from stario.sequences.readers.text import IntArray, seconds
from stario.sequences.sequence import MAX_TRUTH_GAP, FloatArray
from stario.sequences.units import TIME_UNITS
from stario.sequences.windows import MAX_RATE

_RATES = (9.0, 1.05 * MAX_RATE)
"""Plausible rates of sensors and captures [Hz], with slack for rounding; the range spans less than
the factor between two units, so that only one unit fits."""


def resample_to_gyro(
    path: Path, gyro_ns: IntArray, gyro: FloatArray, accel_ns: IntArray, accel: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Interpolate the accelerometer to the gyroscope's samples in their common time span.

    Samples in an accelerometer gap of more than 0.1 s are skipped, since the force there is
    unknown. Times are in ns from one origin: (N,) with samples (N, 3) of the gyroscope, (M,) with
    samples (M, 3) of the accelerometer.

    Returns:
        Time stamps (K,) [ns], gyroscope (K, 3) and accelerometer (K, 3).

    Raises:
        ReadError: the two sensors do not overlap in time.
    """
    order = np.unique(accel_ns, return_index=True)[1]
    accel_ns, accel = accel_ns[order], accel[order]
    kept = (gyro_ns >= accel_ns[0]) & (gyro_ns <= accel_ns[-1])
    if not kept.any():
        origin = min(gyro_ns.min(), accel_ns[0])
        spans = [
            f"{name} from {seconds(ns, origin).min():.3f} to {seconds(ns, origin).max():.3f} s"
            for name, ns in (("gyroscope", gyro_ns), ("accelerometer", accel_ns))
        ]
        raise ReadError(path, "time", ", ".join(spans), "overlapping times on one clock")
    right = np.clip(np.searchsorted(accel_ns, gyro_ns), 1, len(accel_ns) - 1)
    before, after = accel_ns[right - 1], accel_ns[np.minimum(right, len(accel_ns) - 1)]
    exact = (gyro_ns == before) | (gyro_ns == after)
    kept &= exact | (after - before <= round(MAX_TRUTH_GAP * 1e9))
    time, t = seconds(gyro_ns[kept], accel_ns[0]), seconds(accel_ns, accel_ns[0])
    return gyro_ns[kept], gyro[kept], interpolated(time, t, accel)


def time_unit(file: Path, time: FloatArray, unit: str = "") -> int:
    """Return the number of time units in a second, inferred from the rate if no unit is named.

    Raises:
        ReadError: the unit is unknown, or no unit gives a plausible sample rate.
    """
    if unit in TIME_UNITS:
        return TIME_UNITS[unit]
    if unit:
        raise ReadError(file, "time", f"unit {unit!r}", ", ".join(TIME_UNITS))
    steps = np.diff(time)
    steps = steps[steps > 0]
    step = float(np.median(steps)) if len(steps) else 0.0
    for per_second in TIME_UNITS.values():
        if step and _RATES[0] <= per_second / step <= _RATES[1]:
            return per_second
    expected = f"10 to {MAX_RATE:.0f} samples per second in one of {', '.join(TIME_UNITS)}"
    raise ReadError(file, "time", f"a step of {step:.4g}", expected)
