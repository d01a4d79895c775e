"""Right-invariant EKF over the current state and cloned poses: from one state to the next.

The state lies on SE_2(3) and SE(3) (`EkfState`): an update's mean error is moved into it by the
group's exponential. An empty slot has zero covariance and zero columns in every Jacobian.
Derivation and sources: README.md, "Error state" to "Displacement measurement".
"""

from __future__ import annotations

import math

import numpy as np

from stario.fusion.filter.correlated_errors import DisplacementErrors, with_considered_propagated
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.jacobians import (
    CLONED,
    GAIN,
    REPORTED,
    Propagation,
    bearing_jacobian,
    displacement_jacobian,
    position_jacobian,
    propagated,
    propagated_in_gap,
    velocity_jacobian,
    yaw_jacobian,
)
from stario.fusion.filter.kalman import TO_GATE, Linear, UpdateResult, predict, update
from stario.fusion.imu.gap import gap_rotation, yaw_variance
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.imu.preintegration import Segment
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.lie import yaw_twist
from stario.fusion.values.state import changed
from stario.sequences.attitude.rotations import tilt_aligning
from stario.sequences.attitude.so3 import log_so3
from stario.sequences.sequence import FloatArray

Updated = tuple[EkfState, UpdateResult]
"""State after a measurement, and the outcome."""


def propagate(s: EkfState, segment: Segment, accel_share: float = 1.0) -> EkfState:
    """Propagate through a preintegrated segment.

    Args:
        s: the state before.
        segment: the segment.
        accel_share: actual variance of the accelerometer's noise, as a fraction of that in the
            segment, which the gains assume.
    """
    return _moved(s, segment.stop, propagated(segment, *s.pose, s.b_g, s.b_a, accel_share))


def propagate_in_gap(
    s: EkfState, piece: ImuInterval, gap: ImuInterval, config: NavigatorConfig
) -> EkfState:
    """Propagate without samples through a gap, or through a piece of it between fixes."""
    R, v, p = s.pose
    rotation = gap_rotation(piece.table, gap.duration, s.b_g)
    before, after = (yaw_variance(time - gap.start, gap) for time in (piece.start, piece.stop))
    pose = R @ rotation, v, p
    end = propagated_in_gap(piece.duration, after - before, *pose, config)
    return _moved(s, piece.stop, end)


def _moved(s: EkfState, time: float, end: Propagation) -> EkfState:
    """Return the state after a propagation of the current pose to a time [s]."""
    X = s.X.copy()
    X[0, :, :3], X[0, :, 3], X[0, :, 4] = end.R_WB, end.v_W, end.p_W
    P = predict(s.covariances, end.transition, end.noise)
    return changed(s, time=time, X=X, covariances=P)


def clone(s: EkfState, instead_of: int | None = None) -> EkfState:
    """Copy the current pose into a slot.

    Args:
        s: the state.
        instead_of: slot of a clone to replace; None for the first free slot.
    """
    slot = s.clone_times.index(None) if instead_of is None else instead_of
    X = s.X.copy()
    X[1 + slot] = X[0]
    X[1 + slot, :, 3] = 0.0
    rows, P = s.clone_rows(slot), s.covariances.copy()
    P[:, rows] = P[:, CLONED]
    P[:, :, rows] = P[:, :, CLONED]
    times = (*s.clone_times[:slot], s.time, *s.clone_times[slot + 1 :])
    return changed(s, X=X, covariances=P, clone_times=times)


def release(s: EkfState, slot: int) -> EkfState:
    """Drop the clone in a slot."""
    times = (*s.clone_times[:slot], None, *s.clone_times[slot + 1 :])
    rows, P = s.clone_rows(slot), s.covariances.copy()
    P[:, rows] = 0.0
    P[:, :, rows] = 0.0
    return changed(s, covariances=P, clone_times=times)


# --- measurements: README.md, "Displacement measurement" to "Fixes" ------------------------------


