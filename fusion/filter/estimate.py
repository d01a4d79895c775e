"""Estimates as a filter holds them, and as callers get them.

A filter's error is right-invariant and knows the wide one of the gyroscope's two priors. Callers
get both priors (`gyro_prior`) and plain errors. One estimate is turned into the other as many are:
those of a recording all at its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stario.fusion.error_state import plain_covariance
from stario.fusion.filter.gyro_prior import GyroPrior
from stario.fusion.lie import FloatArray, exp_times
from stario.fusion.state import NavState, SmoothedPose

_AT_ONCE = 2000
"""Estimates that are turned at once: an hour's would take hundreds of megabytes besides."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What a filter knows of its newest state, or of a clone.

    Attributes:
        time: [s].
        X: (3, 5) R_WB, v_W, p_W; of a clone (3, 4) R_WB, p_W. The position is counted from the
            origin.
        origin_W: (3,) [m].
        b_g: (3,) gyroscope bias [rad/s].
        b_a: (3,) accelerometer bias [m/s^2].
        P: (15, 15) of theta, rho_v, rho_p, d_bg, d_ba; of a clone (6, 6) of theta, rho_p.
        P_g: (15, 3) or (6, 3) of the same with d_bg.
        P_gg: (3, 3) of d_bg.
        in_gap: as in `NavState`.
        world: as in `NavState`.
    """

    time: float
    X: FloatArray
    origin_W: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    P: FloatArray
    P_g: FloatArray
    P_gg: FloatArray
    in_gap: bool = False
    map_frame: int = 0


class Moments(NamedTuple):
    """N estimates by both priors; the names are those of `Estimate`."""

    X: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    P: FloatArray

    @property
    def plain_covariance(self) -> FloatArray:
        """(N, n, n) of errors about the world's axes, each true minus estimate."""
        return plain_covariance(self.P, self.X[:, :, 3:].transpose(0, 2, 1))


def moments(estimates: Sequence[Estimate], prior: GyroPrior | None) -> Moments:
    """Estimates by both of the gyroscope's priors; None leaves them to the wide one."""
    X, b_g, b_a, P, P_g, P_gg = (
        np.array([getattr(e, name) for e in estimates])
        for name in ("X", "b_g", "b_a", "P", "P_g", "P_gg")
    )
    time = np.array([e.time for e in estimates])
    posterior = None if prior is None else prior.posterior(time, b_g, P_gg)
    if posterior is None:
        return Moments(X, b_g, b_a, P)
    dx, P = posterior.moments(P, P_g)
    first = X.shape[2] * 3 - 6  # theta and a rho for each vector come before the biases
    rho = dx[:, 3:first].reshape(len(X), -1, 3).transpose(0, 2, 1)
    X = exp_times(dx[:, :3], rho, X)
    if dx.shape[1] > first:
        b_g, b_a = b_g + dx[:, first : first + 3], b_a + dx[:, first + 3 :]
    return Moments(X, b_g, b_a, P)


def nav_states(estimates: Sequence[Estimate], prior: GyroPrior | None = None) -> list[NavState]:
    """The newest states as callers get them."""
    parts = range(0, len(estimates), _AT_ONCE)
    return [state for k in parts for state in _nav_states(estimates[k : k + _AT_ONCE], prior)]


def _nav_states(estimates: Sequence[Estimate], prior: GyroPrior | None) -> list[NavState]:
    table = moments(estimates, prior)
    rows = zip(estimates, *table, table.plain_covariance, strict=True)
    return [
        NavState(
            e.time,
            X[:, :3],
            X[:, 3],
            X[:, 4] + e.origin_W,
            b_g,
            b_a,
            covariance,
            e.in_gap,
            e.map_frame,
        )
        for e, X, b_g, b_a, _, covariance in rows
    ]


def smoothed_poses(clones: Sequence[Estimate], prior: GyroPrior) -> list[SmoothedPose]:
    """Clones as callers get them."""
    if not clones:
        return []
    table = moments(clones, prior)
    rows = zip(clones, table.X, table.plain_covariance, strict=True)
    return [
        SmoothedPose(e.time, X[:, :3], X[:, 3] + e.origin_W, covariance, e.map_frame)
        for e, X, covariance in rows
    ]
