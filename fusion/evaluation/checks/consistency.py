"""Monte Carlo check that the filter's covariance matches its errors.

The IMU of simulated walks is exact; the sensor's noise, its biases and scale, the displacements'
noise and the initial state's errors are drawn with a configuration's standard deviations. The
navigator's own filter runs on them, with its rates, windows and gates. For a consistent filter the
NEES of n states averages to n, and its mean over N independent runs follows chi-square with n N
degrees of freedom, divided by N.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from stario.fusion.evaluation.scores import scored
from stario.fusion.filter import estimator
from stario.fusion.filter.correlated_errors import ACCEL_SHARE, displacement_errors
from stario.fusion.filter.ekf_state import CONSIDERED_SECONDS
from stario.fusion.filter.estimates import Estimate
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.jacobians import CORE, REPORTED
from stario.fusion.filter.record import innovations_of
from stario.fusion.imu.inference import WindowDisplacement, slope_variance
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.recording import cut_recording
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.lie import log_se23, yaw_rotation
from stario.sequences.accuracy.nees import nees_bounds
from stario.sequences.attitude.so3 import exp_so3
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk
from stario.sequences.windows import WINDOW_SECONDS

RATE = 200.0
"""Sampling rate of the simulated IMU [Hz]."""

YAW_SIGMA = math.radians(10.0)
"""Default standard deviation of the initial yaw [rad]."""

_POSITION_SIGMA = 0.01

_DISPLACEMENT_SIGMA = 0.1
"""Standard deviation of the displacements per axis [m], as of a good network. Far smaller values
reveal that an unknown initial speed and an unknown yaw interact beyond first order: with 0.03 m the
NEES of the first minute is 19 instead of 16."""

_STYLE = WalkStyle(carry="handheld")
"""Carried smoothly: strapdown integration of 200 Hz has errors far below those that are drawn. A
hand hardly tilts, so that yaw drifts: a rig's turns would show every bias to gravity."""


def summary(scores: pd.DataFrame, seconds: float) -> dict[str, Any]:
    """Return averages over the runs, each of so many seconds.

    `nees_bounds` are met by `nees_end` of a consistent filter in 95 of 100 trials, and nearly so by
    `nees`, since times are correlated.
    """
    means = scores[["nees", "nees_end", "yaw", "nis"]].mean().to_dict()
    sizes = np.sqrt((scores[["yaw_sigma", "yaw_error"]] ** 2).mean()).to_dict()
    bounds = nees_bounds(CORE, len(scores))
    return {"runs": len(scores), "seconds": seconds, **means, **sizes, "nees_bounds": bounds}


def consistency_text(found: dict[str, Any]) -> str:
    """Return a `summary` as lines of text."""
    low, high = found["nees_bounds"]
    error, sigma = (math.degrees(found[name]) for name in ("yaw_error", "yaw_sigma"))
    return (
        f"{found['runs']} runs of {found['seconds']:g} s\n"
        f"NEES of 15 states {found['nees']:.2f}, at the end {found['nees_end']:.2f} "
        f"(expected 15; {low:.1f} to {high:.1f} in 95 of 100 trials)\n"
        f"NEES of yaw {found['yaw']:.2f} (expected 1); error at the end "
        f"{error:.2f} deg, reported {sigma:.2f} deg\n"
        f"NIS {found['nis']:.2f} (expected 3)"
    )


def consistency(
    config: NavigatorConfig, yaw_sigma: float = YAW_SIGMA, seconds: float = 300.0, seed: int = 0
) -> pd.DataFrame:
    """Score the filter on a simulated walk with errors drawn from its configured deviations.

    Figures: NEES of the 15 states over all seconds (`nees`, expected: 15) and at the end
    (`nees_end`); NEES of `yaw` (1); `nis` of the measurements (3); at the end, the yaw's reported
    standard deviation `yaw_sigma` and its error `yaw_error` [rad].

    The configuration is that of the filter and of the simulated IMU's noise; `yaw_sigma` [rad] is
    that of the initial yaw.

    Raises:
        InputError: the walk is shorter than two seconds.
    """
    if not seconds >= 2.0:
        raise InputError("seconds", f"{seconds:g}", "at least 2 s")
    # The errors are drawn as configured: there is nothing to adapt to.
    config = replace(config, filter=replace(config.filter, adaptive=False))
    rng = np.random.default_rng(seed)
    track = generate_walk(seed, seconds, style=_STYLE)
    exact = simulate_imu(track, RATE, PERFECT_IMU, gravity=config.gravity)
    walk = exact.truth
    assert walk is not None  # simulated recordings have one
    prior, b_g, b_a = _drawn_start(walk, config, yaw_sigma, rng)
    white, noise = math.sqrt(RATE), config.noise
    for bias, density in ((b_g, noise.gyro_walk), (b_a, noise.accel_walk)):
        bias += density * rng.normal(size=bias.shape).cumsum(axis=0) / white
    gyro = exact.gyro + b_g + noise.gyro_noise * white * rng.normal(size=b_g.shape)
    # Errors of scale and alignment are independent from one interval to the next, as assumed.
    part = np.arange(len(exact)) * config.filter.output_rate // round(RATE)
    rate = np.linalg.norm(exact.gyro, axis=1, keepdims=True)
    gyro += noise.gyro_scale * rate * rng.normal(size=(part[-1] + 1, 3))[part]
    share = ACCEL_SHARE if config.filter.correlated_errors else 1.0
    accel_noise = math.sqrt(share) * noise.accel_noise
    accel = exact.accel + b_a + accel_noise * white * rng.normal(size=b_a.shape)

    intervals, front_end = cut_recording(ImuSequence("walk", exact.time, gyro, accel), config)
    assert front_end.start is not None  # two seconds are enough
    state = estimator.begin(config, front_end.start, prior)
    network = _DrawnNetwork(walk, config, rng)
    rows, records = [], []
    for count, interval in enumerate(intervals, 1):
        measured = network.displacement(interval)
        state, record = estimator.step(state, interval, measured, (), config)
        records.append(record)
        if count % config.filter.output_rate == 0:
            k = round(interval.stop * RATE)
            rows.append(_errors(record.estimate, walk, k, b_g[k], b_a[k]))
    nees, yaw_square, yaw_variance = np.array(rows).T
    figures = {
        "nees": float(nees.mean()),
        "nees_end": float(nees[-1]),
        "yaw": float((yaw_square / yaw_variance).mean()),
        "nis": float(innovations_of(records).nis.mean()),
        "yaw_sigma": math.sqrt(yaw_variance[-1]),
        "yaw_error": math.sqrt(yaw_square[-1]),
    }
    return scored(f"walk {seed}", {"filtered": figures})


