"""State-cloning EKF with a right-invariant error, on filterpy's `ExtendedKalmanFilter`.

Error state: the current pose and biases, then a fixed number of cloned poses,
    theta, rho_v, rho_p, d_bg, d_ba | theta, rho_p of slot 0 | theta, rho_p of slot 1 | ...
with the meaning given in `preintegration`. The state itself lives on SE_2(3) and SE(3): filterpy's
`x` is the mean of the error, zero before each update, and moved into the state by the group's
exponential after it. An empty slot has zero covariance and zero columns in every Jacobian.

Sources: A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", 2017;
S. Roumeliotis, J. Burdick, "Stochastic cloning", 2002; W. Liu et al., "TLIO", 2020 (displacements
as measurements).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stario.fusion.checked import check_covariance, checked
from stario.fusion.filter.engine import ErrorStateEngine, GateMode, UpdateResult
from stario.fusion.filter.estimate import Estimate
from stario.fusion.filter.jacobians import (
    CLONE,
    displacement_jacobian,
    heading_jacobian,
    in_plain_terms,
    mean_velocity_jacobian,
    position_jacobian,
    velocity_jacobian,
    yaw_twist,
)
from stario.fusion.imu.preintegration import CORE, Segment
from stario.fusion.lie import FloatArray, exp_times, skew
from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY

_NO_GAIN = np.zeros(3)

_GYRO = slice(9, 12)
"""The gyroscope's bias in the error state."""

_POSE = [0, 1, 2, 4]
"""Columns of a state that a clone has."""

_FAR = 1e3
"""Farther from the world's origin than this [m] positions are counted from a point nearby: in the
right-invariant error they multiply the attitude's, and in coordinates of a map that leaves no
digits for centimetres."""


