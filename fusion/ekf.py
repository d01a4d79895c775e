"""State-cloning EKF with a right-invariant error, on filterpy's `ExtendedKalmanFilter`.

Error state: the current pose and biases, then a fixed number of cloned poses,
    theta, rho_v, rho_p, d_bg, d_ba | theta, rho_p of slot 0 | theta, rho_p of slot 1 | ...
with the meaning given in `preintegration`. The state itself lives on SE_2(3) and SE(3): filterpy's
`x` is the mean of the error, zero before each update, and moved into the state by the group's
exponential after it. An empty slot has zero covariance and zero columns in every Jacobian.

filterpy multiplies matrices of the full size. Here only the blocks that a step touches are computed
(core rows against the clones, one slot, a symmetric update of the measurement's rank), with the
same result; `benchmark.DenseEkf` runs filterpy's own algebra for comparison.

Sources: A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", 2017;
S. Roumeliotis, J. Burdick, "Stochastic cloning", 2002; W. Liu et al., "TLIO", 2020 (displacements
as measurements).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.linalg.blas import dgemm
from scipy.linalg.lapack import dpotrf, dtrtri

from stario.fusion.lie import FloatArray, exp_times, skew
from stario.fusion.preintegration import CORE, Segment
from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY

CLONE = 6
"""Size of the error state of one clone."""

GateMode = Literal["inflate", "reject"]
Block = tuple[int, FloatArray]
"""First column of the error state a Jacobian block stands at, and the block (m, width)."""


class UpdateResult(NamedTuple):
    """What became of one measurement.

    Attributes:
        nis: normalised innovation squared under the covariance given, before any inflation;
            not-a-number where it could not be computed.
        dof: dimension of the measurement, the expectation of `nis`.
        accepted: False where the state was left alone.
        scale: factor by which the measurement covariance was inflated (1: not gated).
        reason: why the measurement was refused; empty where it was accepted.
    """

    nis: float
    dof: int
    accepted: bool
    scale: float = 1.0
    reason: str = ""


class StateCloningEkf(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy is untyped
    """Right-invariant EKF over the current state and `slots` cloned poses.

    Use it as: `initialise`, then `propagate` segments, `clone` poses, `update_...`, `release`.
    filterpy's `P`, `R`, `y`, `z`, `S`, `SI`, `K`, `log_likelihood`, `mahalanobis`, `x_post`,
    `P_prior` and `P_post` describe the last step; `x` is the error's mean, always zero between
    steps. Its `predict` and `update` are the dense engine and not meant to be called from outside.

    Args:
        slots: number of poses that can be held at once.
        gravity: magnitude [m/s^2].
    """

    def __init__(self, slots: int, gravity: float = STANDARD_GRAVITY) -> None:
        if slots < 0:
            raise InputError("slots", repr(slots), "a number of clones >= 0")
        self._last_downdate: FloatArray | None = None
        super().__init__(dim_x=CORE + CLONE * slots, dim_z=3)
        self.gravity = gravity
        self.slots = slots
        self.P = np.zeros((self.dim_x, self.dim_x))
        self.Q = np.zeros((self.dim_x, self.dim_x))
        self.time = math.nan
        # Row 0 is the current pose, row 1 + s the clone in slot s: one stack to correct at once.
        # Columns R, v, p; a clone's v is not used and stays zero.
        self._X: FloatArray = np.tile(np.eye(3, 5), (slots + 1, 1, 1))
        self._b_g = np.zeros(3)
        self._b_a = np.zeros(3)
        self._clone_time: list[float | None] = [None] * slots

    # --- state -----------------------------------------------------------------------------------

    @property
    def R_WB(self) -> FloatArray:
        """Attitude (3, 3), body to world."""
        return np.array(self._X[0, :, :3])

    @property
    def v_W(self) -> FloatArray:
        """Velocity (3,) [m/s]."""
        return np.array(self._X[0, :, 3])

    @property
    def p_W(self) -> FloatArray:
        """Position (3,) [m]."""
        return np.array(self._X[0, :, 4])

    @property
    def b_g(self) -> FloatArray:
        """Gyroscope bias (3,) [rad/s]."""
        return self._b_g.copy()

    @property
    def b_a(self) -> FloatArray:
        """Accelerometer bias (3,) [m/s^2]."""
        return self._b_a.copy()

    def clone_pose(self, slot: int) -> tuple[FloatArray, FloatArray]:
        """R_WB (3, 3) and p_W (3,) of a clone as estimated now.

        Raises:
            InputError: the slot holds no clone.
        """
        self._check_slot(slot)
        return np.array(self._X[1 + slot, :, :3]), np.array(self._X[1 + slot, :, 4])

    def clone_time(self, slot: int) -> float | None:
        """Time [s] of the clone in a slot, None where it is empty."""
        return self._clone_time[slot]

    @property
    def core_covariance(self) -> FloatArray:
        """Covariance (15, 15) of the right-invariant error theta, rho_v, rho_p, d_bg, d_ba."""
        return np.array(self.P[:CORE, :CORE])

    def world_covariance(self) -> FloatArray:
        """Covariance (15, 15) in plain terms.

        Order: rotation error about the world's axes [rad], velocity error [m/s] and position error
        [m] in W, biases [rad/s], [m/s^2], each true minus estimate (R = (I + [theta]x) R^).
        """
        to_world = _world_from_invariant(self.v_W, self.p_W)
        return np.asarray(to_world @ self.P[:CORE, :CORE] @ to_world.T)

    def initialise(
        self,
        time: float,
        R_WB: FloatArray,
        v_W: FloatArray,
        p_W: FloatArray,
        b_g: FloatArray,
        b_a: FloatArray,
        covariance: FloatArray,
    ) -> None:
        """Set the state and forget every clone.

        Args:
            time: [s].
            R_WB: (3, 3) attitude.
            v_W: (3,) [m/s].
            p_W: (3,) [m].
            b_g: (3,) [rad/s].
            b_a: (3,) [m/s^2].
            covariance: (15, 15) in the plain terms of `world_covariance`.

        Raises:
            InputError: a shape is wrong, a value is not finite, `R_WB` is no rotation, or the
                covariance is not symmetric and positive semi-definite.
        """
        given = {"v_W": v_W, "p_W": p_W, "b_g": b_g, "b_a": b_a}
        arrays = {name: _checked(name, value, (3,)) for name, value in given.items()}
        R = _checked("R_WB", R_WB, (3, 3))
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
            raise InputError("R_WB", "a matrix that is no rotation", "R R^T = I with det R = 1")
        covariance = _checked("covariance", covariance, (CORE, CORE))
        _check_covariance(covariance)

        self.time = _checked("time", time, ()).item()
        self._set_pose(R, arrays["v_W"], arrays["p_W"])
        self._b_g, self._b_a = arrays["b_g"], arrays["b_a"]
        self._clone_time = [None] * self.slots
        from_world = np.linalg.inv(_world_from_invariant(arrays["v_W"], arrays["p_W"]))
        core = from_world @ covariance @ from_world.T
        self.P[:] = 0.0
        self.P[:CORE, :CORE] = 0.5 * (core + core.T)
        self.x[:] = 0.0
        self._last_downdate = None

    # --- propagation and clones ------------------------------------------------------------------

    def propagate(self, segment: Segment) -> None:
        """Move the current state and its covariance across a preintegrated segment."""
        X = self._X[0]
        step = segment.linearise(X[:, :3], X[:, 3], X[:, 4], self._b_g, self._b_a)
        self._set_pose(step.R_WB, step.v_W, step.p_W)
        self._propagate_covariance(step.transition, step.noise)
        self.time = segment.stop

    def clone(self, time: float) -> int:
        """Copy the current pose into a free slot and return the slot's number.

        Raises:
            InputError: every slot is taken; `release` one first.
        """
        if None not in self._clone_time:
            raise InputError("clone", f"all {self.slots} slots taken", "a free slot", "release one")
        slot = self._clone_time.index(None)
        self._clone_time[slot] = time
        self._X[1 + slot] = self._X[0]
        self._X[1 + slot, :, 3] = 0.0
        first, P = CORE + CLONE * slot, self.P
        for offset, core in ((0, slice(0, 3)), (3, slice(6, 9))):
            P[first + offset : first + offset + 3] = P[core]
        rows = P[first : first + CLONE]
        P[:, first : first + CLONE] = rows.T
        rows[:3, first : first + CLONE] = P[0:3, first : first + CLONE]
        rows[3:, first : first + CLONE] = P[6:9, first : first + CLONE]
        return slot

    def release(self, slot: int) -> None:
        """Drop the clone in a slot.

        Raises:
            InputError: the slot holds no clone.
        """
        self._check_slot(slot)
        self._clone_time[slot] = None
        first = CORE + CLONE * slot
        self.P[first : first + CLONE] = 0.0
        self.P[:, first : first + CLONE] = 0.0

    # --- measurements ----------------------------------------------------------------------------

    def update_displacement(
        self,
        slot_i: int,
        slot_j: int | None,
        d_W: FloatArray,
        covariance: FloatArray,
        gate: float | None = None,
        gate_mode: GateMode = "inflate",
    ) -> UpdateResult:
        """Displacement from clone i to clone j, seen in the estimated world.

        `d_W` is expressed in the filter's estimated world: the network saw the window rotated by
        the estimated attitude, so that the displacement carries the yaw error of clone i,
        p_j - p_i = (I + theta_iz [e3]x) d + n. Nothing here is an Euler angle, so no attitude of
        the device is singular, and the Jacobian times the yaw direction is exactly zero.

        Args:
            slot_i: slot of the window's first pose.
            slot_j: slot of its last pose, None for the current pose.
            d_W: (3,) [m].
            covariance: (3, 3) [m^2] in the same axes; overlapping windows see the same motion
                again, so the caller scales it by update rate x window length.
            gate: NIS from which the measurement counts as an outlier (a quantile of chi-square
                with 3 degrees of freedom), None for no gate.
            gate_mode: what happens to outliers; see `update_linear`.

        Raises:
            InputError: a slot holds no clone.
        """
        self._check_slot(slot_i)
        if slot_j is not None:
            self._check_slot(slot_j)
        p_i = self._X[1 + slot_i, :, 4]
        p_j = self._X[0 if slot_j is None else 1 + slot_j, :, 4]
        blocks = displacement_jacobian(p_i, p_j, slot_i, slot_j)
        return self.update_linear(d_W - (p_j - p_i), blocks, covariance, gate, gate_mode)

    def update_mean_velocity(
        self,
        v_mean_W: FloatArray,
        covariance: FloatArray,
        gate: float | None = None,
        gate_mode: GateMode = "inflate",
    ) -> UpdateResult:
        """Mean velocity of the window that ends now, for users who want no clones.

        It is held against the current velocity. The two differ by about half the window times the
        mean acceleration: the caller adds the IMU's own change of velocity, or inflates the
        covariance by it. The yaw error enters as in `update_displacement`, v = (I + theta_z [e3]x)
        v_mean + n, taken at the current pose.

        Args:
            v_mean_W: (3,) [m/s] in the estimated world.
            covariance: (3, 3) [m^2/s^2].
            gate: NIS from which the measurement counts as an outlier, None for no gate.
            gate_mode: what happens to outliers; see `update_linear`.
        """
        v_W = self.v_W
        blocks = mean_velocity_jacobian(v_W)
        return self.update_linear(v_mean_W - v_W, blocks, covariance, gate, gate_mode)

    def update_position_W(
        self,
        p_W: FloatArray,
        covariance: FloatArray,
        gate: float | None = None,
        gate_mode: GateMode = "inflate",
    ) -> UpdateResult:
        """Current position (3,) [m] with covariance (3, 3) [m^2]."""
        H, predicted = np.zeros((3, 9)), self.p_W
        H[:, 0:3], H[:, 6:9] = -skew(predicted), _EYE
        return self.update_linear(p_W - predicted, [(0, H)], covariance, gate, gate_mode)

    def update_linear(
        self,
        residual: FloatArray,
        blocks: Sequence[Block],
        covariance: FloatArray,
        gate: float | None = None,
        gate_mode: GateMode = "inflate",
    ) -> UpdateResult:
        """Update with any measurement that is linear in the error.

        Args:
            residual: (m,) measured minus predicted.
            blocks: Jacobian of the residual by the error (true minus estimate), as blocks
                (first column, (m, width)); columns in no block are zero.
            covariance: (m, m).
            gate: NIS from which the measurement counts as an outlier, None for no gate.
            gate_mode: "inflate" multiplies an outlier's covariance by NIS / gate, so that a run
                of outliers can still pull a filter back that is itself wrong; "reject" drops it.

        Returns:
            What happened. Values that are not finite and covariances that are not positive
            definite are refused with a reason; the state stays as it was.
        """
        m = len(residual)
        if not math.isfinite(residual @ residual + np.vdot(covariance, covariance)):
            return UpdateResult(math.nan, m, False, reason="value that is not finite")
        if dpotrf(covariance, lower=1)[1] != 0:
            return UpdateResult(math.nan, m, False, reason="covariance not positive definite")
        HP = _sum([H @ self.P[first : first + H.shape[1]] for first, H in blocks])
        HPH = _sum([HP[:, first : first + H.shape[1]] @ H.T for first, H in blocks])
        whitener = _whitener(HPH + covariance)
        white = whitener @ residual
        nis = float(white @ white)
        scale = 1.0
        if gate is not None and nis > gate:
            if gate_mode == "reject":
                return UpdateResult(nis, m, False, reason="gated")
            scale = nis / gate
            covariance = covariance * scale
            whitener = _whitener(HPH + covariance)
        if not math.isfinite(nis):
            return UpdateResult(math.nan, m, False, reason="innovation covariance not invertible")
        self._correct(residual, blocks, covariance, HP, HPH, whitener)
        self._inject()
        return UpdateResult(nis, m, True, scale)

    # --- filterpy's record of the last step ------------------------------------------------------

    @property
    def P_prior(self) -> FloatArray:
        """Covariance before the last update; computed when asked, for a copy per step is dear."""
        if self._last_downdate is None:
            return np.array(self.P)
        return np.asarray(self.P + self._last_downdate.T @ self._last_downdate)

    @P_prior.setter
    def P_prior(self, value: FloatArray) -> None:  # filterpy assigns it
        pass

    @property
    def P_post(self) -> FloatArray:
        """Covariance after the last step."""
        return np.array(self.P)

    @P_post.setter
    def P_post(self, value: FloatArray) -> None:  # filterpy assigns it
        pass

    # --- structured algebra ----------------------------------------------------------------------

    def _propagate_covariance(self, transition: FloatArray, noise: FloatArray) -> None:
        P = self.P
        P[:CORE] = transition @ P[:CORE]
        P[CORE:, :CORE] = P[:CORE, CORE:].T
        core = P[:CORE, :CORE] @ transition.T + noise
        P[:CORE, :CORE] = 0.5 * (core + core.T)
        self._last_downdate = None

    def _correct(
        self,
        residual: FloatArray,
        blocks: Sequence[Block],
        covariance: FloatArray,
        HP: FloatArray,
        HPH: FloatArray,
        whitener: FloatArray,
    ) -> None:
        """P - K S K^T as P - W^T W with W = L^-1 H P: symmetric, of the measurement's rank."""
        W = whitener @ HP
        self.R, self.S = covariance, HPH + covariance
        self.SI = whitener.T @ whitener
        self.K = (whitener.T @ W).T
        self.y = self.z = residual[:, None]
        self.x = self.K @ self.y
        self.x_post = self.x
        # P is symmetric: its transpose is the same matrix in the order BLAS updates in place.
        self.P = dgemm(-1.0, W.T, W.T, beta=1.0, c=self.P.T, trans_b=1, overwrite_c=1).T
        self._last_downdate = W
        self._log_likelihood = self._likelihood = self._mahalanobis = None

    def _inject(self) -> None:
        """Move the error's mean into the state, X <- exp(x) X, and set it to zero."""
        dx = self.x[:, 0]
        xi = np.zeros((self.slots + 1, 3, 3))  # rows theta, rho_v, rho_p of each pose
        xi[0] = dx[:9].reshape(3, 3)
        xi[1:, ::2] = dx[CORE:].reshape(self.slots, 2, 3)
        self._X = exp_times(xi[:, 0], xi[:, 1:].transpose(0, 2, 1), self._X)
        self._b_g = self._b_g + dx[9:12]
        self._b_a = self._b_a + dx[12:15]
        self.x = np.zeros((self.dim_x, 1))

    def _set_pose(self, R_WB: FloatArray, v_W: FloatArray, p_W: FloatArray) -> None:
        X = self._X[0]
        X[:, :3], X[:, 3], X[:, 4] = R_WB, v_W, p_W

    def _check_slot(self, slot: int) -> None:
        if not 0 <= slot < self.slots or self._clone_time[slot] is None:
            held = [k for k, time in enumerate(self._clone_time) if time is not None]
            raise InputError("slot", repr(slot), f"one that holds a clone: {held}")


