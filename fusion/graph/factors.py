"""The graph's terms, linearised by hand.

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
from typing import Any

import numpy as np
from gtsam.symbol_shorthand import B, O, V, X

from stario.fusion.filter.jacobians import plain_covariance, yaw_jacobian
from stario.fusion.graph.covariances import root_information
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.fusion.graph.term import Linearised, Term
from stario.fusion.values.lie import about_vertical, e3_cross, twist, yaw_rotation
from stario.fusion.values.state import NavState
from stario.sequences.attitude.so3 import log_so3, skew
from stario.sequences.sequence import FloatArray

_EYE = np.eye(3)


def _pose(values: Any, k: int) -> tuple[FloatArray, FloatArray]:
    pose = values.atPose3(X(k))
    return pose.rotation().matrix(), pose.translation()


def _by_turn(H: FloatArray) -> FloatArray:
    """Return a Jacobian (m, 6) of a pose, given that of its rotation (m, 3)."""
    whole = np.zeros((len(H), 6))
    whole[:, :3] = H
    return whole


def _by_shift(H: FloatArray) -> FloatArray:
    """Return a Jacobian (m, 6) of a pose, given that of its translation (m, 3)."""
    whole = np.zeros((len(H), 6))
    whole[:, 3:] = H
    return whole


@dataclass(frozen=True, eq=False)
class Prior(Term):
    """Joint prior on successive keyframes: root error = offset, with unit white noise.

    The error is right-invariant, so that a turn about the vertical and a shift are the same
    directions wherever the keyframes have moved since: the marginalised information cannot gain yaw
    by being linearised at a different point from the rest of the graph. In gtsam's own tangent it
    does, and a stream's yaw is then reported as twice as certain as it is.

    Attributes:
        reference: states of the keyframes, from which the error is measured.
        root: (m, ...) square-root information, with the columns of one keyframe after the other.
        offset: (m,) right-hand side.
    """

    reference: tuple[KeyframeState, ...]
    root: FloatArray
    offset: FloatArray

    @classmethod
    def of(cls, k: int, state: NavState) -> Prior:
        """Return the prior of keyframe k from a state."""
        vectors = np.stack([state.v_W, state.p_W])
        root = root_information(plain_covariance(state.covariance, -vectors))
        return cls.white(k, (KeyframeState.from_nav(state),), root, np.zeros(len(root)))

    @classmethod
    def white(
        cls, k: int, reference: tuple[KeyframeState, ...], root: FloatArray, offset: FloatArray
    ) -> Prior:
        """Return the prior of keyframe k and its successors, whose rows are white."""
        keyframes = tuple(range(k, k + len(reference)))
        return cls(keyframes, np.eye(len(offset)), reference, root, offset)

    def linearise(self, values: Any) -> Linearised:
        """Linearise in the rows of the root."""
        residual, blocks, rest = self.offset, [], self.root
        for k, reference in zip(self.keyframes, self.reference, strict=True):
            state = KeyframeState.of(values, k)
            if reference.offset is None:
                state = state._replace(offset=None)
            error = state.error_from(reference)
            root, rest = rest[:, : len(error)], rest[:, len(error) :]
            residual = residual - root @ error
            blocks += state.blocks(k, root @ state.invariant_from_local())
        return residual, blocks


@dataclass(frozen=True, eq=False)
class Displacement(Term):
    """The network's displacement between two keyframes i and j [m], in N.

    The network is given the window in a levelled frame N, whose yaw psi relative to W is that of
    R_WB R_NB^T at the window's start: p_j - p_i = R_z(psi) (d_N + n). It turns with the yaw of
    pose i alone, as in the filter's `update_displacement`; a `BetweenFactorPose3` would also infer
    tilt from it, which on some recordings doubles the error.

    Attributes:
        d_N: (3,) displacement [m].
        R_NB: (3, 3) levelled attitude at the window's start.
    """

    d_N: FloatArray
    R_NB: FloatArray

    outlier_power = 0.75
    """False ones come in a row and count less: five seconds of them, off by 1 m, cost 0.08 to 0.24
    m in the three walks on which this was chosen, and 0.5 to 0.6 m with a half."""

    def linearise(self, values: Any) -> Linearised:
        """Linearise in the axes of N."""
        i, j = self.keyframes
        (R_i, p_i), (R_j, p_j) = _pose(values, i), _pose(values, j)
        R_NW = yaw_rotation(R_i @ self.R_NB.T).T
        d_W = p_j - p_i
        H_i = _by_shift(-R_NW @ R_i)
        H_i[:, :3] = -np.outer(R_NW @ e3_cross(d_W), R_i[2])
        return self.d_N - R_NW @ d_W, [(X(i), H_i), (X(j), _by_shift(R_NW @ R_j))]


@dataclass(frozen=True, eq=False)
class SamePlace(Term):
    """The device is at the second keyframe where it was at the first [m]."""

    def linearise(self, values: Any) -> Linearised:
        """Linearise in W."""
        i, j = self.keyframes
        (R_i, p_i), (R_j, p_j) = _pose(values, i), _pose(values, j)
        return p_i - p_j, [(X(i), _by_shift(-R_i)), (X(j), _by_shift(R_j))]


@dataclass(frozen=True, eq=False)
class Position(Term):
    """A position some time after a keyframe: p_k + dt v_k + dp_W.

    Attributes:
        p_W: (3,) position [m].
        dt: time since the keyframe [s].
        dp_W: (3,) displacement beyond p_k + dt v_k until then, by the IMU [m].
    """

    p_W: FloatArray
    dt: float
    dp_W: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in W."""
        (k,) = self.keyframes
        R, p = _pose(values, k)
        predicted = p + self.dt * values.atVector(V(k)) + self.dp_W
        return self.p_W - predicted, [(X(k), _by_shift(R)), (V(k), self.dt * _EYE)]


