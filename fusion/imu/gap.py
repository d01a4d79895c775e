"""A gap without samples: constant velocity, with a pedestrian's motion as noise.

No force is measured that a wrong tilt could rotate, so the motion does not depend on the attitude.
In a short gap the rates at its ends tell the rotation. README.md, "Propagation".
"""

from __future__ import annotations

import numpy as np

from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.values.config import MIN_WALK, NavigatorConfig
from stario.fusion.values.lie import UNKNOWN_YAW, e3_cross
from stario.sequences.attitude.levelling import integrate
from stario.sequences.sequence import FloatArray

INTERPOLATED = 1.0
"""Length of a gap [s] up to which the rates at its ends tell how the device turned in it. Linear
rates in between leave a yaw error of 3, 5, 12 and 22 degrees (root mean square) after 0.2, 0.3, 0.5
and 0.8 s on OxIOD, TUM-VI, RIDI, KIPD and tyrex, a constant attitude 9, 13, 20 and 30."""

YAW_RATE, YAW_GROWTH = 0.5, 1.0
"""Standard deviation of the yaw's error per second of a gap [rad/s], and with interpolated rates,
per second squared [rad/s^2] while that is less; both of a device that turns at up to 1 rad/s in the
second after the gap, and in proportion to that rate beyond. On OxIOD, TUM-VI, RIDI, KIPD and tyrex
the errors after 0.3, 0.8 and 2.0 s are 0.05, 0.25 and 1.0 rad (root mean square) at rates from 0.5
to 1 rad/s, 0.11, 0.53 and 1.3 from 1.5 to 2.5, and 0.22, 1.3 and 2.1 from 2.5 to 4 (running)."""

_STEPS = 10
"""Number of samples at which the rates in a gap are interpolated."""

_EYE = np.eye(3)


def gap_rotation(table: FloatArray, length: float, b_g: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from the body after a gap, or part of one, to that before it.

    Args:
        table: (2, 7) samples at both ends: time, gyro and accel.
        length: length of the whole gap [s].
        b_g: (3,) gyroscope bias [rad/s].
    """
    if length > INTERPOLATED:
        return _EYE
    time = np.linspace(table[0, 0], table[-1, 0], _STEPS)
    part = (time - time[0])[:, None] / (time[-1] - time[0])
    gyro = table[0, 1:4] + part * (table[-1, 1:4] - table[0, 1:4])
    return np.asarray(integrate(_EYE, time, gyro - b_g)[-1])


def yaw_variance(seconds: float, gap: ImuInterval) -> float:
    """Return the variance of the yaw's error since a gap began [rad^2].

    Args:
        seconds: time since then [s].
        gap: the whole gap.
    """
    assert gap.levelled is not None  # it comes with the end of every gap
    rate = YAW_RATE
    if gap.duration <= INTERPOLATED:
        rate = min(rate, YAW_GROWTH * seconds)
    return min(gap.levelled.motion_intensity * rate * seconds, UNKNOWN_YAW) ** 2


def gap_covariance(
    seconds: float, turn_variance: float, v_W: FloatArray, config: NavigatorConfig
) -> FloatArray:
    """Return the covariance (15, 15) that a gap adds to theta, v, p and the biases.

    These are plain errors; theta is a rotation in W's axes.

    Args:
        seconds: length t of the gap [s].
        turn_variance: variance of an unobserved turn psi about the vertical through its start
            [rad^2], which turns the velocity: psi (e3, e3 x v, t e3 x v).
        v_W: (3,) velocity v [m/s]; zero if the motion contains that turn already.
        config: noise densities.
    """
    f, t = config.filter, seconds
    sideways = e3_cross(v_W)
    turn = np.concatenate([[0.0, 0.0, 1.0], sideways, t * sideways, np.zeros(6)])
    covariance: FloatArray = turn_variance * np.outer(turn, turn)
    covariance[:2, :2] += t * f.gap_gyro_noise**2 * np.eye(2)
    white = f.gap_accel_noise**2 * np.array([[t, t**2 / 2.0], [t**2 / 2.0, t**3 / 3.0]])
    covariance[3:9, 3:9] += np.kron(white, _EYE)
    walks = np.maximum([config.noise.gyro_walk, config.noise.accel_walk], MIN_WALK)
    covariance[9:, 9:] += np.diag(t * np.repeat(walks, 3) ** 2)
    return covariance
