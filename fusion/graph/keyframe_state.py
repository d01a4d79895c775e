"""A keyframe's state: conversion to and from gtsam, and right-invariant error."""

from __future__ import annotations

from typing import Any, NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, O, V, X
from scipy.linalg import block_diag

from stario.fusion.filter.jacobians import invariant_from_local
from stario.fusion.values.lie import log_se23
from stario.fusion.values.state import NavState
from stario.sequences.sequence import FloatArray


class KeyframeState(NamedTuple):
    """State of a keyframe."""

    R_WB: FloatArray
    """Attitude (3, 3)."""
    v_W: FloatArray
    """Velocity (3,) [m/s]."""
    p_W: FloatArray
    """Position (3,) [m]."""
    b_g: FloatArray
    """Gyroscope bias (3,) [rad/s]."""
    b_a: FloatArray
    """Accelerometer bias (3,) [m/s^2]."""
    offset: float | None = None
    """Height by the pressure less that of the track [m]; None without a barometer."""

    @classmethod
    def from_nav(cls, state: NavState) -> KeyframeState:
        """Return the keyframe's part of a state."""
        return cls(state.R_WB, state.v_W, state.p_W, state.b_g, state.b_a)

    @classmethod
    def of(cls, values: Any, k: int) -> KeyframeState:
        """Read keyframe k from gtsam `Values`."""
        pose, bias = values.atPose3(X(k)), values.atConstantBias(B(k))
        return cls(
            pose.rotation().matrix(),
            values.atVector(V(k)),
            pose.translation(),
            bias.gyroscope(),
            bias.accelerometer(),
            float(values.atVector(O(k))[0]) if values.exists(O(k)) else None,
        )

    def insert_into(self, values: Any, k: int) -> None:
        """Insert this state into gtsam `Values` as keyframe k."""
        values.insert(X(k), gtsam.Pose3(gtsam.Rot3(self.R_WB), self.p_W))
        values.insert(V(k), self.v_W)
        values.insert(B(k), gtsam.imuBias.ConstantBias(self.b_a, self.b_g))
        if self.offset is not None:
            values.insert(O(k), np.array([self.offset]))

    def keys(self, k: int) -> list[int]:
        """Return gtsam's keys of this state as keyframe k."""
        return [X(k), V(k), B(k), *([] if self.offset is None else [O(k)])]

    def blocks(self, k: int, H: FloatArray) -> list[tuple[int, FloatArray]]:
        """Split a Jacobian (m, n) with respect to this state, keyframe k, by gtsam's keys."""
        keys = self.keys(k)
        return list(zip(keys, np.split(H, [6, 9, 15][: len(keys) - 1], axis=1), strict=True))

    def error_from(self, other: KeyframeState) -> FloatArray:
        """Return the right-invariant error (15,), or (16,) with offsets, from another state.

        In order: theta, rho_v, rho_p, b_g, b_a, offset.
        """
        R = self.R_WB @ other.R_WB.T
        pose = log_se23(R, self.v_W - R @ other.v_W, self.p_W - R @ other.p_W)
        rest = [self.b_g - other.b_g, self.b_a - other.b_a]
        if self.offset is not None and other.offset is not None:
            rest.append(np.array([self.offset - other.offset]))
        return np.concatenate([pose, *rest])

    def invariant_from_local(self) -> FloatArray:
        """Return the map from gtsam's w, dp, dv, b_a, b_g, offset to the invariant error."""
        matrix = invariant_from_local(self.R_WB, self.v_W, self.p_W)
        matrix[3:6, 6:9] = np.eye(3)  # a graph's velocities are in W
        return matrix if self.offset is None else block_diag(matrix, 1.0)