def _drawn_start(
    walk: Trajectory, config: NavigatorConfig, yaw_sigma: float, rng: np.random.Generator
) -> tuple[PriorPose, FloatArray, FloatArray]:
    """Draw the prior on the first pose and the true biases (N, 3)."""
    f = config.filter
    sigmas = np.array([f.tilt_sigma, f.tilt_sigma, yaw_sigma])
    assert walk.velocity_W is not None  # those of simulated walks are known
    prior = PriorPose(
        R_WB=exp_so3(-sigmas * rng.normal(size=3)) @ walk.attitude_WB[0].as_matrix(),
        v_W=walk.velocity_W[0] - f.velocity_sigma * rng.normal(size=3),
        p_W=walk.position_W[0] - _POSITION_SIGMA * rng.normal(size=3),
        tilt_sigma=f.tilt_sigma,
        yaw_sigma=yaw_sigma,
        velocity_sigma=f.velocity_sigma,
        position_sigma=_POSITION_SIGMA,
    )
    b_g, b_a = (
        np.tile(sigma * rng.normal(size=3), (len(walk.time), 1))
        for sigma in (f.gyro_bias_sigma, f.accel_bias_sigma)
    )
    return prior, b_g, b_a


class _DrawnNetwork:
    """Displacements with the errors that the filter's covariance contains, drawn from `rng`."""

    def __init__(self, walk: Trajectory, config: NavigatorConfig, rng: np.random.Generator) -> None:
        self._walk, self._config, self._rng = walk, config, rng
        self._lasting = rng.normal(size=len(CONSIDERED_SECONDS))
        self._time = 0.0

    def displacement(self, interval: ImuInterval) -> WindowDisplacement | None:
        """Return the displacement of the window that ends with an interval, in its frame N."""
        if interval.window is None:
            return None
        walk, f, rng = self._walk, self._config.filter, self._rng
        kept = np.exp((self._time - interval.stop) / CONSIDERED_SECONDS)
        drawn = rng.normal(size=len(kept))
        self._lasting = kept * self._lasting + np.sqrt(1.0 - kept**2) * drawn
        self._time = interval.stop
        stop = round(interval.stop * RATE)
        start = stop - round(WINDOW_SECONDS * RATE)
        d_W = walk.position_W[stop] - walk.position_W[start]
        covariance = _DISPLACEMENT_SIGMA**2 * np.eye(3)
        covariance[2, 2] += slope_variance(d_W)
        if f.correlated_errors:
            errors = displacement_errors(d_W, covariance, 1.0, f)
            d_W = d_W + errors.considered @ self._lasting
            white = errors.white
        else:  # overlapping windows count as less certain than each one is
            white = f.overlap_scale * covariance
        d_W = d_W + np.linalg.cholesky(white) @ rng.normal(size=3)
        R_WN = yaw_rotation(walk.attitude_WB[start].as_matrix() @ interval.window.R_NB.T)
        return WindowDisplacement(R_WN.T @ d_W, covariance, interval.window.R_NB)


def _errors(
    now: Estimate, walk: Trajectory, k: int, b_g: FloatArray, b_a: FloatArray
) -> tuple[float, float, float]:
    """Return the NEES, the squared yaw error and the yaw's variance at sample k."""
    X, P = now.X, now.covariances[REPORTED]
    assert walk.velocity_W is not None  # those of simulated walks are known
    R = walk.attitude_WB[k].as_matrix() @ X[:, :3].T
    pose = log_se23(R, walk.velocity_W[k] - R @ X[:, 3], walk.position_W[k] - R @ X[:, 4])
    error = np.concatenate([pose, b_g - now.b_g, b_a - now.b_a])
    return float(error @ np.linalg.solve(P, error)), float(error[2] ** 2), float(P[2, 2])