def displacement_jacobian(
    p_i_W: FloatArray, p_j_W: FloatArray, slot_i: int, slot_j: int | None
) -> list[Block]:
    """Jacobian of `update_displacement`'s residual.

    theta_i: [p_i]x - (e3 x (p_j - p_i)) e3^T, rho_pi: -I, theta_j: -[p_j]x, rho_pj: I. The third
    column of the first block equals that of [p_j]x; written so, H times yaw is zero to the bit.
    """
    P_i, P_j = skew(np.array((p_i_W, p_j_W)))
    H_i = _LAST_MINUS_EYE.copy()
    H_i[:, :2], H_i[:, 2] = P_i[:, :2], P_j[:, 2]
    H_j = (_LAST_EYE_CORE if slot_j is None else _LAST_EYE).copy()
    H_j[:, :3] -= P_j
    first_j = 0 if slot_j is None else CORE + CLONE * slot_j
    return [(CORE + CLONE * slot_i, H_i), (first_j, H_j)]


def mean_velocity_jacobian(v_W: FloatArray) -> list[Block]:
    """Jacobian of `update_mean_velocity`'s residual: theta -[v]x - (e3 x v) e3^T, rho_v I."""
    H = np.zeros((3, CLONE))
    H[:, :2], H[:, 3:] = -skew(v_W)[:, :2], _EYE
    return [(0, H)]


