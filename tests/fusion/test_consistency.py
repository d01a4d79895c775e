"""Monte Carlo: does the filter know how wrong it is?

Walks are analytic; the measurement noise is white and as large as the filter is told. The average
NEES of N runs of an honest filter follows chi-square with 15 N degrees of freedom, divided by N.
"""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.stats import chi2

from stario.fusion.ekf import StateCloningEkf
from stario.fusion.lie import exp_so3, log_se23
from stario.fusion.preintegration import preintegrate
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import STANDARD_GRAVITY

RUNS = 20
RATE = 200.0
STEP = 10  # IMU samples per segment
NOISE = ImuNoise(gyro_noise=1e-3, accel_noise=1e-2, gyro_walk=3e-5, accel_walk=1e-3)
DISPLACEMENT_SIGMA = 0.03
PRIOR_SIGMA = np.repeat([np.deg2rad(1.0), 0.1, 0.01, 0.003, 0.05], 3)
PRIOR_SIGMA[2] = np.deg2rad(10.0)
VERTICAL = np.array([0.0, 0.0, 1.0])


@dataclass
class Walk:
    """A walk along a bending way with the bounce and sway of steps, by its closed form."""

    time: np.ndarray
    R_WB: np.ndarray
    v_W: np.ndarray
    p_W: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray

    @classmethod
    def generate(cls, duration: float, rng: np.random.Generator) -> "Walk":
        t = np.arange(round(duration * RATE) + 1) / RATE
        phase = rng.uniform(0.0, 2.0 * np.pi, 8)
        # Position: sums of amplitude * sin(2 pi f t + phase), differentiated by hand.
        terms = [
            (0, 6.0, 0.021, phase[0]),
            (1, 8.0, 0.017, phase[1]),
            (0, 1.0, 0.11, phase[2]),
            (1, 1.2, 0.09, phase[3]),
            (2, 0.03, 1.9, phase[4]),
            (0, 0.02, 0.95, phase[5]),
        ]
        p, v, a = np.zeros((3, len(t), 3))
        for axis, amplitude, frequency, shift in terms:
            w = 2.0 * np.pi * frequency
            p[:, axis] += amplitude * np.sin(w * t + shift)
            v[:, axis] += amplitude * w * np.cos(w * t + shift)
            a[:, axis] -= amplitude * w * w * np.sin(w * t + shift)
        h = 1e-4
        R = cls._attitude(t, phase)
        ahead, behind = cls._attitude(t + h, phase), cls._attitude(t - h, phase)
        turn = behind.transpose(0, 2, 1) @ ahead
        gyro = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
        gyro = (gyro - np.stack([turn[:, 1, 2], turn[:, 2, 0], turn[:, 0, 1]], axis=1)) / (4 * h)
        force = (R.transpose(0, 2, 1) @ (a + STANDARD_GRAVITY * VERTICAL)[..., None])[..., 0]
        return cls(t, R, v, p, gyro, force)

    @staticmethod
    def _attitude(t: np.ndarray, phase: np.ndarray) -> np.ndarray:
        yaw = 1.2 * np.sin(0.4 * t + phase[6]) + 0.05 * t
        sway = np.stack(
            [
                0.15 * np.sin(2 * np.pi * 0.95 * t + phase[7]),
                0.6 + 0.1 * np.sin(2 * np.pi * 1.9 * t),
                0.0 * t,
            ],
            axis=1,
        )
        return exp_so3(yaw[:, None] * VERTICAL) @ exp_so3(sway)


def twist_yaw(R: np.ndarray) -> float:
    return float(np.arctan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]))


def simulated_nees(duration: float, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """NEES of the 15 states and of yaw at every second."""
    rng = np.random.default_rng(seed)
    walk = Walk.generate(duration, rng)
    n, white = len(walk.time), np.sqrt(RATE)
    initial = PRIOR_SIGMA * rng.normal(size=15)
    walks = rng.normal(size=(2, n, 3)).cumsum(axis=1) / white
    b_g = initial[9:12] + NOISE.gyro_walk * walks[0]
    b_a = initial[12:15] + NOISE.accel_walk * walks[1]
    gyro = walk.gyro + b_g + NOISE.gyro_noise * white * rng.normal(size=(n, 3))
    accel = walk.accel + b_a + NOISE.accel_noise * white * rng.normal(size=(n, 3))

    ekf = StateCloningEkf(slots=1)
    ekf.initialise(
        0.0,
        exp_so3(-initial[:3]) @ walk.R_WB[0],
        walk.v_W[0] - initial[3:6],
        walk.p_W[0] - initial[6:9],
        np.zeros(3),
        np.zeros(3),
        np.diag(PRIOR_SIGMA**2),
    )
    covariance = DISPLACEMENT_SIGMA**2 * np.eye(3)
    second, nees = round(RATE), []
    for start in range(0, n - 1, second):
        slot = ekf.clone(ekf.time)
        # The network sees the window in the world as it was estimated at the window's start.
        seen_from = exp_so3(twist_yaw(walk.R_WB[start] @ ekf.R_WB.T) * VERTICAL)
        for k in range(start, start + second, STEP):
            part = slice(k, k + STEP + 1)
            samples = walk.time[part], gyro[part], accel[part]
            ekf.propagate(preintegrate(*samples, ekf.b_g, ekf.b_a, NOISE, STANDARD_GRAVITY))
        stop = start + second
        d_W = seen_from.T @ (walk.p_W[stop] - walk.p_W[start])
        d_W += DISPLACEMENT_SIGMA * rng.normal(size=3)
        ekf.update_displacement(slot, None, d_W, covariance)
        ekf.release(slot)
        R = walk.R_WB[stop] @ ekf.R_WB.T
        pose = log_se23(R, walk.v_W[stop] - R @ ekf.v_W, walk.p_W[stop] - R @ ekf.p_W)
        error = np.concatenate([pose, b_g[stop] - ekf.b_g, b_a[stop] - ekf.b_a])
        P = ekf.core_covariance
        nees.append((error @ np.linalg.solve(P, error), error[2] ** 2 / P[2, 2]))
    return tuple(np.array(nees).T)


def assert_honest(duration: float) -> None:
    state, yaw = np.stack([simulated_nees(duration, seed) for seed in range(RUNS)], axis=1)
    low, high = chi2.ppf([0.025, 0.975], 15 * RUNS) / RUNS
    assert low < state.mean() < high
    assert low < state[:, -1].mean() < high
    assert 0.5 < yaw.mean() < 1.7


def test_nees_of_a_minute_is_within_its_bounds() -> None:
    assert_honest(60.0)


@pytest.mark.slow
def test_nees_of_five_minutes_is_within_its_bounds() -> None:
    assert_honest(300.0)
