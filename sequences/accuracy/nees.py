"""Consistency of errors with their covariance: NEES, its bounds, and the NEES of positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.accuracy.metrics import Alignment, align, pose_errors
from stario.sequences.arrays import check_type
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, Trajectory


@dataclass(frozen=True, eq=False)
class PositionNees:
    """3-D position NEES of a track: time (M,) [s], nees (M,), and its mean and median."""

    time: FloatArray
    nees: FloatArray
    mean: float
    median: float


def nees(error: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the normalised estimation error squared, e^T P^-1 e: chi-square(k) if P is correct.

    Args:
        error: (N, k).
        covariance: (N, k, k), in the squared units of `error`.

    Returns:
        (N,), dimensionless.

    Raises:
        InputError: a covariance is not positive definite.
    """
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        row = int(np.argmax([np.linalg.eigvalsh(P).min() <= 0 for P in covariance]))
        raise InputError(
            "covariance", f"row {row} not positive definite", "positive definite matrices"
        ) from None
    whitened = np.linalg.solve(factor, error[..., None])[..., 0]
    return np.asarray(np.sum(whitened**2, axis=1), dtype=np.float64)


def nees_bounds(dof: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
    """Return bounds of the mean NEES (or NIS) of a consistent estimator over independent samples.

    Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking and Navigation, 5.4.

    Args:
        dof: length of the error vector, which is the expectation of the mean.
        runs: number of independent samples averaged; poses of one track are not independent.
        confidence: probability between the bounds.
    """
    tail = (1 - confidence) / 2
    low, high = (chi2_quantile(p, dof * runs) / runs for p in (tail, 1 - tail))
    return low, high


def position_nees(
    estimate: Trajectory, truth: Trajectory, alignment: Alignment = "first"
) -> PositionNees:
    """Return the NEES of a track's 3-D position under its own covariance.

    Poses with a covariance of exactly zero, such as a start that is the origin by definition,
    are skipped. Alignment removes the contribution of the initial yaw from the error but not from
    the covariance: to check that too, pass the estimate in the truth's frame and "none".

    Raises:
        InputError: no overlap, no covariance, one that is not positive definite, or an argument has
            the wrong type.
    """
    check_type("estimate", estimate, Trajectory, "pass track.trajectory")
    if estimate.position_covariance_W is None:
        raise InputError("estimate.position_covariance_W", "None", "(N, 3, 3) [m^2]")
    errors = pose_errors(align(estimate, truth, alignment), truth)
    covariance = errors.estimate.position_covariance_W
    assert covariance is not None  # alignment and selection keep it
    known = covariance.any(axis=(1, 2))
    if not known.any():
        raise InputError("estimate.position_covariance_W", "only zeros", "covariances [m^2]")
    values = nees(errors.position_W[known], covariance[known])
    time = errors.estimate.time[known]
    return PositionNees(time, values, float(values.mean()), float(np.median(values)))
