"""Estimates that the filter gives out, and their conversion to plain errors.

All estimates of a recording are converted at its end, many at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.jacobians import CLONED, POSITION, REPORTED, plain_covariance
from stario.fusion.values.state import NavState, SmoothedPose, changed
from stario.sequences.sequence import FloatArray

_CHUNK = 2000
"""Number of estimates converted at a time: all of an hour would take hundreds of megabytes."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """A filter's estimate of its newest state; or of a clone, which has no velocity and biases.

    Attributes:
        time: [s].
        X: (3, 5) R_WB, v_W, p_W, the position relative to `origin_W`.
        origin_W: (3,) [m].
        b_g: (3,) gyroscope bias [rad/s].
        b_a: (3,) accelerometer bias [m/s^2].
        covariances: (2, 15, 15) of theta, rho_v, rho_p, d_bg, d_ba, as assumed for the gains and
            as it is (see `EkfState`); zero for what a clone does not have.
        in_gap: as in `NavState`.
        map_frame: as in `NavState`.
        way_variance: variance per horizontal axis of the way in vehicles that no position has
            measured yet [m^2], of which the covariances know nothing.
    """

    time: float
    X: FloatArray
    origin_W: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    covariances: FloatArray
    in_gap: bool = False
    map_frame: int = 0
    way_variance: float = 0.0


def plain_covariances(estimates: Sequence[Estimate], which: int = REPORTED) -> FloatArray:
    """Return covariances (N, n, n) of plain errors in W's axes, each true minus estimate.

    Args:
        estimates: N estimates.
        which: `REPORTED` or `GAIN`.
    """
    P = np.array([e.covariances[which] for e in estimates])
    X = np.array([e.X for e in estimates])
    return plain_covariance(P, X[:, :, 3:].transpose(0, 2, 1))


def nav_states(estimates: Sequence[Estimate], which: int = REPORTED) -> list[NavState]:
    """Convert estimates to `NavState`; arguments as `plain_covariances`."""
    states = []
    for k in range(0, len(estimates), _CHUNK):
        part = estimates[k : k + _CHUNK]
        for e, covariance in zip(part, plain_covariances(part, which), strict=True):
            pose = e.X[:, :3], e.X[:, 3], e.X[:, 4] + e.origin_W
            biases = e.b_g.copy(), e.b_a.copy()  # those of `e` are the filter's own
            state = NavState(e.time, *pose, *biases, covariance, e.in_gap, e.map_frame)
            states.append(with_unknown_way(state, e.way_variance) if which == REPORTED else state)
    return states


def with_unknown_way(state: NavState, variance: float) -> NavState:
    """Return a state whose position has one more error, of a variance per horizontal axis [m^2]."""
    if not variance:
        return state
    way = np.zeros(len(state.covariance))
    way[POSITION.start : POSITION.start + 2] = variance
    return changed(state, covariance=state.covariance + np.diag(way))


def smoothed_pose(clone: NavState) -> SmoothedPose:
    """Return the pose of a clone, without the velocity and biases that it does not have."""
    covariance = clone.covariance[np.ix_(CLONED, CLONED)]
    return SmoothedPose(clone.time, clone.R_WB, clone.p_W, covariance, clone.map_frame)
