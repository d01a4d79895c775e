"""Attitude from the IMU alone: gravity initialisation and a levelled integration.

N is the frame this attitude is given in: gravity-aligned like W, its yaw zero at the start and
drifting with the gyroscope. It needs neither truth nor network, so that windows can be prepared
before any filter runs, streaming and batch see the same ones, and a network can be trained on what
it will be shown.

A small Kalman filter over the attitude's error and the gyroscope's bias corrects the tilt: the
specific force, averaged over an update period and seen in N, should point up, and the mean of a
walker's acceleration vanishes over the filter's time constant of twelve seconds. The bias is one in
body axes, so that it stays right when the device turns: phones that hand out raw rates are off by
up to 0.1 rad/s. Nothing here tells the yaw.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from stario.sequences.attitude.rotations import tilt_aligning
from stario.sequences.attitude.so3 import cross, exp_so3
from stario.sequences.sequence import FloatArray

PERIOD = 0.1
"""Between corrections of the tilt [s]."""

START_SECONDS = 1.0
"""Length of the stretch whose mean specific force levels the first attitude [s]."""

STILL_ACCEL = 0.3
"""Deviation of the specific force [m/s^2] up to which its mean shows the vertical to 0.01 rad."""

STILL_GYRO = 0.1
"""Root mean square rate [rad/s], likewise: no measure of rest, for a hand may tremble."""

LEAST_FORCE = 1.0
"""Mean specific force [m/s^2] below which it shows no vertical: free fall, a dead sensor."""

_TILT_SIGMA = 0.05
"""Of the tilt at first and behind a gap [rad]."""

BIAS_SIGMA = 0.01
"""Of the gyroscope's bias at first, per axis [rad/s]: right ones keep, raw ones find theirs."""

_BIAS_WALK = 2e-5
"""Of the bias [rad/s/sqrt(s)]."""

_TURN_NOISE, _FORCE_NOISE = 8.5e-3, 0.1
"""Densities of tilt [rad/sqrt(s)] and of the direction of force of a walker [rad sqrt(s)]; their
ratio is the rate at which a settled filter levels [1/s]."""


@dataclass(frozen=True, eq=False)
class GravityStart:
    """First attitude from gravity.

    Attributes:
        R_WB: (3, 3) at the first sample, yaw zero.
        still: whether the device was at rest, so that the tilt can be trusted.
        force: size of the mean specific force [m/s^2]; gravity, if the units are right.
    """

    R_WB: FloatArray
    still: bool
    force: float