@dataclass(frozen=True, eq=False)
class Height(Term):
    """The height by the air's pressure near the last keyframe, which has the barometer's offset.

    If there is a keyframe before it, that of the height before, its covariance is that of the
    height and of the offset's walk since then [m^2]; the first offset is free.

    Attributes:
        height: [m].
        dt: time since the keyframe [s].
    """

    height: float
    dt: float

    def linearise(self, values: Any) -> Linearised:
        """Linearise along the vertical."""
        *before, k = self.keyframes
        (R, p), v = _pose(values, k), values.atVector(V(k))
        offset = float(values.atVector(O(k))[0])
        rows = len(self.covariance)
        H_x, H_v, H_o = np.zeros((rows, 6)), np.zeros((rows, 3)), np.ones((rows, 1))
        H_x[0, 3:], H_v[0, 2] = R[2], self.dt
        blocks = [(X(k), H_x), (V(k), H_v), (O(k), H_o)]
        residual = [self.height - p[2] - self.dt * v[2] - offset]
        for i in before:
            residual.append(float(values.atVector(O(i))[0]) - offset)
            blocks.insert(0, (O(i), np.array([[0.0], [-1.0]])))
        return np.array(residual), blocks


@dataclass(frozen=True, eq=False)
class Velocity(Term):
    """A velocity some time after a keyframe: v_k + dv_W.

    Attributes:
        v_W: (3,) velocity [m/s].
        dv_W: (3,) change of velocity until then, by the IMU [m/s].
    """

    v_W: FloatArray
    dv_W: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in W."""
        (k,) = self.keyframes
        return self.v_W - (values.atVector(V(k)) + self.dv_W), [(V(k), _EYE)]


@dataclass(frozen=True, eq=False)
class Yaw(Term):
    """A yaw some time after a keyframe: that of R_k `rotation`.

    It changes with the tilt as well, at a tilt of 90 degrees by as much, as in the filter's
    `update_yaw`.

    Attributes:
        yaw: yaw as defined by `yaw_twist` [rad].
        rotation: (3, 3) from the body at that time to that at the keyframe, by the IMU.
    """

    yaw: float
    rotation: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in W."""
        (k,) = self.keyframes
        R_k, _ = _pose(values, k)
        R = R_k @ self.rotation
        residual = math.remainder(self.yaw - math.atan2(*twist(R)), 2.0 * math.pi)
        return np.array([residual]), [(X(k), _by_turn(yaw_jacobian(R)[0][1] @ R_k))]