class StateCloningEkf(ErrorStateEngine):
    """Right-invariant EKF over the current state and `slots` cloned poses.

    Use it as: `initialise`, then `propagate` segments, `clone` poses, `update_...`, `release`.
    What filterpy tells of the last step is described in `engine.ErrorStateEngine`.

    Args:
        slots: number of poses that can be held at once.
        gravity: magnitude [m/s^2].
    """

    def __init__(self, slots: int, gravity: float = STANDARD_GRAVITY) -> None:
        if slots < 0:
            raise InputError("slots", repr(slots), "a number of clones >= 0")
        super().__init__(CORE + CLONE * slots)
        self.gravity = gravity
        self.slots = slots
        self.time = math.nan
        # Row 0 is the current pose, row 1 + s the clone in slot s: one stack to correct at once.
        # Columns R, v, p; a clone's v is not used and stays zero. p is counted from the origin.
        self._X: FloatArray = np.tile(np.eye(3, 5), (slots + 1, 1, 1))
        self._origin_W = np.zeros(3)
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
        return np.asarray(self._X[0, :, 4] + self._origin_W)

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
        X = self._X[1 + slot]
        return np.array(X[:, :3]), np.asarray(X[:, 4] + self._origin_W)

    def estimate(self, in_gap: bool = False, world: int = 0) -> Estimate:
        """The newest state."""
        P = self.P[:CORE, :CORE].copy()
        return self._estimate(self.time, self._X[0].copy(), P, P[:, _GYRO], in_gap, world)

    def clone_estimate(self, slot: int, world: int = 0) -> Estimate:
        """A clone as it is known now.

        Raises:
            InputError: the slot holds no clone.
        """
        self._check_slot(slot)
        time, first = self._clone_time[slot], CORE + CLONE * slot
        assert time is not None  # the slot is taken
        rows = self.P[first : first + CLONE]
        P, P_g = rows[:, first : first + CLONE].copy(), rows[:, _GYRO].copy()
        return self._estimate(time, self._X[1 + slot][:, _POSE], P, P_g, False, world)

    def _estimate(
        self, time: float, X: FloatArray, P: FloatArray, P_g: FloatArray, in_gap: bool, world: int
    ) -> Estimate:
        P_gg = self.P[_GYRO, _GYRO].copy()
        return Estimate(time, X, self._origin_W, self._b_g, self._b_a, P, P_g, P_gg, in_gap, world)

    def world_covariance(self) -> FloatArray:
        """Covariance (15, 15) in plain terms.

        Order: rotation error about the world's axes [rad], velocity error [m/s] and position error
        [m] in W, biases [rad/s], [m/s^2], each true minus estimate (R = (I + [theta]x) R^).
        """
        return in_plain_terms(self.P[:CORE, :CORE], self._X[0, :, 3:].T)

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
        arrays = {name: checked(name, value, (3,)) for name, value in given.items()}
        R = checked("R_WB", R_WB, (3, 3))
        if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
            raise InputError("R_WB", "a matrix that is no rotation", "R R^T = I with det R = 1")
        covariance = checked("covariance", covariance, (CORE, CORE))
        check_covariance(covariance)

        self.time = checked("time", time, ()).item()
        self._origin_W = arrays["p_W"] if np.linalg.norm(arrays["p_W"]) > _FAR else np.zeros(3)
        p = arrays["p_W"] - self._origin_W
        self._set_pose(R, arrays["v_W"], p)
        self._b_g, self._b_a = arrays["b_g"], arrays["b_a"]
        self._clone_time = [None] * self.slots
        self.P[:] = 0.0
        self.P[:CORE, :CORE] = in_plain_terms(covariance, -np.array((arrays["v_W"], p)))
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

    # --- the world as a whole --------------------------------------------------------------------

    def move_world(self, R: FloatArray, shift: FloatArray) -> None:
        """Give every pose in another world: p <- R p + shift, likewise attitude and velocity.

        A turn about the vertical (and any shift) leaves gravity where it is; the error turns with
        the world exactly, by the adjoint of (R, shift).

        Args:
            R: (3, 3) rotation about the vertical.
            shift: (3,) [m].
        """
        origin = R @ self._origin_W + shift
        self._origin_W = origin if np.linalg.norm(origin) > _FAR else np.zeros(3)
        shift = origin - self._origin_W  # what is left of it for the poses
        self._X = R @ self._X
        self._X[:, :, 4] += shift
        A = np.eye(self.dim_x)
        for first, rho in self._poses():
            A[first : first + 3, first : first + 3] = R
            A[rho : rho + 3, rho : rho + 3] = R
            A[rho : rho + 3, first : first + 3] = skew(shift) @ R
        A[3:6, 3:6] = R
        P = A @ self.P @ A.T
        self.P = 0.5 * (P + P.T)
        self._last_downdate = None

    def loosen_yaw(self, about_W: FloatArray, sigma: float) -> None:
        """Admit that the world as a whole may be turned about a vertical through a point.

        Args:
            about_W: (3,) the point that stays [m].
            sigma: of the turn [rad].
        """
        x, y, _ = about_W - self._origin_W
        N = np.zeros((self.dim_x, 1))
        for first, rho in self._poses():
            N[first + 2, 0] = 1.0
            N[rho, 0], N[rho + 1, 0] = y, -x  # -e3 x p
        self._loosen(N, sigma)

    def loosen_position(self, sigma: float) -> None:
        """Admit that the world as a whole may be shifted by `sigma` [m] per axis."""
        N = np.zeros((self.dim_x, 3))
        for _, rho in self._poses():
            N[rho : rho + 3] = np.eye(3)
        self._loosen(N, sigma)

    def _loosen(self, directions: FloatArray, sigma: float) -> None:
        self.P = self.P + sigma**2 * (directions @ directions.T)
        self._last_downdate = None

    def _poses(self) -> list[tuple[int, int]]:
        """First rows of theta and rho_p of the current pose and of every clone held."""
        held = (CORE + CLONE * k for k, time in enumerate(self._clone_time) if time is not None)
        return [(0, 6), *((first, first + 3) for first in held)]

    # --- going back ------------------------------------------------------------------------------

    def checkpoint(self) -> dict[str, Any]:
        """Everything that `rewind` needs, as copies: arrays, numbers and a list."""
        return {
            "time": self.time,
            "X": self._X.copy(),
            "origin": self._origin_W,
            "b_g": self._b_g,
            "b_a": self._b_a,
            "P": self.P.copy(),
            "clone_time": list(self._clone_time),
        }

    def rewind(self, checkpoint: dict[str, Any]) -> None:
        """Go back to a checkpoint of a filter with as many slots; the checkpoint stays usable."""
        self.time = checkpoint["time"]
        self._X, self._origin_W = checkpoint["X"].copy(), checkpoint["origin"]
        self._b_g, self._b_a = checkpoint["b_g"], checkpoint["b_a"]
        self.P = checkpoint["P"].copy()
        self._clone_time = list(checkpoint["clone_time"])
        self.x = np.zeros((self.dim_x, 1))
        self._last_downdate = None

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
        gain_W: FloatArray = _NO_GAIN,
        seconds: float = 0.0,
    ) -> UpdateResult:
        """Mean velocity of the window that ends now, for users who want no clones.

        The IMU's own gain since that mean makes it the velocity now, v = m + gain, and is as wrong
        as attitude and accelerometer bias. The yaw error enters as in `update_displacement`,
        m = (I + theta_z [e3]x) v_mean + n, taken at the current pose.

        Args:
            v_mean_W: (3,) [m/s] in the estimated world.
            covariance: (3, 3) [m^2/s^2].
            gate: NIS from which the measurement counts as an outlier, None for no gate.
            gate_mode: what happens to outliers; see `update_linear`.
            gain_W: (3,) velocity now minus its mean over the window [m/s], from the IMU alone.
            seconds: length of the window [s]; 0 for a velocity of now.
        """
        X = self._X[0]
        force_W = gain_W + np.array([0.0, 0.0, 0.5 * seconds * self.gravity])
        blocks = mean_velocity_jacobian(X[:, 3], force_W, X[:, :3], seconds)
        residual = v_mean_W + gain_W - X[:, 3]
        return self.update_linear(residual, blocks, covariance, gate, gate_mode)

    def update_position_W(
        self,
        p_W: FloatArray,
        covariance: FloatArray,
        gate: float | None = None,
        gate_mode: GateMode = "inflate",
    ) -> UpdateResult:
        """Current position (3,) [m] with covariance (3, 3) [m^2]."""
        predicted = self._X[0, :, 4]
        residual, blocks = p_W - self._origin_W - predicted, position_jacobian(predicted)
        return self.update_linear(residual, blocks, covariance, gate, gate_mode)

    def update_velocity_W(
        self,
        v_W: FloatArray,
        covariance: FloatArray,
        gate: float | None = None,
        gate_mode: GateMode = "inflate",
    ) -> UpdateResult:
        """Current velocity (3,) [m/s] in W itself, not in its estimate, covariance (3, 3)."""
        predicted = self.v_W
        blocks = velocity_jacobian(predicted)
        return self.update_linear(v_W - predicted, blocks, covariance, gate, gate_mode)

    def update_heading(
        self, yaw: float, sigma: float, gate: float | None = None, gate_mode: GateMode = "inflate"
    ) -> UpdateResult:
        """Current yaw [rad] as `yaw_twist` defines it; refused where the device is upside down."""
        R = self._X[0, :, :3]
        residual = np.array([math.remainder(yaw - yaw_twist(R), 2.0 * math.pi)])
        if not math.isfinite(residual[0]):
            return UpdateResult(math.nan, 1, False, reason="yaw not defined upside down")
        covariance = np.array([[sigma * sigma]])
        return self.update_linear(residual, heading_jacobian(R), covariance, gate, gate_mode)

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
