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
        P: (15, 15) covariance of theta, rho_v, rho_p, d_bg, d_ba; for a clone (6, 6) of theta,
            rho_p.
        scale_sensitivity: (15,) or (6,) sensitivity of these errors to the network's scale error,
            which `P` does not contain.
        in_gap: as in `NavState`.
        map_frame: as in `NavState`.
    """

    time: float
    X: FloatArray
    origin_W: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    P: FloatArray
    scale_sensitivity: FloatArray
    in_gap: bool = False
    map_frame: int = 0


def plain_covariances(estimates: Sequence[Estimate], scale_sigma: float = 0.0) -> FloatArray:
    """Return covariances (N, n, n) of plain errors in W's axes, each true minus estimate.

    Args:
        estimates: N estimates of newest states, or of clones.
        scale_sigma: standard deviation of the network's scale error, which adds to them.
    """
    names = ("P", "X", "scale_sensitivity")
    P, X, J = (np.array([getattr(e, name) for e in estimates]) for name in names)
    P = P + scale_sigma**2 * J[:, :, None] * J[:, None, :]
    return plain_covariance(P, X[:, :, 3:].transpose(0, 2, 1))


def plain_scale_sensitivities(estimates: Sequence[Estimate]) -> FloatArray:
    """Return the sensitivities (N, 15) of plain errors to the network's scale error."""
    J, X = (np.array([getattr(e, name) for e in estimates]) for name in ("scale_sensitivity", "X"))
    theta = J[:, :3]
    J[:, 3:6] += np.cross(theta, X[:, :, 3])  # -[v]x theta
    J[:, 6:9] += np.cross(theta, X[:, :, 4])
    return J


def nav_states(estimates: Sequence[Estimate], scale_sigma: float = 0.0) -> list[NavState]:
    """Convert estimates of newest states to `NavState`; arguments as `plain_covariances`."""
    states = []
    for k in range(0, len(estimates), _CHUNK):
        part = estimates[k : k + _CHUNK]
        for e, covariance in zip(part, plain_covariances(part, scale_sigma), strict=True):
            pose = e.X[:, :3], e.X[:, 3], e.X[:, 4] + e.origin_W
            biases = e.b_g.copy(), e.b_a.copy()  # those of `e` are the filter's own
            states.append(NavState(e.time, *pose, *biases, covariance, e.in_gap, e.map_frame))
    return states


def with_error(state: NavState, error: FloatArray) -> NavState:
    """Return a state whose covariance contains one more error (15,), of unknown sign."""
    return changed(state, covariance=state.covariance + np.outer(error, error))


def smoothed_poses(clones: Sequence[Estimate], scale_sigma: float) -> list[SmoothedPose]:
    """Convert estimates of clones to `SmoothedPose`; arguments as `plain_covariances`."""
    if not clones:
        return []
    return [
        SmoothedPose(e.time, e.X[:, :3], e.X[:, 3] + e.origin_W, covariance, e.map_frame)
        for e, covariance in zip(clones, plain_covariances(clones, scale_sigma), strict=True)
    ]
