"""State-cloning EKF with a right-invariant error, on filterpy's `ExtendedKalmanFilter`.

The state lies on SE_2(3) and SE(3) (`EkfState`): filterpy's `x` is the mean of the error, zero
before each update and moved into the state by the group's exponential after it. An empty slot has
zero covariance and zero columns in every Jacobian. Derivation and sources: README.md, "Error state"
to "Displacement measurement".
"""

from __future__ import annotations

import math

import numpy as np

from stario.fusion.checked import check_covariance, checked, checked_rotation
from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.engine import ErrorStateEngine, UpdateResult
from stario.fusion.filter.jacobians import (
    ACTUAL,
    CLONE,
    CLONED,
    CORE,
    Propagation,
    bearing_jacobian,
    displacement_jacobian,
    mean_velocity_jacobian,
    position_jacobian,
    propagated,
    propagated_in_gap,
    turn_jacobian,
    velocity_jacobian,
    yaw_jacobian,
)
from stario.fusion.filter.network_errors import DisplacementErrors, with_considered_propagated
from stario.fusion.imu.gap import gap_rotation, yaw_variance
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.imu.preintegration import Segment
from stario.fusion.lie import about_vertical, yaw_twist
from stario.fusion.state import NavState, changed
from stario.sequences.attitude.rotations import tilt_aligning
from stario.sequences.attitude.so3 import log_so3
from stario.sequences.errors import InputError
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray

_NO_GAIN = np.zeros(3)


