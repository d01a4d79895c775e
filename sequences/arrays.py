"""Array types of sequences, and validation of arrays that users pass in."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stario.sequences.errors import InputError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


def correlation(x: FloatArray, y: FloatArray) -> float:
    """Return Pearson's correlation of arrays of equal shape; 0 if one is constant or too short."""
    if x.size < 3 or min(np.ptp(x), np.ptp(y)) == 0.0:
        return 0.0
    return float(np.corrcoef(x.ravel(), y.ravel())[0, 1])


def interpolated(at: FloatArray, time: FloatArray, values: FloatArray) -> FloatArray:
    """Interpolate columns of values (N, k) linearly at times (M,), clamped at the ends."""
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def number_in(text: str) -> float:
    """Return the number that a text holds, NaN if it holds anything else."""
    try:
        return float(text)
    except ValueError:
        return float("nan")


def checked_time(name: str, value: FloatArray) -> FloatArray:
    """Return times (N,) [s], checked to be finite and strictly increasing.

    Raises:
        InputError: a time is not finite, or the times do not strictly increase.
    """
    time = np.asarray(value, dtype=np.float64)
    if time.ndim != 1 or time.size == 0:
        raise InputError(name, f"shape {time.shape}", "(N,) with at least one sample")
    if not np.isfinite(time).all():
        raise InputError(name, "a value that is not finite", "finite seconds")
    steps = np.diff(time)
    if (steps <= 0).any():
        k = int(np.argmax(steps <= 0))
        raise InputError(
            name, f"{time[k + 1]!r} after {time[k]!r} at row {k + 1}", "strictly increasing seconds"
        )
    return time


def checked_array(
    name: str, value: FloatArray, shape: tuple[int, ...], where: BoolArray
) -> FloatArray:
    """Return `value` as an array, checked for its shape and for finite rows at `where`.

    Raises:
        InputError: the shape differs, or a row at `where` has a value that is not finite.
    """
    array = np.asarray(value, dtype=np.float64)
    if array.shape != shape:
        raise InputError(name, f"shape {array.shape}", f"{shape}")
    bad = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1) & where
    if bad.any():
        raise InputError(
            name, f"a value that is not finite at row {int(np.argmax(bad))}", "finite values"
        )
    return array
