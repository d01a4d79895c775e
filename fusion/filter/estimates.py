"""Estimates of the filter, as kept until they are converted to plain errors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.jacobians import plain_covariance
from stario.fusion.state import NavState, SmoothedPose, changed
from stario.sequences.sequence import FloatArray

_CHUNK = 2000
"""Number of estimates converted at a time: all of an hour would take hundreds of megabytes."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A filter's estimate of its newest state, or of a clone.

    Attributes:
        time: [s].
        X: (3, 5) R_WB, v_W, p_W; for a clone (3, 4) R_WB, p_W. The position is relative to
            `origin_W`.
        origin_W: (3,) [m].
        b_g: (3,) gyroscope bias [rad/s].
        b_a: (3,) accelerometer bias [m/s^2].
        covariances: (2, 15, 15) of theta, rho_v, rho_p, d_bg, d_ba, or for a clone (2, 6, 6) of
            theta, rho_p: as assumed for the gains, and as it is (see `EkfState`).
        in_gap: as in `NavState`.
        map_frame: as in `NavState`.
    """

    time: float
    X: FloatArray
    origin_W: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    covariances: FloatArray
    in_gap: bool = False
    map_frame: int = 0


_MIN_EIGENVALUE = 1e-12
"""Smallest eigenvalue of a normalised covariance: what rounding leaves of it."""

ASSUMED, ACTUAL = 0, 1
"""Indices of the covariances: as assumed for the gains, and of the error that these gains leave."""


def plain_covariances(estimates: Sequence[Estimate], which: int = ACTUAL) -> FloatArray:
    """Return covariances (N, n, n) of plain errors in W's axes, each true minus estimate.

    Args:
        estimates: N estimates of newest states, or of clones.
        which: `ACTUAL` or `ASSUMED`.
    """
    P = np.array([e.covariances[which] for e in estimates])
    X = np.array([e.X for e in estimates])
    return plain_covariance(P, X[:, :, 3:].transpose(0, 2, 1))


def nav_states(estimates: Sequence[Estimate], which: int = ACTUAL) -> list[NavState]:
    """Convert estimates of newest states to `NavState`; arguments as `plain_covariances`."""
    states = []
    for k in range(0, len(estimates), _CHUNK):
        part = estimates[k : k + _CHUNK]
        for e, covariance in zip(part, plain_covariances(part, which), strict=True):
            pose = e.X[:, :3], e.X[:, 3], e.X[:, 4] + e.origin_W
            biases = e.b_g.copy(), e.b_a.copy()  # those of `e` are the filter's own
            states.append(NavState(e.time, *pose, *biases, covariance, e.in_gap, e.map_frame))
    return states


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
    covariance = T @ covariance @ T.transpose(0, 2, 1)
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    return [changed(s, covariance=c) for s, c in zip(states, covariance, strict=True)]


def _roots(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the symmetric square roots (N, n, n) of covariances and of their inverses."""
    values, axes = np.linalg.eigh(P)
    roots = np.sqrt(np.maximum(values, _MIN_EIGENVALUE))[:, None, :]
    transposed = axes.transpose(0, 2, 1)
    return (axes * roots) @ transposed, (axes / roots) @ transposed


def smoothed_poses(clones: Sequence[Estimate]) -> list[SmoothedPose]:
    """Convert estimates of clones to `SmoothedPose`."""
    if not clones:
        return []
    return [
        SmoothedPose(e.time, e.X[:, :3], e.X[:, 3] + e.origin_W, covariance, e.map_frame)
        for e, covariance in zip(clones, plain_covariances(clones), strict=True)
    ]