_EYE = np.eye(3)
_LAST_EYE = np.eye(3, CLONE, k=3)
_LAST_MINUS_EYE = -_LAST_EYE
_LAST_EYE_CORE = np.eye(3, 9, k=6)


def _sum(terms: list[FloatArray]) -> FloatArray:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def _whitener(covariance: FloatArray) -> FloatArray:
    """Inverse of the lower Cholesky factor; not-a-number where there is none."""
    factor, failed = dpotrf(covariance, lower=1)
    if failed:
        return np.full_like(covariance, math.nan)
    inverse: FloatArray = dtrtri(factor, lower=1)[0]
    return inverse


def _world_from_invariant(v_W: FloatArray, p_W: FloatArray) -> FloatArray:
    """Plain errors from invariant ones: v - v^ = rho_v - [v^]x theta, likewise for position."""
    matrix = np.eye(CORE)
    matrix[3:6, 0:3] = -skew(v_W)
    matrix[6:9, 0:3] = -skew(p_W)
    return matrix


def _checked(name: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    array = np.array(value, dtype=np.float64)
    if array.shape != shape:
        raise InputError(name, f"shape {array.shape}", f"{shape}")
    if not np.isfinite(array).all():
        raise InputError(name, "a value that is not finite", "finite values")
    return array


def _check_covariance(covariance: FloatArray) -> None:
    largest = np.abs(covariance).max()
    if np.abs(covariance - covariance.T).max() > 1e-9 * largest:
        raise InputError("covariance", "an asymmetric matrix", "a symmetric one")
    sigma = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    if np.linalg.eigvalsh(covariance / np.outer(sigma, sigma)).min() < -1e-9:
        raise InputError("covariance", "a negative eigenvalue", "a positive semi-definite matrix")
