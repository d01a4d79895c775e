"""Raw IMU samples between two updates, preintegrated once into a segment for filter and graph.

The integration is gtsam's `PreintegratedCombinedMeasurements`. Each of its steps holds rate and
specific force constant and rotates the force by the attitude at the step's start; instantaneous
samples are therefore first converted to equivalent constants (`corrected_increments`).
gtsam accumulates the rotation as one rotation vector, to first order per step. The error is
negligible over a tenth of a second (4e-6 rad per second in lively motion at 200 Hz), but not over a
whole second (1e-3).

README.md, "Preintegration". Sources: C. Forster et al., "On-manifold preintegration for real-time
visual-inertial odometry", 2017; P. Savage, "Strapdown inertial navigation integration algorithm
design", 1998 (coning, sculling).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import gtsam
import numpy as np

from stario.fusion.imu.intervals import Flags, ImuInterval
from stario.fusion.values.config import MIN_WALK, NavigatorConfig
from stario.sequences.arrays import rms
from stario.sequences.attitude.so3 import skew
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import FloatArray

_POSITION_NOISE = 1e-5
"""Noise of the position that gtsam adds [m/sqrt(s)]: it keeps one-sample segments invertible for
the graph and is far below any sensor's."""

_MISSING_GYRO, _MISSING_ACCEL = 0.1, 1.0
"""Noise densities where up to a fifth of a second is missing and was interpolated [rad/s/sqrt(Hz),
m/s^2/sqrt(Hz)]: a pedestrian's rates change by some tenths of a rad/s in that time."""

_RATE_STEP = 0.05
"""Resolution of rate x sqrt(duration) [rad/sqrt(s)], so that few noise models are created: its
product with `gyro_scale` is far below the noise without rotation."""


