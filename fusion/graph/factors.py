"""Measurement terms of the graph's keyframes, linearised by hand.

Every term gives its residual (measured minus predicted) and the Jacobians of its prediction; the
graph whitens them, down-weights possible outliers and passes gtsam a `JacobianFactor` in C++, again
in every round of the optimisation. gtsam's own factors would suffice for position and velocity
only: none models a displacement that turns with the yaw of a pose and not with its tilt (README.md,
"Graph factors").

Tangent of a keyframe, as in gtsam: pose R exp(w), p + R dp in the order w, dp; velocity additive;
biases additive, accelerometer first. Keys: x pose, v velocity, b biases, o barometer's offset.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from gtsam.symbol_shorthand import B, O, V, X

from stario.fusion.filter.jacobians import plain_covariance, yaw_jacobian
from stario.fusion.graph.covariances import root_information
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.fusion.values.lie import e3_cross, twist, yaw_rotation
from stario.fusion.values.state import NavState
from stario.sequences.attitude.so3 import skew
from stario.sequences.sequence import FloatArray

_EYE = np.eye(3)

Linearised = tuple[FloatArray, list[tuple[int, FloatArray]]]
"""Residual (m,) of a term and the Jacobian blocks (key, (m, width)) of its prediction."""


class Term(Protocol):
    """A measurement of one or more keyframes."""

    @property
    def keyframes(self) -> tuple[int, ...]:
        """Numbers of the measured keyframes, in order."""

    @property
    def covariance(self) -> FloatArray:
        """Covariance (m, m), in the axes of the residual."""

    def linearise(self, values: Any) -> Linearised:
        """Linearise at gtsam `Values`."""


@dataclass(frozen=True, eq=False)
class AtKeyframe:
    """Base of the measurements of one keyframe `k`, the last one at or before the measurement."""

    k: int

    @property
    def keyframes(self) -> tuple[int, ...]:
        """The measured keyframe."""
        return (self.k,)


@dataclass(frozen=True, eq=False)
class Between:
    """Base of the measurements of two keyframes, `i` and the later `j`."""

    i: int
    j: int

    @property
    def keyframes(self) -> tuple[int, ...]:
        """Both keyframes."""
        return self.i, self.j


@dataclass(frozen=True, eq=False)
class Prior:
    """Joint prior on successive keyframes: root error = offset, with unit white noise.

    The error is right-invariant, so that a turn about the vertical and a shift are the same
    directions wherever the keyframes have moved since: the marginalised information cannot gain yaw
    by being linearised at a different point from the rest of the graph. In gtsam's own tangent it
    does, and a stream's yaw is then reported as twice as certain as it is.

    Attributes:
        k: number of the first keyframe.
        reference: n states, of keyframe k and its successors, from which the error is measured.
        root: (m, ...) square-root information, with the columns of one keyframe after the other.
        offset: (m,) right-hand side.
    """

    k: int
    reference: tuple[KeyframeState, ...]
    root: FloatArray
    offset: FloatArray

    @classmethod
    def of(cls, k: int, state: NavState) -> Prior:
        """Return the prior of keyframe k from a state."""
        vectors = np.stack([state.v_W, state.p_W])
        root = root_information(plain_covariance(state.covariance, -vectors))
        return cls(k, (KeyframeState.from_nav(state),), root, np.zeros(len(root)))

    @property
    def keyframes(self) -> tuple[int, ...]:
        """All keyframes of the prior."""
        return tuple(range(self.k, self.k + len(self.reference)))

    @property
    def covariance(self) -> FloatArray:
        """Identity: the root is already white."""
        return np.eye(len(self.offset))

    def linearise(self, values: Any) -> Linearised:
        """Linearise in the rows of the root."""
        residual, blocks, rest = self.offset, [], self.root
        for k, reference in zip(self.keyframes, self.reference, strict=True):
            state = KeyframeState.of(values, k).like(reference)
            error = state.error_from(reference)
            root, rest = rest[:, : len(error)], rest[:, len(error) :]
            residual = residual - root @ error
            blocks += state.blocks(k, root @ state.invariant_from_local())
        return residual, blocks


@dataclass(frozen=True, eq=False)
class Displacement(Between):
    """The network's displacement from keyframe i to keyframe j.

    The network is given the window in a levelled frame N, whose yaw psi relative to W is that of
    R_WB R_NB^T at the window's start: p_j - p_i = R_z(psi) (d_N + n). It turns with the yaw of
    pose i alone, as in the filter's `update_displacement`; a `BetweenFactorPose3` would also infer
    tilt from it, which on some recordings doubles the error.

    Attributes:
        d_N: (3,) displacement [m].
        R_NB: (3, 3) levelled attitude at the window's start.
        covariance: (3, 3) [m^2] in N.
    """

    d_N: FloatArray
    R_NB: FloatArray
    covariance: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in the axes of N."""
        (R_i, p_i), (R_j, p_j) = _pose(values, self.i), _pose(values, self.j)
        R_NW = yaw_rotation(R_i @ self.R_NB.T).T
        d_W = p_j - p_i
        H_i, H_j = np.zeros((3, 6)), np.zeros((3, 6))
        H_i[:, :3] = -np.outer(R_NW @ e3_cross(d_W), R_i[2])
        H_i[:, 3:] = -R_NW @ R_i
        H_j[:, 3:] = R_NW @ R_j
        return self.d_N - R_NW @ d_W, [(X(self.i), H_i), (X(self.j), H_j)]