def start_from_gravity(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> GravityStart:
    """Level the first attitude by the mean specific force of a short stretch.

    The samples are turned into the first sample's axes with the gyroscope before averaging, so
    that the stretch may be one of motion.

    Args:
        time: (n + 1,) [s], about one second.
        gyro: (n + 1, 3) [rad/s] in B.
        accel: (n + 1, 3) [m/s^2] in B.
    """
    R_0B = integrate(np.eye(3), time, gyro)
    force_0 = (R_0B @ accel[:, :, None])[:, :, 0]
    still = bool(
        np.linalg.norm(force_0.std(axis=0)) < STILL_ACCEL
        and math.sqrt(float((gyro**2).sum(axis=1).mean())) < STILL_GYRO
    )
    up = force_0.mean(axis=0)
    force = float(np.linalg.norm(up))
    R_WB = tilt_aligning(up).as_matrix() if force > LEAST_FORCE else np.eye(3)
    return GravityStart(R_WB, still, force)


def integrate(R_NB: FloatArray, time: FloatArray, gyro: FloatArray) -> FloatArray:
    """Attitudes (n + 1, 3, 3) at the samples from the one at the first sample.

    Mean rate and coning (Savage 1998), as in the filter's preintegration.
    """
    dt = (time[1:] - time[:-1])[:, None]
    turns = dt * (0.5 * (gyro[:-1] + gyro[1:]) + dt / 12.0 * cross(gyro[:-1], gyro[1:]))
    attitudes = np.empty((len(time), 3, 3))
    attitudes[0] = R_NB
    for k, turn in enumerate(exp_so3(turns)):
        np.matmul(attitudes[k], turn, out=attitudes[k + 1])
    return attitudes


def levelled_attitudes(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
    """Attitudes R_NB (n, 3, 3) at the samples of an unbroken stretch, as in use.

    Args:
        time: (n,) [s].
        gyro: (n, 3) [rad/s] in B.
        accel: (n, 3) [m/s^2] in B.
    """
    first = np.searchsorted(time, time[0] + START_SECONDS, side="right")
    start = start_from_gravity(time[:first], gyro[:first], accel[:first])
    loop = LevelledAttitude(start.R_WB)
    grid = np.arange(time[0] + PERIOD, time[-1], PERIOD)
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
        R_NB: (3, 3) at the start.

    Attributes:
        R_NB: (3, 3) now.
        b_g: (3,) the gyroscope's bias, as far as gravity tells it [rad/s].
    """

    def __init__(self, R_NB: FloatArray) -> None:
        self.R_NB = R_NB
        self.b_g = np.zeros(3)
        tilt, bias = _TILT_SIGMA**2, BIAS_SIGMA**2
        # Of theta about N's axes, R = (I + [theta]x) R^, and of the bias, true minus estimate.
        self._P = np.diag([tilt, tilt, 0.0, bias, bias, bias])

    def advance(self, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
        """Move over one update period and return the attitudes (n + 1, 3, 3) at its samples.

        Args:
            time: (n + 1,) [s].
            gyro: (n + 1, 3) [rad/s] in B.
            accel: (n + 1, 3) [m/s^2] in B.
        """
        attitudes = integrate(self.R_NB, time, gyro - self.b_g)
        self.R_NB = self._levelled(attitudes, time, accel)
        return attitudes

    @property
    def bias_sigma(self) -> float:
        """Of the bias about the level axes, per axis [rad/s]; gravity never tells the third."""
        level = self.R_NB[:2]
        return math.sqrt(0.5 * float(np.vdot(level, level @ self._P[3:, 3:])))

    def restart(self) -> None:
        """After a gap the tilt is not known well: level quickly again."""
        self._P = self._P + np.diag([_TILT_SIGMA**2] * 2 + [0.0] * 4)

    def _levelled(self, attitudes: FloatArray, time: FloatArray, accel: FloatArray) -> FloatArray:
        dt = float(time[-1] - time[0])
        force_N = (attitudes @ accel[:, :, None])[:, :, 0]
        up = (0.5 * (time[1:] - time[:-1])) @ (force_N[1:] + force_N[:-1]) / dt
        up /= max(float(np.linalg.norm(up)), LEAST_FORCE)
        P = self._propagated(attitudes, dt)
        gain = P[:, :2] @ _inverse(P[:2, :2], _FORCE_NOISE**2 / dt)
        P = P - gain @ P[:2]
        self._P = 0.5 * (P + P.T)
        # The smallest turn that takes `up` to the vertical, to first order; none about it.
        x = gain @ np.array([up[1], -up[0]])
        self.b_g = self.b_g + x[3:]
        turned: FloatArray = exp_so3(np.array([x[0], x[1], 0.0])) @ attitudes[-1]
        return turned

    def _propagated(self, attitudes: FloatArray, dt: float) -> FloatArray:
        """The covariance after an update period: theta' = theta - dt R d_bg."""
        F = np.eye(6)
        F[:3, 3:] = -dt * attitudes.mean(axis=0)
        turn, walk = dt * _TURN_NOISE**2, dt * _BIAS_WALK**2
        P: FloatArray = F @ self._P @ F.T + np.diag([turn, turn, 0.0, walk, walk, walk])
        return P


def _inverse(P: FloatArray, noise: float) -> FloatArray:
    """(P + noise I)^-1 of a symmetric P (2, 2)."""
    a, b, d = float(P[0, 0]) + noise, float(P[0, 1]), float(P[1, 1]) + noise
    return np.array([[d, -b], [-b, a]]) / (a * d - b * b)
