"""A gap without samples: constant velocity and attitude, with a pedestrian's motion as noise.

No force is measured that a wrong tilt could rotate, so the motion does not depend on the attitude.
README.md, "Propagation".
"""

from __future__ import annotations

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.lie import UNKNOWN_YAW
from stario.sequences.sequence import FloatArray

YAW_RATE = 0.5
"""Standard deviation of a pedestrian's turn per second of a gap [rad/s]: 0.4 to 1.0 over one second
and 0.36 to 0.7 per second over three in the training and validation recordings."""

_MIN_WALK = 1e-7
"""Least random walk of a bias: a graph inverts the covariance."""

_EYE = np.eye(3)


def yaw_variance(seconds: float) -> float:
    """Return the variance of a pedestrian's turn, at a constant rate, since a gap began [rad^2]."""
    return min(YAW_RATE * seconds, UNKNOWN_YAW) ** 2


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
    sideways = np.array([-v_W[1], v_W[0], 0.0])  # e3 x v
    turn = np.concatenate([[0.0, 0.0, 1.0], sideways, t * sideways, np.zeros(6)])
    covariance: FloatArray = turn_variance * np.outer(turn, turn)
    covariance[:3, :3] += t * f.gap_gyro_noise**2 * _EYE
    white = f.gap_accel_noise**2 * np.array([[t, t**2 / 2.0], [t**2 / 2.0, t**3 / 3.0]])
    covariance[3:9, 3:9] += np.kron(white, _EYE)
    walks = np.maximum([config.noise.gyro_walk, config.noise.accel_walk], _MIN_WALK)
    covariance[9:, 9:] += np.diag(t * np.repeat(walks, 3) ** 2)
    return covariance
