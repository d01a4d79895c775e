"""Monte Carlo: does the filter know how wrong it is?

Walks are analytic, so their IMU is exact; the sensor's noise, its biases, the measurement's noise
and the first state's errors are drawn as large as the filter is told. For an honest filter the NEES
of n states averages to n, and its mean over N independent runs follows chi-square with n N degrees
of freedom, divided by N.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from stario.fusion.config import NavigatorConfig
from stario.fusion.ekf import StateCloningEkf
from stario.fusion.jacobians import yaw_twist
from stario.fusion.lie import FloatArray, exp_so3, log_se23
from stario.fusion.preintegration import CORE, preintegrate
from stario.sequences.errors import InputError
from stario.sequences.noise import ImuNoise
from stario.sequences.windows import WINDOW_SECONDS

RATE = 200.0
"""Samples per second of the simulated IMU [Hz]."""

SEGMENT = 10
"""Samples per preintegrated segment."""


@dataclass(frozen=True)
class Trial:
    """What the runs have in common.

    Attributes:
        noise: densities of the sensor, and those the filter assumes.
        tilt_sigma: of the first attitude [rad].
        yaw_sigma: of the first yaw [rad].
        velocity_sigma: of the first velocity [m/s].
        position_sigma: of the first position [m].
        gyro_bias_sigma: of the first gyroscope bias [rad/s].
        accel_bias_sigma: of the first accelerometer bias [m/s^2].
        displacement_sigma: of the measured displacements, per axis [m].
        gravity: [m/s^2].
    """

    noise: ImuNoise
    tilt_sigma: float = float(np.deg2rad(1.0))
    yaw_sigma: float = float(np.deg2rad(10.0))
    velocity_sigma: float = 0.1
    position_sigma: float = 0.01
    gyro_bias_sigma: float = 3e-3
    accel_bias_sigma: float = 0.05
    displacement_sigma: float = 0.03
    gravity: float = 9.80665

    @property
    def sigma(self) -> FloatArray:
        """(15,) standard deviations of the first state."""
        groups = (
            [self.tilt_sigma, self.tilt_sigma, self.yaw_sigma],
            [self.velocity_sigma] * 3,
            [self.position_sigma] * 3,
            [self.gyro_bias_sigma] * 3,
            [self.accel_bias_sigma] * 3,
        )
        return np.concatenate(groups)


def trial_of(config: NavigatorConfig, yaw_sigma: float) -> Trial:
    """A trial of a user's configuration, its motion noise left out: the simulated IMU has none."""
    f = config.filter
    return Trial(
        noise=config.noise,
        tilt_sigma=f.tilt_sigma,
        yaw_sigma=yaw_sigma,
        velocity_sigma=f.velocity_sigma,
        gyro_bias_sigma=f.gyro_bias_sigma,
        accel_bias_sigma=f.accel_bias_sigma,
        gravity=config.gravity,
    )


@dataclass(frozen=True)
class Consistency:
    """Averages over the runs, and the bounds an honest filter keeps in 95 of 100 trials.

    Attributes:
        runs: how many.
        seconds: length of each [s].
        nees: of the 15 states, over all times; expected 15.
        nees_end: of the 15 states at the end.
        nees_bounds: for `nees_end` (and, since times are alike, close to those of `nees`).
        yaw: NEES of yaw over all times; expected 1.
        nis: of the measurements; expected 3.
        yaw_sigma: that the filter reports at the end, root mean square [rad].
        yaw_error: true one at the end, root mean square [rad].
    """

    runs: int
    seconds: float
    nees: float
    nees_end: float
    nees_bounds: tuple[float, float]
    yaw: float
    nis: float
    yaw_sigma: float
    yaw_error: float

    def lines(self) -> list[str]:
        """The result for a person."""
        low, high = self.nees_bounds
        return [
            f"{self.runs} runs of {self.seconds:g} s",
            f"NEES of 15 states {self.nees:.2f}, at the end {self.nees_end:.2f} "
            f"(expected 15; {low:.1f} to {high:.1f} in 95 of 100 trials)",
            f"NEES of yaw {self.yaw:.2f} (expected 1); at the end error "
            f"{np.degrees(self.yaw_error):.2f} deg, reported {np.degrees(self.yaw_sigma):.2f} deg",
            f"NIS {self.nis:.2f} (expected 3)",
        ]