@dataclass(frozen=True, eq=False)
class Segment:
    """IMU samples between two times, preintegrated.

    Attributes:
        start: time of the first sample [s].
        stop: time of the last sample [s].
        gravity: magnitude of gravity [m/s^2].
        pim: gtsam's preintegrated measurements, for a `CombinedImuFactor`.
    """

    start: float
    stop: float
    gravity: float
    pim: Any

    @property
    def duration(self) -> float:
        """Length of the segment [s]."""
        return self.stop - self.start

    def __getstate__(self) -> dict[str, Any]:
        """Return the state, with `pim` as gtsam's own text archive, exact to the last bit."""
        return vars(self) | {"pim": self.pim.serialize()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        pim = gtsam.PreintegratedCombinedMeasurements(_params(ImuNoise(), state["gravity"]))
        pim.deserialize(state["pim"])
        vars(self).update(state | {"pim": pim})

    def predict(
        self,
        R_WB: FloatArray,
        v_W: FloatArray,
        p_W: FloatArray,
        b_g: FloatArray,
        b_a: FloatArray,
        bias_jacobian: FloatArray | None = None,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Dead-reckon across the segment.

        Args:
            R_WB: (3, 3) attitude at the start.
            v_W: (3,) velocity [m/s].
            p_W: (3,) position [m].
            b_g: (3,) gyroscope bias [rad/s].
            b_a: (3,) accelerometer bias [m/s^2].
            bias_jacobian: (9, 6) in Fortran order, is set to the derivative with respect to b_a and
                b_g, in gtsam's tangent of the end.

        Returns:
            R_WB, v_W, p_W at the end.
        """
        start = gtsam.NavState(gtsam.Rot3(R_WB), p_W, v_W)
        bias = gtsam.imuBias.ConstantBias(b_a, b_g)
        end = self.pim.predict(start, bias, None, bias_jacobian)
        return end.attitude().matrix(), end.velocity(), end.position()


def segment_of(
    intervals: Sequence[ImuInterval],
    accel_factors: Sequence[float],
    b_g: FloatArray,
    b_a: FloatArray,
    config: NavigatorConfig,
) -> Segment:
    """Preintegrate consecutive intervals, none of them a gap, each with its own noise.

    Their mean noise would spread the effect of a heel strike from a tenth of a second over half a
    second, and correlate position and velocity at the end wrongly.

    Args:
        intervals: the samples.
        accel_factors: factor on the accelerometer's noise density in each of them.
        b_g: (3,) gyroscope bias [rad/s].
        b_a: (3,) accelerometer bias [m/s^2].
        config: noise and gravity.
    """
    pairs = zip(intervals, accel_factors, strict=True)
    noise = [_noise_of(e, factor, config) for e, factor in pairs]
    table, steps = intervals[0].table, noise[:1] * (len(intervals[0].table) - 1)
    for e, density in zip(intervals[1:], noise[1:], strict=True):
        table = np.vstack([table, e.table[1:]])  # without the shared sample
        steps += [density] * (len(e.table) - 1)
    time, gyro, accel = table[:, 0], table[:, 1:4], table[:, 4:]
    return preintegrate(time, gyro, accel, b_g, b_a, steps, config.gravity)


def _noise_of(interval: ImuInterval, accel_factor: float, config: NavigatorConfig) -> ImuNoise:
    """Return the white noise of an interval, which grows with its rate and with its impacts.

    A rotation that is off by `gyro_scale` of what was turned over a duration t is that of white
    noise with density gyro_scale * rate * sqrt(t). An impact is shorter than a step between
    samples: the force's mean over a step is as uncertain as the force changes in it, and what a
    sensor missed at its limit is unknown.
    """
    rate = rms(interval.gyro) * math.sqrt(interval.duration)
    steps = round(rate / _RATE_STEP) if config.noise.gyro_scale else 0
    if config.filter.adaptive and config.noise.accel_noise:
        change = np.diff(interval.accel, axis=0) * np.diff(interval.table[:, 0])[:, None]
        unknown = float(np.vdot(change, change)) + 3.0 * interval.flags.missed**2
        assumed = 3.0 * interval.duration * (accel_factor * config.noise.accel_noise) ** 2
        accel_factor *= in_steps(math.sqrt(1.0 + unknown / assumed))
    return _widened_noise(config, accel_factor, interval.flags, steps)


def in_steps(factor: float) -> float:
    """Round a noise factor to a quarter of a doubling, so that few noise models are created."""
    return float(2.0 ** (round(4.0 * math.log2(factor)) / 4.0))


@lru_cache(maxsize=256)  # successive intervals repeat it, and validating settings is slow
def _widened_noise(
    config: NavigatorConfig, accel_factor: float, flags: Flags, rate_steps: int
) -> ImuNoise:
    """Return the white noise, widened by rates, saturated sensors and missing samples."""
    noise = config.noise
    gyro = math.hypot(noise.gyro_noise, noise.gyro_scale * _RATE_STEP * rate_steps)
    accel = accel_factor * noise.accel_noise
    # What a saturated sensor missed is as unknown as the motion in a gap.
    if flags.gyro:
        gyro = max(gyro, config.filter.gap_gyro_noise)
    if flags.accel:
        accel = max(accel, config.filter.gap_accel_noise)
    if flags.missing:
        gyro, accel = max(gyro, _MISSING_GYRO), max(accel, _MISSING_ACCEL)
    return replace(noise, gyro_noise=gyro, accel_noise=accel)


def preintegrate(
    time: FloatArray,
    gyro: FloatArray,
    accel: FloatArray,
    b_g: FloatArray,
    b_a: FloatArray,
    noise: ImuNoise | Sequence[ImuNoise],
    gravity: float,
) -> Segment:
    """Preintegrate the samples of an interval into a segment.

    Args:
        time: (n + 1,) [s], strictly increasing; first and last are the interval's ends.
        gyro: (n + 1, 3) [rad/s] in B, interpolated to the ends by the caller.
        accel: (n + 1, 3) specific force [m/s^2] in B, likewise.
        b_g: (3,) gyroscope bias to integrate with [rad/s]; later changes apply to first order.
        b_a: (3,) accelerometer bias [m/s^2], likewise.
        noise: noise densities over this interval, or over each of the n steps; the bias walks are
            those of the first.
        gravity: magnitude [m/s^2].
    """
    dt, rate, force = corrected_increments(time, gyro - b_g, accel - b_a)
    densities = [noise] * len(dt) if isinstance(noise, ImuNoise) else noise
    seconds = float(time[-1] - time[0])
    if seconds * math.sqrt(3.0) * float(np.abs(rate).max()) > MAX_TURN:
        rate, densities = _within_a_turn(rate, dt, densities)
    current = densities[0]
    uniform = all(density is current for density in densities)
    # Those of the cache must not be changed.
    params = _params(current, gravity) if uniform else _new_params(current, gravity)
    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(b_a, b_g))
    integrate = pim.integrateMeasurement
    # gtsam subtracts the bias itself, so it is added back here.
    steps = zip(force + b_a, rate + b_g, dt.tolist(), densities, strict=True)
    for step_force, step_rate, step, density in steps:
        if density is not current:
            current = density
            _set_white_noise(params, current)
        integrate(step_force, step_rate, step)
    return Segment(float(time[0]), float(time[-1]), gravity, pim)


def _within_a_turn(
    rate: FloatArray, dt: FloatArray, densities: Sequence[ImuNoise]
) -> tuple[FloatArray, Sequence[ImuNoise]]:
    """Limit the rotation of a segment, since gtsam's tangent is singular at a full turn.

    Return rates (n, 3) and densities; if the rotation was too large, the turn is unknown.
    """
    turn = float(np.linalg.norm(np.cumsum(rate * dt[:, None], axis=0), axis=1).max())
    if turn <= MAX_TURN:
        return rate, densities
    unknown = math.pi / math.sqrt(dt.sum())
    wider = [replace(d, gyro_noise=max(d.gyro_noise, unknown)) for d in densities]
    return rate * (MAX_TURN / turn), wider


def corrected_increments(
    time: FloatArray, gyro: FloatArray, accel: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the constant rate and force over each step that are equivalent to the samples.

    Rate w and force a are taken as linear between samples. With their means w_, a_ over a step dt
    the rotation vector is  dt w_ + dt^2/12 w0 x w1  (coning) and the velocity increment in the
    axes of the step's start is
    dt a_ + dt^2/2 w_ x a_ + dt^2/12 (w0 x a1 - w1 x a0) + dt^3/6 w_ x (w_ x a_)
    (rotation of the force, sculling, second order of the rotation).

    Args:
        time: (n + 1,) [s].
        gyro: (n + 1, 3) [rad/s], bias removed.
        accel: (n + 1, 3) [m/s^2], bias removed.

    Returns:
        dt (n,) [s], rate (n, 3) [rad/s], force (n, 3) [m/s^2].
    """
    dt = time[1:] - time[:-1]
    step = dt[:, None, None]
    pairs = np.empty((len(time), 3, 2))  # columns w and a
    pairs[:, :, 0], pairs[:, :, 1] = gyro, accel
    W = skew(gyro)
    W0, W1, first, last = W[:-1], W[1:], pairs[:-1], pairs[1:]
    # w0 x w1 - w1 x w0 counts the coning term twice, hence its 1/24.
    constant = 0.5 * (first + last) + step * _CROSS_WEIGHTS * (W0 @ last - W1 @ first)
    force = constant[:, :, 1:]
    turn = (0.5 * step) * (W0 + W1)
    force = force + turn @ (0.5 * force + turn @ force / 6.0)
    return dt, constant[:, :, 0], force[:, :, 0]


MAX_TURN = 6.0
"""Maximum rotation of a segment [rad]; over a tenth of a second, or between keyframes of the graph,
no device turns by so much. Its turn is then unknown: a gyroscope in deg/s, not noticed yet."""

_CROSS_WEIGHTS = np.array([1.0 / 24.0, 1.0 / 12.0])
_EYE = np.eye(3)


def _new_params(noise: ImuNoise, gravity: float) -> Any:
    params = gtsam.PreintegrationCombinedParams.MakeSharedU(gravity)
    _set_white_noise(params, noise)
    params.setIntegrationCovariance(_EYE * _POSITION_NOISE**2)
    params.setBiasOmegaCovariance(_EYE * max(noise.gyro_walk, MIN_WALK) ** 2)
    params.setBiasAccCovariance(_EYE * max(noise.accel_walk, MIN_WALK) ** 2)
    return params


def _set_white_noise(params: Any, noise: ImuNoise) -> None:
    params.setGyroscopeCovariance(_EYE * noise.gyro_noise**2)
    params.setAccelerometerCovariance(_EYE * noise.accel_noise**2)


# The accelerometer's factor is quantised, so the cache holds all values in use.
_params = lru_cache(maxsize=512)(_new_params)