def update_displacement(
    s: EkfState,
    slot: int,
    d_W: FloatArray,
    covariance: FloatArray,
    gate: float | None = None,
    errors: DisplacementErrors | None = None,
    gains_from: int = GAIN,
    power: float = 1.0,
) -> Updated:
    """Update with the displacement from clone i to the current pose j, in the estimated world.

    The caller has rotated the network's displacement from N to W by the estimated yaw of clone
    i, so that it contains the error of this yaw, p_j - p_i = (I + theta_iz [e3]x) d + n. Those of
    its errors that last are considered.

    Args:
        s: the state.
        slot: slot of the clone where the window began.
        d_W: (3,) displacement [m].
        covariance: (3, 3) covariance in the same axes [m^2]; overlapping windows contain the
            same motion, so the caller scales it by update rate x window length.
        gate: as for `kalman.update`.
        errors: its errors as they are; None if they are white with that covariance.
        gains_from: as for `kalman.update`.
        power: likewise.
    """
    p_i, p_j = s.X[1 + slot, :, 4], s.X[0, :, 4]
    blocks = displacement_jacobian(p_i, p_j, slot)
    before, noise = s, None
    if errors is not None:
        noise, s = errors.white, with_considered_propagated(s)
        blocks.append((s.considered_rows.start, errors.considered))
    if s.steady_W is not None:
        d_W = d_W - s.steady_W
        blocks.append((s.steady_rows.start, np.eye(3)))
    measured = Linear(d_W - (p_j - p_i), blocks, covariance, noise)
    after, result = update(s, measured, gate, gains_from, power)
    return (after if result.accepted else before), result


def update_position_W(
    s: EkfState, p_W: FloatArray, covariance: FloatArray, gate: float | None = None
) -> Updated:
    """Update with the current position (3,) [m], covariance (3, 3) [m^2]."""
    predicted = s.X[0, :, 4]
    residual = p_W - s.origin_W - predicted
    measured = Linear(residual, position_jacobian(predicted), covariance)
    return update(s, measured, gate, gains_from=REPORTED, power=TO_GATE)


def update_velocity_W(
    s: EkfState, v_W: FloatArray, covariance: FloatArray, gate: float | None = None
) -> Updated:
    """Update with the current velocity (3,) [m/s] in the true W, covariance (3, 3)."""
    measured = Linear(v_W - s.v_W, velocity_jacobian(s.v_W), covariance)
    return update(s, measured, gate, gains_from=REPORTED, power=TO_GATE)


def update_tilt(s: EkfState, up_B: FloatArray, sigma: float) -> Updated:
    """Update with the upward direction in B: unit vector (3,), standard deviation [rad].

    The residual is the smallest rotation that takes R up_B to the vertical, theta's first two
    components.
    """
    turn = log_so3(tilt_aligning(s.R_WB @ up_B).as_matrix())[:2]
    return update(s, Linear(turn, [(0, np.eye(2))], sigma**2 * np.eye(2)))


def update_yaw(s: EkfState, yaw: float, sigma: float, gate: float | None = None) -> Updated:
    """Update with the current yaw [rad] as defined by `yaw_twist`; rejected if upside down."""
    residual = np.array([math.remainder(yaw - yaw_twist(s.R_WB), 2.0 * math.pi)])
    if not math.isfinite(residual[0]):
        return s, UpdateResult("yaw not defined upside down")
    measured = Linear(residual, yaw_jacobian(s.R_WB), np.array([[sigma * sigma]]))
    return update(s, measured, gate, gains_from=REPORTED, power=TO_GATE)


def update_bearing(
    s: EkfState, m_B: FloatArray, variance: float, gate: float | None = None
) -> Updated:
    """Update with the bearing of a magnetic field, which measures the state's azimuth.

    Args:
        s: the state, which must have a field (`magnetic.with_field`).
        m_B: (3,) measured field [uT].
        variance: variance of its bearing [rad^2].
        gate: as for the other updates; outliers are inflated.
    """
    assert s.field is not None
    m_W = s.R_WB @ (m_B - s.field.hard_iron_B)
    bearing = math.atan2(m_W[1], m_W[0])
    residual = math.remainder(bearing - s.field.azimuth - s.field.disturbance, 2.0 * math.pi)
    blocks = bearing_jacobian(s.R_WB, m_W, s.field_row)
    return update(s, Linear(np.array([residual]), blocks, np.array([[variance]])), gate)
