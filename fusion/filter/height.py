"""Height from the air's pressure, relative to the start.

README.md, "Barometer". Pressure tells height but for an offset, which nobody knows at the start,
which wanders with the weather and steps where a door opens. It is one more state,

    height by the pressure = p_z + offset,   offset a random walk

added with the first height as a clone is: exactly, with the correlations that this measurement
gives it. So pressure observes changes of height and never height itself. While one climbs, neither
the network, which learned on level floors, nor a device that lies still (in a lift) says anything
about the vertical.
"""

from __future__ import annotations

import math

import numpy as np

from stario.fusion.filter.ekf_state import EkfState, PressureOffset
from stario.fusion.filter.jacobians import REPORTED, position_jacobian, velocity_jacobian
from stario.fusion.filter.kalman import Linear, UpdateResult, update
from stario.fusion.filter.zero_velocity import ZeroVelocity
from stario.fusion.imu.barometer import HeightSample, is_step
from stario.fusion.imu.inference import WindowDisplacement
from stario.fusion.values.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

WEATHER_WALK = 0.03
"""Random walk of the offset [m/sqrt(s)]: weather and ventilation (28 level walks of IPIN 2023: 0.3
m after one minute beyond what changes within seconds)."""

CLIMB_SIGMA = 1.0
"""Sigma of the height of a displacement while one climbs [m]: of a lift, nothing is known."""

LEVEL_SIGMA = 0.1
"""Sigma of the height of other displacements [m], beside the network's: a short stair or a ramp is
taken from the pressure, too."""

STAIRS_SLOPE = 0.6
"""Slope of stairs: a rise of 17 cm on a tread of 28."""

_PATH, _STAIRS = 0.08, 0.2
"""Slopes by the network's speed up to which one is on a path, and from which on stairs."""

WALKING = 0.4
"""Speed by the network [m/s] above which one walks on stairs, below which one stands in a lift."""

_UNHEARD_SECONDS = 2.0
"""Time without a height after which it is not known whether one climbs [s]: three are missing, and
a lift may have risen two metres."""

_GATE = 0.99
"""Probability of the height's chi-square test; outliers are inflated."""


def with_height(s: EkfState, sample: HeightSample) -> tuple[EkfState, UpdateResult]:
    """Update a state with a height; the first one only determines the offset."""
    residual, H = _linear(s, sample)
    if s.offset is None:
        return _with_offset(s, sample, residual, H), UpdateResult()
    s = _propagated(s, s.offset, sample)
    blocks = [(0, H), (s.offset_row, np.ones((1, 1)))]
    R = np.array([[sample.sigma**2]])
    return update(s, Linear(np.array([residual]), blocks, R), chi2_quantile(_GATE, 1))


def with_step(s: EkfState, sample: HeightSample) -> HeightSample:
    """Return a height of a known climb with the step of the air, if it is more likely one.

    Accelerometer and speed predict where a climb goes on. Two hypotheses explain what differs:
    noise of the predicted variance, or a step, whose variance the difference itself tells.
    """
    if s.offset is None or not sample.rate or sample.risen:
        return sample
    residual, H = _linear(s, sample)
    s = _propagated(s, s.offset, sample)
    row = np.zeros(s.covariances.shape[1])
    row[: H.shape[1]], row[s.offset_row] = H[0], 1.0
    variance = float(row @ s.covariances[REPORTED] @ row) + sample.sigma**2
    return sample._replace(stepped=residual) if is_step(residual, variance) else sample


def yielding(displacement: WindowDisplacement, rate: float) -> WindowDisplacement:
    """Return a displacement whose height yields to the pressure's, on stairs its length as well.

    The networks take steps on stairs for those on a floor, which lead twice as far.

    Args:
        displacement: the network's.
        rate: vertical speed by the pressure while one climbs [m/s]; 0 on a floor, `UNKNOWN_RATE` if
            it is not known whether one climbs.
    """
    covariance_N, d_N = displacement.covariance_N.copy(), displacement.d_N
    covariance_N[2, 2] += (CLIMB_SIGMA if rate else LEVEL_SIGMA) ** 2
    speed = math.hypot(d_N[0], d_N[1]) / WINDOW_SECONDS
    if speed > WALKING:
        slope = abs(rate) / speed
        on_stairs = min(max((slope - _PATH) / (_STAIRS - _PATH), 0.0), 1.0)
        share = 1.0 - on_stairs + on_stairs * min(1.0, slope / STAIRS_SLOPE)
        d_N = d_N * np.array([share, share, 1.0])
    return displacement._replace(d_N=d_N, covariance_N=covariance_N)


def silent(s: EkfState) -> bool:
    """Return whether there was a pressure, but no height for so long that one may climb by now."""
    return s.offset is not None and s.time - s.offset.time > _UNHEARD_SECONDS


def resting_in_lift(measured: ZeroVelocity) -> ZeroVelocity:
    """Return a measurement at rest that says nothing about the vertical velocity."""
    covariance = measured.covariance.copy()
    covariance[2, 2] += CLIMB_SIGMA**2
    return measured._replace(covariance=covariance)


def _linear(s: EkfState, sample: HeightSample) -> tuple[float, FloatArray]:
    """Return measured minus predicted height and its Jacobian (1, 9) but for the offset."""
    ago = s.time - sample.time
    H = position_jacobian(s.X[0, :, 4])[0][1][2:].copy()
    H[:, :6] -= ago * velocity_jacobian(s.v_W)[0][1][2:]
    predicted = s.p_W[2] - ago * s.v_W[2] + (0.0 if s.offset is None else s.offset.metres)
    return float(sample.height - predicted), H


def _with_offset(s: EkfState, sample: HeightSample, residual: float, H: FloatArray) -> EkfState:
    """Return the state with the offset that a height determines: error -H x + noise."""
    row, n = s.offset_row, s.covariances.shape[1]
    A = np.insert(np.eye(n), row, 0.0, axis=0)
    A[row, : H.shape[1]] = -H
    P = A @ s.covariances @ A.T
    P[:, row, row] += sample.sigma**2
    return changed(s, covariances=P, offset=PressureOffset(residual, sample.time))


def _propagated(s: EkfState, offset: PressureOffset, sample: HeightSample) -> EkfState:
    """Return the state with what may have changed since the last height."""
    P, row = s.covariances.copy(), s.offset_row
    P[:, row, row] += WEATHER_WALK**2 * (sample.time - offset.time) + sample.stepped**2
    if sample.risen:  # a climb that was not known as one before
        P[:, 5, 5] += sample.rate**2
        P[:, 8, 8] += sample.risen**2
    return changed(s, covariances=P, offset=changed(offset, time=sample.time))
