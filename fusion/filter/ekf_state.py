"""State of the filter at one time, as a value that is never modified in place.

Error state, its order and meaning: README.md, "Error state". The poses lie on SE_2(3) (clones:
SE(3)); the covariance is that of their right-invariant error.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.estimates import Estimate, nav_states
from stario.fusion.filter.jacobians import (
    CLONE,
    CLONED,
    CORE,
    GAIN,
    REPORTED,
    plain_covariance,
    symmetric,
)
from stario.fusion.values.lie import exp_times
from stario.fusion.values.state import NavState, changed
from stario.sequences.attitude.so3 import skew
from stario.sequences.sequence import FloatArray

CONSIDERED_SECONDS = np.array([1.2, 1.2, 1.2, math.inf, math.inf, 10.0])
"""Correlation times [s] of the network's errors that are considered and never estimated: those that
drift, along W's axes; those that last, along and across the displacement; the floor's slope
(README.md, "Correlated errors")."""

LOST_YAW = 1.0
"""Sigma of the yaw [rad] beyond which no update may turn or move the track through it."""

_MAX_ORIGIN_DISTANCE = 1e3
"""Positions farther than this from the origin [m] are expressed relative to a nearby point: in the
right-invariant error they multiply the attitude error, which leaves no digits for centimetres when
they are map coordinates."""


@dataclass(frozen=True, eq=False)
class FieldState:
    """Estimate of the magnetic field; its errors are the last five of the error state.

    Attributes:
        azimuth: constant part of the horizontal field's azimuth in W, counter-clockwise from x
            [rad].
        disturbance: part of the azimuth that changes from place to place [rad].
        hard_iron_B: (3,) the device's own field [uT].
    """

    azimuth: float
    disturbance: float
    hard_iron_B: FloatArray


@dataclass(frozen=True, eq=False)
class PressureOffset:
    """Estimate of the height by the pressure less that of the track (`height`).

    Attributes:
        metres: the offset [m].
        time: time up to which its random walk is propagated [s].
    """

    metres: float
    time: float


@dataclass(frozen=True, eq=False)
class EkfState:
    """The current pose and biases, the cloned poses, and their covariance.

    Every change creates a new value, so a reference to an old one suffices to restore it.

    Attributes:
        time: [s].
        X: (1 + slots, 3, 5) columns R, v, p; row 0 is the current pose, row 1 + s the clone in slot
            s, whose v is zero. p is relative to `origin_W`.
        origin_W: (3,) [m].
        b_g: (3,) gyroscope bias [rad/s].
        b_a: (3,) accelerometer bias [m/s^2].
        covariances: (2, n, n) covariances of the error state, zero for an empty slot: as assumed
            for the gains, which take the network's errors for white, and as it is, given these
            gains and the errors' correlation (README.md, "Correlated errors").
        clone_times: times of the clones [s]; None for an empty slot.
        considered_time: time up to which the considered errors are propagated [s].
        field: the magnetic field; None before its first measurement.
        offset: that of the barometer; None before its first height.
        steady_W: (3,) error that the displacements share under the alternative hypothesis [m]; None
            if they have none.
    """

    time: float
    X: FloatArray
    origin_W: FloatArray
    b_g: FloatArray
    b_a: FloatArray
    covariances: FloatArray
    clone_times: tuple[float | None, ...]
    considered_time: float
    field: FieldState | None = None
    offset: PressureOffset | None = None
    steady_W: FloatArray | None = None

    @classmethod
    def initial(cls, state: NavState, slots: int) -> EkfState:
        """Create a state without clones from one with plain errors."""
        origin_W = state.p_W if np.linalg.norm(state.p_W) > _MAX_ORIGIN_DISTANCE else np.zeros(3)
        X = np.tile(np.eye(3, 5), (slots + 1, 1, 1))
        X[0, :, :3], X[0, :, 3], X[0, :, 4] = state.R_WB, state.v_W, state.p_W - origin_W
        clones_end = CORE + CLONE * slots
        n = clones_end + len(CONSIDERED_SECONDS)
        P = np.zeros((2, n, n))
        P[:, :CORE, :CORE] = plain_covariance(state.covariance, -X[0, :, 3:].T)
        P[REPORTED, clones_end:, clones_end:] = np.eye(len(CONSIDERED_SECONDS))
        times = (None,) * slots, state.time
        return cls(state.time, X, origin_W, state.b_g, state.b_a, P, *times)

    @property
    def P(self) -> FloatArray:
        """Covariance (n, n) of the error as assumed for the gains."""
        P: FloatArray = self.covariances[GAIN]
        return P

    @property
    def P_reported(self) -> FloatArray:
        """Covariance (n, n) of the error as it is."""
        P: FloatArray = self.covariances[REPORTED]
        return P

    @property
    def pose(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """R_WB (3, 3), v_W (3,) [m/s] and, relative to `origin_W`, p_W (3,) [m]."""
        X = self.X[0]
        return X[:, :3], X[:, 3], X[:, 4]

    @property
    def R_WB(self) -> FloatArray:
        """Attitude (3, 3), body to world."""
        return self.X[0, :, :3]

    @property
    def v_W(self) -> FloatArray:
        """Velocity (3,) [m/s]."""
        return self.X[0, :, 3]

    @property
    def p_W(self) -> FloatArray:
        """Position (3,) [m]."""
        return np.asarray(self.X[0, :, 4] + self.origin_W)

    def nav_state(self) -> NavState:
        """Return the current state with plain errors."""
        return nav_states([self.estimate()])[0]

    @property
    def steady_rows(self) -> slice:
        """Rows of the error that displacements share, if there is one."""
        first = CORE + CLONE * len(self.clone_times)
        return slice(first, first + 3 * (self.steady_W is not None))

    @property
    def considered_rows(self) -> slice:
        """Rows of the network's errors that are considered and never estimated."""
        first = self.steady_rows.stop
        return slice(first, first + len(CONSIDERED_SECONDS))

    @property
    def offset_row(self) -> int:
        """Row of the error of the barometer's offset, if there is one."""
        row: int = self.considered_rows.stop
        return row

    @property
    def field_row(self) -> int:
        """First row of the magnetic field's error: azimuth, disturbance, hard iron (3)."""
        return self.offset_row + (self.offset is not None)

    @property
    def clone_slots(self) -> list[int]:
        """Slots that hold a clone, oldest first."""
        taken = [(time, k) for k, time in enumerate(self.clone_times) if time is not None]
        return [slot for _, slot in sorted(taken)]

    def clone_rows(self, slot: int) -> slice:
        """Return the rows of a clone in the error state."""
        return slice(CORE + CLONE * slot, CORE + CLONE * (slot + 1))

    def clone_pose(self, slot: int) -> tuple[FloatArray, FloatArray]:
        """Return R_WB (3, 3) and p_W (3,) of a clone as currently estimated."""
        X = self.X[1 + slot]
        return X[:, :3], np.asarray(X[:, 4] + self.origin_W)

    def estimate(self, in_gap: bool = False, map_frame: int = 0) -> Estimate:
        """Return the estimate of the current pose and biases."""
        # Copies: a view would keep the whole covariance alive for as long as the estimate.
        X, covariances = self.X[0].copy(), self.covariances[:, :CORE, :CORE].copy()
        return Estimate(
            self.time, X, self.origin_W, self.b_g, self.b_a, covariances, in_gap, map_frame
        )

    def clone_estimate(self, slot: int, map_frame: int = 0) -> Estimate:
        """Return the current estimate of a clone."""
        time, rows, zero = self.clone_times[slot], self.clone_rows(slot), np.zeros(3)
        assert time is not None  # the slot holds a clone
        covariances = np.zeros((2, CORE, CORE))
        covariances[:, CLONED[:, None], CLONED] = self.covariances[:, rows, rows]
        X = self.X[1 + slot].copy()
        return Estimate(time, X, self.origin_W, zero, zero, covariances, map_frame=map_frame)

    def plus(self, error: FloatArray) -> EkfState:
        """Return the state moved by an error (n,), X <- exp(error) X, with its covariances."""
        xi = np.zeros((len(self.X), 3, 3))  # rows theta, rho_v, rho_p of each pose
        xi[0] = error[:9].reshape(3, 3)
        xi[1:, ::2] = error[CORE : self.steady_rows.start].reshape(-1, 2, 3)
        field = self.field
        if field is not None:
            azimuth, disturbance, *_ = error[self.field_row :].tolist()
            hard_iron_B = field.hard_iron_B + error[self.field_row + 2 :]
            azimuth, disturbance = field.azimuth + azimuth, field.disturbance + disturbance
            field = FieldState(azimuth, disturbance, hard_iron_B)
        offset = self.offset
        if offset is not None:
            offset = changed(offset, metres=offset.metres + float(error[self.offset_row]))
        steady_W = self.steady_W
        if steady_W is not None:
            steady_W = steady_W + error[self.steady_rows]
        return changed(
            self,
            X=exp_times(xi[:, 0], xi[:, 1:].transpose(0, 2, 1), self.X),
            b_g=self.b_g + error[9:12],
            b_a=self.b_a + error[12:15],
            field=field,
            offset=offset,
            steady_W=steady_W,
        )

    def with_steady_error(self, variance: float) -> EkfState:
        """Return the state whose displacements share an error, with a variance [m^2] or more."""
        P, rows, steady_W = self.covariances, self.steady_rows, self.steady_W
        if steady_W is None:
            at = [rows.start] * 3
            P, steady_W = np.insert(np.insert(P, at, 0.0, 1), at, 0.0, 2), np.zeros(3)
        after = changed(self, covariances=P.copy(), steady_W=steady_W)
        after.covariances[:, after.steady_rows, after.steady_rows] += variance * np.eye(3)
        return after

    def without_steady_error(self) -> EkfState:
        """Return the state whose displacements share no error any more."""
        P, rows = self.covariances, self.steady_rows
        return changed(self, covariances=np.delete(np.delete(P, rows, 1), rows, 2), steady_W=None)

    def transformed(self, R: FloatArray, shift: FloatArray) -> EkfState:
        """Return the state in another frame: p <- R p + shift, R applied to attitude and velocity.

        A rotation about the vertical (and any shift) leaves gravity unchanged; the error is
        transformed with the frame exactly, by the adjoint of (R, shift).

        Args:
            R: (3, 3) rotation about the vertical.
            shift: (3,) [m].
        """
        new_origin, raised = R @ self.origin_W + shift, float(shift[2])
        origin_W = new_origin if np.linalg.norm(new_origin) > _MAX_ORIGIN_DISTANCE else np.zeros(3)
        shift = new_origin - origin_W  # the part that remains for the poses
        X = R @ self.X
        X[:, :, 4] += shift
        A = np.eye(self.covariances.shape[1])
        for first, rho in self._poses():
            A[first : first + 3, first : first + 3] = R
            A[rho : rho + 3, rho : rho + 3] = R
            A[rho : rho + 3, first : first + 3] = skew(shift) @ R
        A[3:6, 3:6] = R
        P = symmetric(A @ self.covariances @ A.T)
        field = self.field
        if field is not None:
            field = changed(field, azimuth=field.azimuth + math.atan2(R[1, 0], R[0, 0]))
        offset = self.offset
        if offset is not None:
            offset = changed(offset, metres=offset.metres - raised)
        return changed(self, X=X, origin_W=origin_W, covariances=P, field=field, offset=offset)

    def with_yaw_inflated(self, about_W: FloatArray, sigma: float) -> EkfState:
        """Return the state with its covariances inflated by a turn of the frame about a vertical.

        Args:
            about_W: (3,) a point on the vertical [m].
            sigma: standard deviation of the turn [rad].
        """
        x, y, _ = about_W - self.origin_W
        N = np.zeros((self.covariances.shape[1], 1))
        for first, rho in self._poses():
            N[first + 2, 0] = 1.0
            N[rho, 0], N[rho + 1, 0] = y, -x  # -e3 x p
        if self.field is not None:
            N[self.field_row, 0] = 1.0
        return changed(self, covariances=self.covariances + sigma**2 * (N @ N.T))

    def with_lost_yaw_forgotten(self) -> EkfState:
        """Return the state without correlation of where it lies and points with all the rest.

        Once the yaw is known to no more than `LOST_YAW`, its error is no small angle: what an
        update tells about other errors must neither turn nor move the track through it. With c the
        error of the current yaw and of the current position, which a tilt leaves where it is,
        x = N c + (I - N C) x splits off the motion N c of all poses and of the field with them, and
        the covariance between both parts is dropped.
        """
        if self.P[2, 2] < LOST_YAW**2:
            return self
        n = self.covariances.shape[1]
        C, N = np.zeros((4, n)), np.zeros((n, 4))
        C[0, 2] = 1.0
        C[1:, :2], C[1:, 6:9] = -skew(self.X[0, :, 4])[:, :2], np.eye(3)
        for first, rho in self._poses():
            N[first + 2, 0] = 1.0
            N[rho : rho + 3, 1:] = np.eye(3)
        if self.offset is not None:
            N[self.offset_row, 3] = -1.0
        if self.field is not None:
            N[self.field_row, 0] = 1.0
        rest = np.eye(n) - N @ C
        common = N @ (C @ self.covariances @ C.T) @ N.T
        return changed(self, covariances=common + symmetric(rest @ self.covariances @ rest.T))

    def with_position_inflated(self, sigma: float, axes: int = 3) -> EkfState:
        """Return the state with its covariances inflated by a shift, `sigma` [m] per axis.

        With two `axes` the shift is horizontal.
        """
        N = np.zeros((self.covariances.shape[1], axes))
        for _, rho in self._poses():
            N[rho : rho + axes] = np.eye(axes)
        if self.offset is not None and axes == 3:
            N[self.offset_row, 2] = -1.0
        return changed(self, covariances=self.covariances + sigma**2 * (N @ N.T))

    def _poses(self) -> list[tuple[int, int]]:
        """Return the first rows of theta and rho_p of the current pose and of every clone."""
        rows = (CORE + CLONE * slot for slot in self.clone_slots)
        return [(0, 6), *((first, first + 3) for first in rows)]
