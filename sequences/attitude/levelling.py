"""Attitude from the IMU alone: gravity initialisation and levelled integration.

The attitude is relative to frame N: gravity-aligned like W, with a yaw that is zero at the start
and drifts with the gyroscope. It needs neither ground truth nor a network, so that windows can be
prepared before any filter runs and are the same in streaming and batch, in training and inference.

A small Kalman filter over the attitude error and the gyroscope bias corrects the tilt: the specific
force, averaged over an update period and rotated into N, should point up, because a pedestrian's
mean acceleration vanishes over the filter's time constant of twelve seconds. Both are worth less
while the device is shaken: the gyroscope's errors grow with its rate, and the force is gravity only
as far as nothing accelerates. A shake then costs certainty, and the calm seconds after it tell what
is right. The bias is estimated in body axes, so that it stays valid when the device turns: phones
that report raw rates are off by up to 0.1 rad/s. The yaw is not observable here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np

from stario.sequences.arrays import even_grid, rms, scatter
from stario.sequences.attitude.rotations import tilt_aligning
from stario.sequences.attitude.so3 import cross, exp_so3
from stario.sequences.noise import GYRO_SCALE_ERROR
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray

PERIOD = 0.1
"""Time between corrections of the tilt [s]."""

START_SECONDS = 1.0
"""Length of the initial stretch whose mean specific force levels the first attitude [s]."""

STILL_ACCEL = 0.3
"""Deviation of the specific force [m/s^2] up to which its mean gives the vertical to 0.01 rad."""

STILL_GYRO = 0.1
"""Root mean square rate [rad/s], likewise; not a stillness test, since a hand may tremble."""

MIN_GRAVITY_FORCE = 1.0
"""Mean specific force [m/s^2] below which it has no direction: free fall, a dead sensor."""

_TILT_SIGMA = 0.05
"""Sigma of the tilt at the start and after a gap [rad]."""

BIAS_SIGMA = 0.01
"""Initial sigma of the gyroscope bias per axis [rad/s]; suits calibrated and raw gyroscopes."""

_BIAS_WALK = 2e-5
"""Random walk of the bias [rad/s/sqrt(s)]."""

_TURN_NOISE, _FORCE_NOISE = 8.5e-3, 0.1
"""Noise densities of the tilt [rad/sqrt(s)] and of a pedestrian's force direction [rad sqrt(s)];
their ratio is the rate at which the converged filter levels [1/s]."""

_PEDESTRIAN_ACCEL = _FORCE_NOISE / math.sqrt(PERIOD) * STANDARD_GRAVITY
"""Horizontal acceleration over an update period that `_FORCE_NOISE` stands for [m/s^2]."""

_NOISE = np.diag([_TURN_NOISE**2, _TURN_NOISE**2, 0.0, *[_BIAS_WALK**2] * 3])
_EYE = np.eye(6)


@dataclass(frozen=True, eq=False)
class GravityStart:
    """Initial attitude from gravity.

    Attributes:
        R_WB: (3, 3) at the first sample, yaw zero.
        still: whether the device was still enough for the tilt to be trusted.
        force: magnitude of the mean specific force [m/s^2]; gravity, if the units are right.
        turn_rate: root mean square rate [rad/s].
    """

    R_WB: FloatArray
    still: bool
    force: float
    turn_rate: float

    @property
    def up_B(self) -> FloatArray:
        """Upward direction at the first sample (3,)."""
        return np.asarray(self.R_WB[2])

    @property
    def motion_intensity(self) -> float:
        """Factor on the tilt's sigma of a moving device: 1 up to 1 rad/s, then as the rate.

        On 1,784 seconds of OxIOD, TUM-VI, RIDI, KIPD, rfbr and tyrex the tilt's error per axis is
        0.02 rad at rates up to 0.6 rad/s, 0.05 at 1.0, 0.07 at 1.5 and 0.14 at 3.4 (running).
        """
        return max(1.0, self.turn_rate)


def start_from_gravity(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> GravityStart:
    """Level the first attitude with the mean specific force of a short stretch.

    The samples are rotated into the first sample's axes with the gyroscope before averaging, so
    that the device may move.

    Args:
        time: (n + 1,) [s], about one second.
        gyro: (n + 1, 3) [rad/s] in B.
        accel: (n + 1, 3) [m/s^2] in B.
    """
    R_0B = integrate(np.eye(3), time, gyro)
    force_0 = (R_0B @ accel[:, :, None])[:, :, 0]
    turn_rate = rms(gyro)
    still = scatter(force_0) < STILL_ACCEL and turn_rate < STILL_GYRO
    up = force_0.mean(axis=0)
    force = float(np.linalg.norm(up))
    R_WB = tilt_aligning(up).as_matrix() if force > MIN_GRAVITY_FORCE else np.eye(3)
    return GravityStart(R_WB, still, force, turn_rate)


def integrate(R_NB: FloatArray, time: FloatArray, gyro: FloatArray) -> FloatArray:
    """Integrate the gyroscope from the attitude at the first sample: (n + 1, 3, 3).

    Uses the mean rate and a coning correction (Savage 1998), as in the filter's preintegration.
    """
    dt = (time[1:] - time[:-1])[:, None]
    turns = dt * (0.5 * (gyro[:-1] + gyro[1:]) + dt / 12.0 * cross(gyro[:-1], gyro[1:]))
    return np.array([*accumulate(exp_so3(turns), np.matmul, initial=R_NB)])


def levelled_attitudes(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
    """Return attitudes R_NB (n, 3, 3) at the samples of an unbroken stretch, as at inference.

    Args:
        time: (n,) [s].
        gyro: (n, 3) [rad/s] in B.
        accel: (n, 3) [m/s^2] in B.
    """
    first = np.searchsorted(time, time[0] + START_SECONDS, side="right")
    start = start_from_gravity(time[:first], gyro[:first], accel[:first])
    loop = LevelledAttitude(start)
    grid = even_grid(time[0] + PERIOD, time[-1], PERIOD)
    ends = np.unique([0, *np.searchsorted(time, grid), len(time) - 1])
    attitudes = np.empty((len(time), 3, 3))
    attitudes[0] = start.R_WB
    for begin, end in pairwise(ends.tolist()):
        part = slice(begin, end + 1)
        attitudes[part] = loop.advance(time[part], gyro[part], accel[part])
    return attitudes


class LevelledAttitude:
    """Attitude R_NB, integrated from the gyroscope and levelled by the accelerometer.

    Args:
        start: attitude at the start.

    Attributes:
        R_NB: (3, 3) current attitude.
        b_g: (3,) gyroscope bias [rad/s], as far as it is observable from gravity.
    """

    def __init__(self, start: GravityStart) -> None:
        self.R_NB = start.R_WB
        self.b_g = np.zeros(3)
        tilt, bias = (start.motion_intensity * _TILT_SIGMA) ** 2, BIAS_SIGMA**2
        # Covariance of theta about N's axes, R = (I + [theta]x) R^, and of the bias error.
        self._P = np.diag([tilt, tilt, 0.0, bias, bias, bias])

    def advance(self, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
        """Advance by one update period and return the attitudes (n + 1, 3, 3) at its samples.

        Args:
            time: (n + 1,) [s].
            gyro: (n + 1, 3) [rad/s] in B.
            accel: (n + 1, 3) [m/s^2] in B.
        """
        attitudes = integrate(self.R_NB, time, gyro - self.b_g)
        self.R_NB = self._levelled(attitudes, time, accel, GYRO_SCALE_ERROR * rms(gyro))
        return attitudes

    def level(self, turn: FloatArray, start: GravityStart) -> None:
        """Set the attitude after a gap: turned as expected, then levelled by the smallest rotation.

        Args:
            turn: (3, 3) rotation from the body after it to that before.
            start: attitude from gravity after it.
        """
        R_NB = self.R_NB @ turn
        self.R_NB = tilt_aligning(R_NB @ start.up_B).as_matrix() @ R_NB
        self._P[:3], self._P[:, :3] = 0.0, 0.0
        self._P[:2, :2] = (start.motion_intensity * _TILT_SIGMA) ** 2 * np.eye(2)

    def _levelled(
        self, attitudes: FloatArray, time: FloatArray, accel: FloatArray, rate_error: float
    ) -> FloatArray:
        dt = float(time[-1] - time[0])
        force_N = (attitudes @ accel[:, :, None])[:, :, 0]
        up = (0.5 * (time[1:] - time[:-1])) @ (force_N[1:] + force_N[:-1]) / dt
        force = math.sqrt(up @ up)
        # Acceleration shows as unrest, and as a mean force that is not gravity's.
        accel2 = scatter(force_N) ** 2 + (force - STANDARD_GRAVITY) ** 2
        force_variance = _FORCE_NOISE**2 / dt * (1.0 + accel2 / _PEDESTRIAN_ACCEL**2)
        up /= max(force, MIN_GRAVITY_FORCE)
        F = _EYE.copy()  # theta' = theta - dt R d_bg
        F[:3, 3:] = -dt * (attitudes.sum(axis=0) / len(attitudes))
        P = F @ self._P @ F.T + dt * _NOISE
        P[:2, :2] += (rate_error * dt) ** 2 * _EYE[:2, :2]
        gain = P[:, :2] @ _inverse(P[:2, :2], force_variance)
        P = P - gain @ P[:2]
        self._P = 0.5 * (P + P.T)
        # The smallest rotation that takes `up` to the vertical, to first order; none about it.
        x = gain @ np.array([up[1], -up[0]])
        self.b_g = self.b_g + x[3:]
        turned: FloatArray = exp_so3(np.array([x[0], x[1], 0.0])) @ attitudes[-1]
        return turned


def _inverse(P: FloatArray, noise: float) -> FloatArray:
    """Return (P + noise I)^-1 of a symmetric P (2, 2)."""
    a, b, d = float(P[0, 0]) + noise, float(P[0, 1]), float(P[1, 1]) + noise
    return np.array([[d, -b], [-b, a]]) / (a * d - b * b)