class StateCloningEkf(ErrorStateEngine):
    """Right-invariant EKF over the current state and `slots` cloned poses.

    Use it as: `initialise`, then `propagate` segments, `clone` poses, `update_...`, `release`.
    `engine.ErrorStateEngine` describes filterpy's attributes of the last step.

    Args:
        slots: number of poses that can be held at once.
        gravity: magnitude of gravity [m/s^2].

    Attributes:
        state: everything that varies; assign an earlier one to restore it.
    """

    def __init__(self, slots: int, gravity: float = STANDARD_GRAVITY) -> None:
        if slots < 0:
            raise InputError("slots", repr(slots), "a number of clones >= 0")
        zero = np.zeros(3)
        undefined = NavState(math.nan, np.eye(3), zero, zero, zero, zero, np.zeros((CORE, CORE)))
        state = self.state = EkfState.initial(undefined, slots)
        super().__init__(len(state.P), state.considered_rows)
        self.state = state  # filterpy has set its own P
        self.gravity = gravity
        self.slots = slots

    @property
    def covariances(self) -> FloatArray:
        """Covariances (2, n, n) of the error state."""
        return self.state.covariances

    @covariances.setter
    def covariances(self, value: FloatArray) -> None:
        self.state = changed(self.state, covariances=value)

    def initialise(self, state: NavState) -> None:
        """Set the state from one with plain errors, and drop all clones.

        Raises:
            InputError: a shape is wrong, a value is not finite, `R_WB` is not a rotation, or the
                covariance is not symmetric and positive semi-definite.
        """
        v, p, b_g, b_a = (
            checked(name, getattr(state, name), (3,)) for name in ("v_W", "p_W", "b_g", "b_a")
        )
        R = checked_rotation(state.R_WB)
        covariance = checked("covariance", state.covariance, (CORE, CORE))
        check_covariance(covariance)
        now = checked("time", state.time, ()).item()
        self.state = EkfState.initial(NavState(now, R, v, p, b_g, b_a, covariance), self.slots)
        self.x[:] = 0.0

    def propagate(self, segment: Segment, accel_share: float = 1.0) -> None:
        """Propagate the current state and its covariances through a preintegrated segment.

        Args:
            segment: the segment.
            accel_share: actual variance of the accelerometer's noise, as a fraction of that in the
                segment, which the gains assume.
        """
        s = self.state
        self._move(segment.stop, propagated(segment, *s.pose, s.b_g, s.b_a, accel_share))

    def propagate_in_gap(
        self, piece: ImuInterval, gap: ImuInterval, config: NavigatorConfig
    ) -> None:
        """Propagate without samples through a gap, or through a piece of it between fixes."""
        R, v, p = self.state.pose
        rotation = gap_rotation(piece.table, gap.duration, self.state.b_g)
        before, after = (yaw_variance(time - gap.start, gap) for time in (piece.start, piece.stop))
        pose = R @ rotation, v, p
        self._move(piece.stop, propagated_in_gap(piece.duration, after - before, *pose, config))

    def _move(self, time: float, end: Propagation) -> None:
        """Set the current pose and its covariances after a propagation to a time [s]."""
        X = self.state.X.copy()
        X[0, :, :3], X[0, :, 3], X[0, :, 4] = end.R_WB, end.v_W, end.p_W
        P = self._propagated(self.state.covariances, end.transition, end.noise)
        self.state = changed(self.state, time=time, X=X, covariances=P)

    def clone(self, instead_of: int | None = None) -> int:
        """Copy the current pose into a slot and return its number.

        Args:
            instead_of: slot of a clone to replace; None for a free slot.

        Raises:
            InputError: every slot is taken (`release` one first), or `instead_of` holds no clone.
        """
        s = self.state
        if instead_of is not None:
            s.time_of_clone(instead_of)
        elif None not in s.clone_times:
            raise InputError("clone", f"all {self.slots} slots taken", "a free slot", "release one")
        slot = s.clone_times.index(None) if instead_of is None else instead_of
        X = s.X.copy()
        X[1 + slot] = X[0]
        X[1 + slot, :, 3] = 0.0
        first, P = CORE + CLONE * slot, s.covariances.copy()
        clone = slice(first, first + CLONE)
        P[:, clone] = P[:, CLONED]
        P[:, :, clone] = P[:, :, CLONED]
        times = (*s.clone_times[:slot], s.time, *s.clone_times[slot + 1 :])
        self.state = changed(s, X=X, covariances=P, clone_times=times)
        return slot

    def release(self, slot: int) -> None:
        """Drop the clone in a slot.

        Raises:
            InputError: the slot holds no clone.
        """
        s = self.state
        s.time_of_clone(slot)
        times = (*s.clone_times[:slot], None, *s.clone_times[slot + 1 :])
        P, first = s.covariances.copy(), CORE + CLONE * slot
        P[:, first : first + CLONE] = 0.0
        P[:, :, first : first + CLONE] = 0.0
        self.state = changed(s, covariances=P, clone_times=times)

    # --- measurements: README.md, "Displacement measurement" to "Fixes" --------------------------

    def update_displacement(
        self,
        slot: int,
        d_W: FloatArray,
        covariance: FloatArray,
        gate: float | None = None,
        inflation: float | None = 1.0,
        errors: DisplacementErrors | None = None,
    ) -> UpdateResult:
        """Update with the displacement from clone i to the current pose j, in the estimated world.

        The caller has rotated the network's displacement from N to W by the estimated yaw of clone
        i, so that it contains the error of this yaw, p_j - p_i = (I + theta_iz [e3]x) d + n, and
        the network's own (turn). Those of its errors that last are considered.

        Args:
            slot: slot of the clone where the window began.
            d_W: (3,) displacement [m].
            covariance: (3, 3) covariance in the same axes [m^2]; overlapping windows contain the
                same motion, so the caller scales it by update rate x window length.
            gate: NIS above which the measurement counts as an outlier (a quantile of chi-square
                with 3 degrees of freedom); None for no gate.
            inflation: what happens to outliers; see `update_linear`.
            errors: its errors as they are; None if they are white with that covariance.

        Raises:
            InputError: the slot holds no clone.
        """
        before = s = self.state
        s.time_of_clone(slot)
        p_i, p_j = s.X[1 + slot, :, 4], s.X[0, :, 4]
        blocks = displacement_jacobian(p_i, p_j, slot)
        if s.has_turn:
            d_W = about_vertical(-s.network_turn) @ d_W
            blocks.append(turn_jacobian(p_j - p_i, s.turn_row))
        noise = None
        if errors is not None:
            noise = errors.white
            self.state = s = with_considered_propagated(s)
            blocks.append((s.considered_rows.start, errors.considered))
        residual = d_W - (p_j - p_i)
        result = self.update_linear(residual, blocks, covariance, gate, inflation, noise)
        if not result.accepted:
            self.state = before
        return result

    def update_mean_velocity(
        self,
        v_mean_W: FloatArray,
        covariance: FloatArray,
        gate: float | None = None,
        gain_W: FloatArray = _NO_GAIN,
        seconds: float = 0.0,
    ) -> UpdateResult:
        """Update with the mean velocity of a window that ends now, for measurements without clones.

        The velocity gain since that mean, from the IMU, converts it to the current velocity,
        v = m + gain, and carries the errors of attitude and accelerometer bias. The yaw error
        enters as in `update_displacement`, m = (I + theta_z [e3]x) v_mean + n, taken at the current
        pose.

        Args:
            v_mean_W: (3,) mean velocity in the estimated world [m/s].
            covariance: (3, 3) covariance of the mean velocity [m^2/s^2].
            gate: NIS above which the measurement is an outlier and inflated; None for no gate.
            gain_W: (3,) current velocity minus its mean over the window [m/s], from the IMU alone.
            seconds: length of the window [s]; 0 for a current velocity.
        """
        s = self.state
        force_W = gain_W + np.array([0.0, 0.0, 0.5 * seconds * self.gravity])
        blocks = mean_velocity_jacobian(s.v_W, force_W, s.R_WB, seconds)
        residual = v_mean_W + gain_W - s.v_W
        return self.update_linear(residual, blocks, covariance, gate)

    def update_position_W(
        self, p_W: FloatArray, covariance: FloatArray, gate: float | None = None
    ) -> UpdateResult:
        """Update with the current position (3,) [m], covariance (3, 3) [m^2]."""
        predicted = self.state.X[0, :, 4]
        residual = p_W - self.state.origin_W - predicted
        blocks = position_jacobian(predicted)
        return self.update_linear(residual, blocks, covariance, gate, gains_from=ACTUAL)

    def update_velocity_W(
        self, v_W: FloatArray, covariance: FloatArray, gate: float | None = None
    ) -> UpdateResult:
        """Update with the current velocity (3,) [m/s] in the true W, covariance (3, 3)."""
        predicted = self.state.v_W
        blocks = velocity_jacobian(predicted)
        return self.update_linear(v_W - predicted, blocks, covariance, gate, gains_from=ACTUAL)

    def update_tilt(self, up_B: FloatArray, sigma: float) -> UpdateResult:
        """Update with the upward direction in B: unit vector (3,), standard deviation [rad].

        The residual is the smallest rotation that takes R up_B to the vertical, theta's first two
        components.
        """
        turn = log_so3(tilt_aligning(self.state.R_WB @ up_B).as_matrix())[:2]
        return self.update_linear(turn, [(0, np.eye(2))], sigma**2 * np.eye(2))

    def update_yaw(self, yaw: float, sigma: float, gate: float | None = None) -> UpdateResult:
        """Update with the current yaw [rad] as defined by `yaw_twist`; rejected if upside down."""
        R = self.state.R_WB
        residual = np.array([math.remainder(yaw - yaw_twist(R), 2.0 * math.pi)])
        if not math.isfinite(residual[0]):
            return UpdateResult("yaw not defined upside down")
        covariance = np.array([[sigma * sigma]])
        return self.update_linear(residual, yaw_jacobian(R), covariance, gate, gains_from=ACTUAL)

    def update_bearing(
        self, m_B: FloatArray, variance: float, gate: float | None = None
    ) -> UpdateResult:
        """Update with the bearing of a magnetic field, which measures the state's azimuth.

        Args:
            m_B: (3,) measured field [uT]; the state must have a field (`magnetic.with_field`).
            variance: variance of its bearing [rad^2].
            gate: as for the other updates; outliers are inflated.
        """
        s = self.state
        assert s.field is not None
        m_W = s.R_WB @ (m_B - s.field.hard_iron_B)
        bearing = math.atan2(m_W[1], m_W[0])
        residual = math.remainder(bearing - s.field.azimuth - s.field.wander, 2.0 * math.pi)
        blocks = bearing_jacobian(s.R_WB, m_W, s.field_row)
        return self.update_linear(np.array([residual]), blocks, np.array([[variance]]), gate)

    def inject(self, covariances: FloatArray) -> None:
        """Move the error's mean into the state, X <- exp(x) X, and set it to zero."""
        self.state = changed(self.state.plus(self.x[:, 0]), covariances=covariances)
        self.x = np.zeros_like(self.x)