@dataclass(frozen=True, eq=False)
class SamePlace(Between):
    """The device is at keyframe j where it was at keyframe i.

    Attributes:
        covariance: (3, 3) [m^2].
    """

    covariance: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in W."""
        (R_i, p_i), (R_j, p_j) = _pose(values, self.i), _pose(values, self.j)
        H_i, H_j = np.zeros((3, 6)), np.zeros((3, 6))
        H_i[:, 3:], H_j[:, 3:] = -R_i, R_j
        return p_i - p_j, [(X(self.i), H_i), (X(self.j), H_j)]


@dataclass(frozen=True, eq=False)
class Position(AtKeyframe):
    """A position some time after a keyframe: p_k + dt v_k + dp_W.

    Attributes:
        p_W: (3,) position [m].
        covariance: (3, 3) [m^2].
        dt: time since the keyframe [s].
        dp_W: (3,) displacement beyond p_k + dt v_k until then, by the IMU [m].
    """

    p_W: FloatArray
    covariance: FloatArray
    dt: float
    dp_W: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in W."""
        R, p = _pose(values, self.k)
        predicted = p + self.dt * values.atVector(V(self.k)) + self.dp_W
        H = np.zeros((3, 6))
        H[:, 3:] = R
        return self.p_W - predicted, [(X(self.k), H), (V(self.k), self.dt * _EYE)]


@dataclass(frozen=True, eq=False)
class Height:
    """The height by the air's pressure near a keyframe, and its offset's walk since another one.

    Attributes:
        i: the keyframe of the height before; None for the first one, whose offset is free.
        k: number of the keyframe.
        height: [m].
        dt: time since the keyframe [s].
        covariance: of the height and, unless it is the first one, of the walk [m^2].
    """

    i: int | None
    k: int
    height: float
    dt: float
    covariance: FloatArray

    @property
    def keyframes(self) -> tuple[int, ...]:
        """Both keyframes, or the only one."""
        return (self.k,) if self.i is None else (self.i, self.k)

    def linearise(self, values: Any) -> Linearised:
        """Linearise along the vertical."""
        (R, p), v = _pose(values, self.k), values.atVector(V(self.k))
        offset = float(values.atVector(O(self.k))[0])
        rows = len(self.covariance)
        H_x, H_v, H_o = np.zeros((rows, 6)), np.zeros((rows, 3)), np.ones((rows, 1))
        H_x[0, 3:], H_v[0, 2] = R[2], self.dt
        blocks = [(X(self.k), H_x), (V(self.k), H_v), (O(self.k), H_o)]
        residual = [self.height - p[2] - self.dt * v[2] - offset]
        if self.i is not None:
            residual.append(float(values.atVector(O(self.i))[0]) - offset)
            blocks.insert(0, (O(self.i), np.array([[0.0], [-1.0]])))
        return np.array(residual), blocks


@dataclass(frozen=True, eq=False)
class Velocity(AtKeyframe):
    """A velocity some time after a keyframe: v_k + dv_W.

    Attributes:
        v_W: (3,) velocity [m/s].
        covariance: (3, 3) [m^2/s^2].
        dv_W: (3,) change of velocity until then, by the IMU [m/s].
    """

    v_W: FloatArray
    covariance: FloatArray
    dv_W: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in W."""
        predicted = values.atVector(V(self.k)) + self.dv_W
        return self.v_W - predicted, [(V(self.k), _EYE)]


@dataclass(frozen=True, eq=False)
class Yaw(AtKeyframe):
    """A yaw some time after a keyframe: that of R_k `rotation`.

    It changes with the tilt as well, at a tilt of 90 degrees by as much, as in the filter's
    `update_yaw`.

    Attributes:
        yaw: yaw as defined by `yaw_twist` [rad].
        covariance: (1, 1) [rad^2].
        rotation: (3, 3) from the body at that time to that at the keyframe, by the IMU.
    """

    yaw: float
    covariance: FloatArray
    rotation: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in W."""
        R_k, _ = _pose(values, self.k)
        R = R_k @ self.rotation
        residual = math.remainder(self.yaw - math.atan2(*twist(R)), 2.0 * math.pi)
        H = np.zeros((1, 6))
        H[:, :3] = yaw_jacobian(R)[0][1] @ R_k
        return np.array([residual]), [(X(self.k), H)]


@dataclass(frozen=True, eq=False)
class Tilt(AtKeyframe):
    """The upward direction at a keyframe: up_B x R^T e3 is zero.

    Attributes:
        up_B: (3,) unit vector.
        covariance: (3, 3) [rad^2]; the component along up_B has no information.
    """

    up_B: FloatArray
    covariance: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in B."""
        R, _ = _pose(values, self.k)
        up, H = skew(self.up_B), np.zeros((3, 6))
        H[:, :3] = up @ skew(R[2])
        return -up @ R[2], [(X(self.k), H)]


@dataclass(frozen=True, eq=False)
class GyroBias(AtKeyframe):
    """The gyroscope's bias, measured at rest, by a prior or by the magnetic field.

    Attributes:
        b_g: (3,) bias [rad/s].
        covariance: (3, 3) [rad^2/s^2].
    """

    b_g: FloatArray
    covariance: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in B."""
        residual = self.b_g - values.atConstantBias(B(self.k)).gyroscope()
        return residual, [(B(self.k), np.eye(3, 6, k=3))]


def _pose(values: Any, k: int) -> tuple[FloatArray, FloatArray]:
    pose = values.atPose3(X(k))
    return pose.rotation().matrix(), pose.translation()