@dataclass(frozen=True, eq=False)
class Tilt(Term):
    """The upward direction at a keyframe: up_B x R^T e3 is zero; along up_B it says nothing.

    Attributes:
        up_B: (3,) unit vector.
    """

    up_B: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in B."""
        (k,) = self.keyframes
        R, _ = _pose(values, k)
        up = skew(self.up_B)
        return -up @ R[2], [(X(k), _by_turn(up @ skew(R[2])))]


@dataclass(frozen=True, eq=False)
class GyroBias(Term):
    """The gyroscope's bias b_g (3,) [rad/s], measured at rest, by a prior or the magnetic field."""

    b_g: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in B."""
        (k,) = self.keyframes
        residual = self.b_g - values.atConstantBias(B(k)).gyroscope()
        return residual, [(B(k), np.eye(3, 6, k=3))]


@dataclass(frozen=True, eq=False)
class Bearing(Term):
    """A magnetic bearing, for a graph without states of the field (`filter.gained`).

    A combination of the errors of attitude and bias: weights^T (theta, b_g) = value.

    Attributes:
        R_WB: (3, 3) attitude from which theta counts.
        b_g: (3,) bias from which its error counts [rad/s].
        weights: (6,) of theta [rad] and bias [rad/s].
        value: measured combination.
    """

    R_WB: FloatArray
    b_g: FloatArray
    weights: FloatArray
    value: float

    def linearise(self, values: Any) -> Linearised:
        """Linearise for small theta."""
        (k,) = self.keyframes
        R, _ = _pose(values, k)
        off = values.atConstantBias(B(k)).gyroscope() - self.b_g
        error = np.concatenate([log_so3(R @ self.R_WB.T), off])
        residual = np.array([self.value - float(self.weights @ error)])
        H_x, H_b = _by_turn((self.weights[:3] @ R)[None]), _by_shift(self.weights[None, 3:])
        return residual, [(X(k), H_x), (B(k), H_b)]


@dataclass(frozen=True, eq=False)
class ConstantVelocity(Term):
    """Constant velocity and biases across a gap without samples, apart from a turn.

    The pedestrian turns about the vertical by psi, the yaw of R_j (R_i R_ij)^T, and the velocity
    with him. The tilt may change by any angle; `Tilt` determines the new one. In the axes of body
    i, so that neither psi nor a turn of the world is observed by being linearised where the
    residual is not zero:

        psi      R_i^T (R_z(psi)^T v_j - v_i)      R_i^T (R_z(psi)^T (p_j - p_i) - t v_i)

    and the changes of gyroscope and accelerometer bias.

    Attributes:
        seconds: length t of the gap [s].
        R_ij: (3, 3) rotation of the device as expected (`gap_rotation`).
    """

    seconds: float
    R_ij: FloatArray

    def linearise(self, values: Any) -> Linearised:
        """Linearise in the axes of body i; biases in B."""
        i, j = self.keyframes
        a, b = KeyframeState.of(values, i), KeyframeState.of(values, j)
        R, t, to_i = b.R_WB @ (a.R_WB @ self.R_ij).T, self.seconds, a.R_WB.T
        psi = math.atan2(*twist(R))
        back = about_vertical(-psi)
        ends = back @ np.column_stack([b.v_W, b.p_W - a.p_W])
        changes = to_i @ (ends - np.column_stack([a.v_W, t * a.v_W]))
        biases = b.b_g - a.b_g, b.b_a - a.b_a

        # A rotation of R_j by w turns R by R_j w; one of R_i by -R_j R_ij^T w.
        turned = to_i @ np.stack([ends[1], -ends[0], np.zeros(2)])  # -e3 x
        by_psi = np.concatenate([[1.0], turned[:, 0], turned[:, 1]])
        rotated = np.outer(by_psi, yaw_jacobian(R)[0][1] @ b.R_WB)
        pose_i, pose_j = np.zeros((13, 6)), np.zeros((13, 6))
        pose_i[:7, :3], pose_j[:7, :3] = -rotated @ self.R_ij.T, rotated
        pose_i[1:7, :3] += skew(changes.T).reshape(6, 3)
        pose_i[4:7, 3:], pose_j[4:7, 3:] = -to_i @ back @ a.R_WB, to_i @ back @ b.R_WB
        velocity, bias = np.eye(13, 3, k=-1), np.zeros((13, 6))
        bias[7:10, 3:], bias[10:, :3] = _EYE, _EYE
        by_v_i = -(velocity + t * np.eye(13, 3, k=-4)) @ to_i
        before = [(X(i), pose_i), (V(i), by_v_i), (B(i), -bias)]
        after = [(X(j), pose_j), (V(j), velocity @ to_i @ back), (B(j), bias)]
        return -np.concatenate([[psi], changes.T.ravel(), *biases]), before + after
