"""Checks of arguments of the public interface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from stario.fusion.imu.barometer import PRESSURE_RANGE
from stario.sequences.arrays import as_float64, short_repr
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray

Vector = Sequence[float] | FloatArray
"""Three numbers."""

_UNITS_HPA = {"Pa": 0.01, "kPa": 10.0, "inHg": 33.8639}
"""Other units of pressure [hPa] that can be told from hPa."""

_ROTATION_ERROR, _ROUNDING_ERROR = 1e-4, 1e-9
"""Limits on |R R^T - I|: above the first a matrix is not a rotation; above the second its numbers
were rounded."""


def shaped(name: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return a copy of `value` as float64 of the given shape.

    Raises:
        InputError: it is not numeric or has another shape.
    """
    try:
        array = as_float64(name, value)
    except InputError as error:
        expected = f"numbers of shape {shape}" if shape else "a number"
        raise InputError(name, error.found, expected) from None
    if array.shape != shape:
        fix = f"np.diag({name})" if len(shape) == 2 and array.shape == shape[:1] else ""
        raise InputError(name, f"shape {array.shape}", f"{shape}" if shape else "a number", fix)
    return array.copy()


def seconds(time: float) -> float:
    """Return a time [s] as a float; `InputError` if it is not a number."""
    return _number("time", time, "a number of seconds")


def hectopascals(pressure: float) -> float:
    """Return a pressure [hPa] as a float; `InputError` if it is not one of the air in hPa."""
    value = _number("pressure", pressure, "a number of hPa")
    low, high = PRESSURE_RANGE
    if math.isfinite(value) and not low <= value <= high:
        names = [name for name, hPa in _UNITS_HPA.items() if low <= value * hPa <= high]
        remedy = f"convert from {' or '.join(names)} to hPa" if names else "give it in hPa"
        raise InputError("pressure", f"{value:g}", f"{low:g} to {high:g} hPa", remedy)
    return value


def _number(name: str, value: float, expected: str) -> float:
    try:
        if isinstance(value, str):
            raise ValueError
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(name, short_repr(value), expected) from None


def three(name: str, value: Vector) -> tuple[float, float, float]:
    """Return the three numbers of a vector; `InputError` if it holds anything else."""
    try:
        if isinstance(value, str | bytes) or getattr(value, "shape", (3,)) != (3,):
            raise ValueError  # "123" would be 1, 2, 3; a table yields its columns' names
        x, y, z = map(float, value)
    except (TypeError, ValueError, OverflowError):
        raise InputError(name, short_repr(value), "three numbers in body axes") from None
    return x, y, z


def checked(name: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    """Return a copy of `value` as finite float64 of the given shape.

    Raises:
        InputError: as for `shaped`, or a value is not finite.
    """
    array = shaped(name, value, shape)
    if not np.isfinite(array).all():
        raise InputError(name, "a value that is not finite", "finite values")
    return array


def checked_rotation(R_WB: Any) -> FloatArray:
    """Return a rotation matrix (3, 3); the nearest one if the numbers are rounded.

    Raises:
        InputError: as for `checked`, or the matrix is not a rotation.
    """
    R = checked("R_WB", R_WB, (3, 3))
    error = np.abs(R @ R.T - np.eye(3)).max()
    if error > _ROTATION_ERROR or np.linalg.det(R) < 0.0:
        raise InputError("R_WB", "a matrix that is not a rotation", "R R^T = I with det R = 1")
    if error <= _ROUNDING_ERROR:
        return R
    left, _, right = np.linalg.svd(R)
    return np.asarray(left @ right)


def check_covariance(covariance: FloatArray) -> None:
    """Check that a matrix is a covariance.

    Raises:
        InputError: it is asymmetric, or an eigenvalue is negative beyond rounding.
    """
    largest = np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > 1e-9 * largest:
        raise InputError("covariance", "an asymmetric matrix", "a symmetric one")
    sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    if np.linalg.eigvalsh(covariance / np.outer(sigma, sigma)).min() < -1e-9:
        raise InputError("covariance", "a negative eigenvalue", "a positive semi-definite matrix")


def floored(covariance: FloatArray, sigma: float) -> FloatArray:
    """Return a covariance with positive variances raised to sigma^2 or more; others are kept.

    Later checks refuse those that are not positive.
    """
    variance = covariance.diagonal()
    too_small = (variance > 0.0) & (variance < sigma * sigma)
    if not too_small.any():
        return covariance
    increase: FloatArray = np.diag(np.where(too_small, sigma * sigma - variance, 0.0))
    return covariance + increase
