"""Attitude from the IMU alone: gravity initialisation and a levelled integration.

N is the frame this attitude is given in: gravity-aligned like W, its yaw zero at the start and
drifting with the gyroscope. It needs neither truth nor network, so that windows can be prepared
before any filter runs, streaming and batch see the same ones, and a network can be trained on what
it will be shown.

The tilt is corrected by a proportional-integral loop (Mahony et al. 2008): the specific force,
averaged over an update period and seen in N, should point up; the mean of a walker's acceleration
vanishes over the loop's time constant. The integral is the horizontal gyroscope bias in N.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.rotations import tilt_aligning
from stario.sequences.sequence import FloatArray

LEVELLING_RATE = 0.06
"""Natural frequency of the levelling loop [rad/s]."""

PERIOD = 0.1
"""Between corrections of the tilt [s]."""

START_SECONDS = 1.0
"""Length of the stretch whose mean specific force levels the first attitude [s]."""

STILL_ACCEL = 0.3
"""Deviation of the specific force [m/s^2] below which a device counts as held still."""

STILL_GYRO = 0.1
"""Root mean square rate [rad/s] below which a device counts as held still."""

_LEAST_FORCE = 1.0
"""Mean specific force [m/s^2] below which it shows no vertical: free fall, a dead sensor."""

_START_UP = 3.0
"""Time constant [s] from which the loop's rate falls to its final one."""


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
    R_WB = tilt_aligning(up).as_matrix() if force > _LEAST_FORCE else np.eye(3)
    return GravityStart(R_WB, still, force)


def integrate(R_NB: FloatArray, time: FloatArray, gyro: FloatArray) -> FloatArray:
    """Attitudes (n + 1, 3, 3) at the samples from the one at the first sample.

    Mean rate and coning (Savage 1998), as in the filter's preintegration.
    """
    dt = np.diff(time)[:, None]
    turns = dt * (0.5 * (gyro[:-1] + gyro[1:]) + dt / 12.0 * np.cross(gyro[:-1], gyro[1:]))
    attitudes = np.empty((len(time), 3, 3))
    attitudes[0] = R_NB
    for k, turn in enumerate(_exp(turns)):
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
    loop = LevelledAttitude(start.R_WB, LEVELLING_RATE)
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
        rate: natural frequency of the levelling loop [rad/s].
    """

    def __init__(self, R_NB: FloatArray, rate: float) -> None:
        self.R_NB = R_NB
        self._rate = rate
        self._bias_N = np.zeros(3)
        self._since_start = 0.0

    def advance(self, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
        """Move over one update period and return the attitudes (n + 1, 3, 3) at its samples.

        Args:
            time: (n + 1,) [s].
            gyro: (n + 1, 3) [rad/s] in B.
            accel: (n + 1, 3) [m/s^2] in B.
        """
        corrected = gyro - self.R_NB.T @ self._bias_N
        attitudes = integrate(self.R_NB, time, corrected)
        self.R_NB = self._levelled(attitudes, time, accel)
        return attitudes

    def restart(self) -> None:
        """After a gap the tilt is not known well: level quickly again."""
        self._since_start = 0.0

    def _levelled(self, attitudes: FloatArray, time: FloatArray, accel: FloatArray) -> FloatArray:
        dt = float(time[-1] - time[0])
        force_N = (attitudes @ accel[:, :, None])[:, :, 0]
        up = (0.5 * np.diff(time)) @ (force_N[1:] + force_N[:-1]) / dt
        up /= max(float(np.linalg.norm(up)), _LEAST_FORCE)
        self._since_start += dt
        loop = max(self._rate, 1.0 / (_START_UP + self._since_start))
        # The smallest turn that takes `up` to the vertical, to first order; none about it.
        error = np.array([up[1], -up[0], 0.0])
        if loop <= self._rate:
            self._bias_N -= self._rate**2 * dt * error
        turned: FloatArray = _exp(1.414 * loop * dt * error) @ attitudes[-1]
        return turned


def _exp(theta: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_rotvec(theta).as_matrix())
