"""Square roots of covariances: a prior's information, and a graph's covariances as they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stario.fusion.filter.estimates import Estimate, plain_covariances
from stario.fusion.filter.jacobians import ACTUAL, ASSUMED, symmetric
from stario.fusion.values.state import NavState, changed
from stario.sequences.sequence import FloatArray

_MIN_VARIANCE, _MIN_EIGENVALUE = 1e-16, 1e-12
"""Lower bounds of variances and of the eigenvalues of normalised covariances: less is rounding."""


def root_information(covariance: FloatArray) -> FloatArray:
    """Return a square root (n, n) of a covariance's inverse, r with r^T r = P^-1."""
    sigma = np.sqrt(np.maximum(covariance.diagonal(), _MIN_VARIANCE))
    roots, axes = _semi_axes(covariance / np.outer(sigma, sigma))
    return np.asarray((axes / roots).T / sigma)


def with_actual_covariances(
    states: Sequence[NavState], estimates: Sequence[Estimate], turns: FloatArray | None = None
) -> list[NavState]:
    """Return a graph's states, whose measurements are the filter's, with covariances as they are.

    The graph assumes white errors of the network, as the filter's gains do. What the errors'
    correlation makes of the filter's covariance P, a linear map T with T P T^T = Q makes of the
    graph's. T is the symmetric one, which is closest to the identity (in units of P's sigmas):

        T = P^-1/2 (P^1/2 Q P^1/2)^1/2 P^-1/2

    Args:
        states: N states of the graph, with the covariances that it assumes.
        estimates: N estimates of the filter at the same times.
        turns: (N, 15, 15) rotations from the filter's frame to that of the states; None if they are
            the same.
    """
    P, Q = (plain_covariances(estimates, which) for which in (ASSUMED, ACTUAL))
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    root, inverse_root = _roots(P / scale)
    T = inverse_root @ _roots(root @ (Q / scale) @ root)[0] @ inverse_root
    T = sigma[:, :, None] * T / sigma[:, None, :]
    if turns is not None:
        T = turns @ T @ np.swapaxes(turns, 1, 2)
    covariance = np.array([state.covariance for state in states])
    covariance = symmetric(T @ covariance @ T.transpose(0, 2, 1))
    return [changed(s, covariance=c) for s, c in zip(states, covariance, strict=True)]


def _roots(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the symmetric square roots (N, n, n) of covariances and of their inverses."""
    roots, axes = _semi_axes(P)
    transposed = axes.transpose(0, 2, 1)
    return (axes * roots) @ transposed, (axes / roots) @ transposed


def _semi_axes(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the semi-axes (..., 1, n) of normalised covariances, and their directions."""
    values, axes = np.linalg.eigh(P)
    return np.sqrt(np.maximum(values, _MIN_EIGENVALUE))[..., None, :], axes