def consistency(
    trial: Trial,
    runs: int = 20,
    seconds: float = 300.0,
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> Consistency:
    """Run the filter on simulated walks whose errors are as large as it is told.

    Args:
        trial: sizes of the errors.
        runs: number of walks.
        seconds: length of each [s].
        seed: of the first run; the others follow.
        progress: called with the share of the work done.

    Raises:
        InputError: no runs, or less than one second.
    """
    if runs < 1 or not seconds >= 1.0:
        raise InputError("runs, seconds", f"{runs}, {seconds:g}", "at least 1 run of 1 s")
    tables = []
    for k in range(runs):
        tables.append(_run(trial, seconds, seed + k))
        progress((k + 1) / runs)
    table = np.stack(tables)  # runs, seconds, (nees, yaw error^2, yaw variance, nis)
    low, high = (float(chi2.ppf(p, CORE * runs)) / runs for p in (0.025, 0.975))
    return Consistency(
        runs=runs,
        seconds=seconds,
        nees=float(table[:, :, 0].mean()),
        nees_end=float(table[:, -1, 0].mean()),
        nees_bounds=(low, high),
        yaw=float((table[:, :, 1] / table[:, :, 2]).mean()),
        nis=float(table[:, :, 3].mean()),
        yaw_sigma=float(np.sqrt(table[:, -1, 2].mean())),
        yaw_error=float(np.sqrt(table[:, -1, 1].mean())),
    )


@dataclass(frozen=True, eq=False)
class AnalyticWalk:
    """A walk along a bending way with the bounce and sway of steps, by its closed form.

    Attributes:
        time: (N,) [s].
        R_WB: (N, 3, 3).
        v_W: (N, 3) [m/s].
        p_W: (N, 3) [m].
        gyro: (N, 3) exact rate in B [rad/s].
        accel: (N, 3) exact specific force in B [m/s^2].
    """

    time: FloatArray
    R_WB: FloatArray
    v_W: FloatArray
    p_W: FloatArray
    gyro: FloatArray
    accel: FloatArray


# Axis, amplitude [m], frequency [Hz] of the sines a walk's position is the sum of.
_SINES = (
    (0, 6.0, 0.021),
    (1, 8.0, 0.017),
    (0, 1.0, 0.11),
    (1, 1.2, 0.09),
    (2, 0.03, 1.9),
    (0, 0.02, 0.95),
)


def analytic_walk(seconds: float, rng: np.random.Generator, gravity: float) -> AnalyticWalk:
    """Draw a walk: a sum of sines with random phases, differentiated by hand."""
    t = np.arange(round(seconds * RATE) + 1) / RATE
    phase = rng.uniform(0.0, 2.0 * np.pi, 8)
    p, v, a = np.zeros((3, len(t), 3))
    for (axis, amplitude, frequency), shift in zip(_SINES, phase, strict=False):
        w = 2.0 * np.pi * frequency
        p[:, axis] += amplitude * np.sin(w * t + shift)
        v[:, axis] += amplitude * w * np.cos(w * t + shift)
        a[:, axis] -= amplitude * w * w * np.sin(w * t + shift)
    h = 1e-4
    R = _attitude(t, phase)
    turn = _attitude(t - h, phase).transpose(0, 2, 1) @ _attitude(t + h, phase)
    odd = turn - turn.transpose(0, 2, 1)
    gyro = np.stack([odd[:, 2, 1], odd[:, 0, 2], odd[:, 1, 0]], axis=1) / (4.0 * h)
    force = (R.transpose(0, 2, 1) @ (a + gravity * _VERTICAL)[..., None])[..., 0]
    return AnalyticWalk(t, R, v, p, gyro, force)


def _attitude(t: FloatArray, phase: FloatArray) -> FloatArray:
    yaw = 1.2 * np.sin(0.4 * t + phase[6]) + 0.05 * t
    roll = 0.15 * np.sin(2.0 * np.pi * 0.95 * t + phase[7])
    pitch = 0.6 + 0.1 * np.sin(2.0 * np.pi * 1.9 * t)
    sway = np.stack([roll, pitch, np.zeros_like(t)], axis=1)
    attitude: FloatArray = exp_so3(yaw[:, None] * _VERTICAL) @ exp_so3(sway)
    return attitude


_VERTICAL = np.array([0.0, 0.0, 1.0])


def _run(trial: Trial, seconds: float, seed: int) -> FloatArray:
    """NEES of the states, squared yaw error, yaw variance and NIS at every second (M, 4)."""
    rng = np.random.default_rng(seed)
    walk = analytic_walk(seconds, rng, trial.gravity)
    n, white, noise = len(walk.time), np.sqrt(RATE), trial.noise
    initial = trial.sigma * rng.normal(size=CORE)
    walks = rng.normal(size=(2, n, 3)).cumsum(axis=1) / white
    b_g = initial[9:12] + noise.gyro_walk * walks[0]
    b_a = initial[12:15] + noise.accel_walk * walks[1]
    gyro = walk.gyro + b_g + noise.gyro_noise * white * rng.normal(size=(n, 3))
    accel = walk.accel + b_a + noise.accel_noise * white * rng.normal(size=(n, 3))

    ekf = StateCloningEkf(slots=1, gravity=trial.gravity)
    ekf.initialise(
        0.0,
        exp_so3(-initial[:3]) @ walk.R_WB[0],
        walk.v_W[0] - initial[3:6],
        walk.p_W[0] - initial[6:9],
        np.zeros(3),
        np.zeros(3),
        np.diag(trial.sigma**2),
    )
    covariance = trial.displacement_sigma**2 * np.eye(3)
    window, rows = round(WINDOW_SECONDS * RATE), []
    for start in range(0, n - window, window):
        slot = ekf.clone(ekf.time)
        # The network sees the window in the world as it was estimated at the window's start.
        seen_from = exp_so3(yaw_twist(walk.R_WB[start] @ ekf.R_WB.T) * _VERTICAL)
        for k in range(start, start + window, SEGMENT):
            part = slice(k, k + SEGMENT + 1)
            samples = walk.time[part], gyro[part], accel[part]
            ekf.propagate(preintegrate(*samples, ekf.b_g, ekf.b_a, noise, trial.gravity))
        stop = start + window
        d_W = seen_from.T @ (walk.p_W[stop] - walk.p_W[start])
        d_W += trial.displacement_sigma * rng.normal(size=3)
        nis = ekf.update_displacement(slot, None, d_W, covariance).nis
        ekf.release(slot)
        R = walk.R_WB[stop] @ ekf.R_WB.T
        pose = log_se23(R, walk.v_W[stop] - R @ ekf.v_W, walk.p_W[stop] - R @ ekf.p_W)
        error = np.concatenate([pose, b_g[stop] - ekf.b_g, b_a[stop] - ekf.b_a])
        P = ekf.core_covariance
        rows.append((error @ np.linalg.solve(P, error), error[2] ** 2, P[2, 2], nis))
    return np.array(rows)
