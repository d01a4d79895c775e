"""The filter's first state, and its state after a gap too long to bridge."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.jacobians import POSITION, VELOCITY
from stario.fusion.filter.kalman import Linear, update
from stario.fusion.imu.intervals import ImuInterval, Start
from stario.fusion.values.checked import checked, checked_rotation
from stario.fusion.values.config import MIN_PRIOR_SIGMA, NavigatorConfig
from stario.fusion.values.lie import UNKNOWN_YAW, yaw_rotation
from stario.fusion.values.state import NavState
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray
from stario.sequences.settings import check_number

STILL_TILT_SIGMA = 0.01
"""Tilt sigma of the first attitude if the device was at rest [rad]."""

VELOCITY_SIGMA = 1.5
"""Standard deviation of a pedestrian's velocity per axis [m/s]."""

_MAX_PRIOR_TILT = 1.0
"""Angle [rad] between a prior's vertical and that of the first second, beyond three sigmas of the
prior: more than a swinging device's own acceleration causes."""

_MAX_PRIOR_SIGMA = 1e5
"""Largest standard deviation of a prior [rad], [m/s], [m], beyond which the covariance keeps no
digits for the rest."""

MAX_GAP_DISTANCE = 1e4
"""Maximum distance assumed to be covered in a gap [m]: the covariance must keep its digits."""


@dataclass(frozen=True, eq=False)
class PriorPose:
    """Prior on the first pose, at the time of the first sample.

    Attributes:
        R_WB: (3, 3) attitude.
        v_W: (3,) velocity [m/s].
        p_W: (3,) position [m].
        tilt_sigma: standard deviation of the tilt [rad].
        yaw_sigma: standard deviation of the yaw [rad].
        velocity_sigma: standard deviation of the velocity per axis [m/s].
        position_sigma: standard deviation of the position per axis [m].

    Raises:
        InputError: a value has the wrong shape or is not finite, `R_WB` is not a rotation, or a
            sigma is negative or above 1e5.
    """

    R_WB: FloatArray
    v_W: FloatArray
    p_W: FloatArray
    tilt_sigma: float = 0.02
    yaw_sigma: float = 0.02
    velocity_sigma: float = 0.1
    position_sigma: float = 1e-3

    def __post_init__(self) -> None:
        for name in ("v_W", "p_W"):
            object.__setattr__(self, name, checked(name, getattr(self, name), (3,)))
        object.__setattr__(self, "R_WB", checked_rotation(self.R_WB))
        for name in ("tilt_sigma", "yaw_sigma", "velocity_sigma", "position_sigma"):
            object.__setattr__(self, name, float(checked(name, getattr(self, name), ())))
            check_number(self, name, high=_MAX_PRIOR_SIGMA)


def tilt_sigma(start: Start, config: NavigatorConfig) -> float:
    """Return the standard deviation of an attitude's tilt from gravity [rad]."""
    return STILL_TILT_SIGMA if start.still else start.motion_intensity * config.filter.tilt_sigma


def first_state(start: Start, prior: PriorPose | None, config: NavigatorConfig) -> EkfState:
    """Return the first state: the prior if given, else levelled by gravity, at rest, at the origin.

    Raises:
        InputError: gravity contradicts the prior's attitude.
    """
    if prior is not None:
        _check_tilt(prior, start)
    f = config.filter
    tilt = tilt_sigma(start, config)
    zero = np.zeros(3)
    pose = prior or PriorPose(start.R_WB, zero, zero, tilt, f.yaw_sigma, f.velocity_sigma)
    sigma = [pose.tilt_sigma] * 2 + [pose.yaw_sigma]
    sigma += [pose.velocity_sigma] * 3 + [pose.position_sigma] * 3
    sigma += [f.gyro_bias_sigma] * 3 + [f.accel_bias_sigma] * 3
    covariance = np.diag(np.square(np.maximum(sigma, MIN_PRIOR_SIGMA)))
    state = NavState(start.time, pose.R_WB, pose.v_W, pose.p_W, zero, zero, covariance)
    return EkfState.initial(state, f.window_updates)


def _check_tilt(prior: PriorPose, start: Start) -> None:
    """Check a prior's vertical by gravity: the transposed attitude is easily given.

    Raises:
        InputError: they are too far apart.
    """
    off = math.acos(min(max(float(prior.R_WB[2] @ start.up_B), -1.0), 1.0))
    allowed = _MAX_PRIOR_TILT + 3.0 * prior.tilt_sigma
    if off > allowed:
        found = f"a vertical {math.degrees(off):.0f} degrees from that of gravity"
        expected = f"at most {math.degrees(allowed):.0f} at this tilt_sigma"
        raise InputError("prior: R_WB", found, expected, "R_WB maps vectors from B to W")


def with_velocity_bounded(s: EkfState) -> EkfState:
    """Return the state with a pedestrian's velocity as a measurement, if less is known about it.

    After an impact that the accelerometer could not follow the velocity would otherwise carry the
    track away until the next window ends.
    """
    if s.P[VELOCITY, VELOCITY].diagonal().max() <= VELOCITY_SIGMA**2:
        return s
    measured = Linear(-s.v_W, [(VELOCITY.start, np.eye(3))], VELOCITY_SIGMA**2 * np.eye(3))
    return update(s, measured)[0]


def state_after_loss(s: EkfState, interval: ImuInterval, config: NavigatorConfig) -> EkfState:
    """Return the state after a long gap: tilt from gravity, velocity and yaw unknown."""
    f, start = config.filter, interval.levelled
    assert start is not None  # no gap is that long without
    covariance, seconds = s.nav_state().covariance, interval.duration
    # The position stays correlated with the biases that led there.
    covariance[:6], covariance[:, :6] = 0.0, 0.0
    tilt = tilt_sigma(start, config)
    covariance[:3, :3] = np.diag(np.square([tilt, tilt, UNKNOWN_YAW]))
    covariance[3:6, 3:6] = max(f.velocity_sigma, MIN_PRIOR_SIGMA) ** 2 * np.eye(3)
    reach = min(VELOCITY_SIGMA * seconds, MAX_GAP_DISTANCE)
    covariance[POSITION, POSITION] += reach**2 * np.eye(3)
    walks = np.repeat([config.noise.gyro_walk, config.noise.accel_walk], 3)
    turn_on_sigma = np.repeat([f.gyro_bias_sigma, f.accel_bias_sigma], 3)  # limits the walk
    drift = np.minimum(seconds * np.square(walks), np.square(turn_on_sigma))
    covariance[9:, 9:] += np.diag(drift)
    R_WB, v_W = yaw_rotation(s.R_WB) @ start.R_WB, np.zeros(3)
    state = NavState(interval.stop, R_WB, v_W, s.p_W, s.b_g, s.b_a, covariance)
    return EkfState.initial(state, len(s.clone_times))
