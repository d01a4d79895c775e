"""Estimates as a filter holds them, and as callers get them.

A filter's error is right-invariant, callers get plain errors. One estimate is turned into the
other as many are: those of a recording all at its end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.jacobians import plain_covariance
from stario.fusion.lie import FloatArray
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
        in_gap: as in `NavState`.
        map_frame: as in `NavState`.
    """

    time: float
    X: FloatArray
    origin_W: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    P: FloatArray
    in_gap: bool = False
    map_frame: int = 0


def plain_covariances(estimates: Sequence[Estimate]) -> FloatArray:
    """(N, n, n) of errors about W's axes, each true minus estimate."""
    P, X = (np.array([getattr(e, name) for e in estimates]) for name in ("P", "X"))
    return plain_covariance(P, X[:, :, 3:].transpose(0, 2, 1))


def nav_states(estimates: Sequence[Estimate]) -> list[NavState]:
    """The newest states as callers get them."""
    parts = range(0, len(estimates), _AT_ONCE)
    return [state for k in parts for state in _nav_states(estimates[k : k + _AT_ONCE])]


def _nav_states(estimates: Sequence[Estimate]) -> list[NavState]:
    return [
        NavState(
            e.time,
            e.X[:, :3],
            e.X[:, 3],
            e.X[:, 4] + e.origin_W,
            e.b_g,
            e.b_a,
            covariance,
            e.in_gap,
            e.map_frame,
        )
        for e, covariance in zip(estimates, plain_covariances(estimates), strict=True)
    ]


def smoothed_poses(clones: Sequence[Estimate]) -> list[SmoothedPose]:
    """Clones as callers get them."""
    if not clones:
        return []
    return [
        SmoothedPose(e.time, e.X[:, :3], e.X[:, 3] + e.origin_W, covariance, e.map_frame)
        for e, covariance in zip(clones, plain_covariances(clones), strict=True)
    ]
