"""IMU simulation along any trajectory: differentiated splines through the poses, sensor errors.

The position is a quintic spline, so that its second derivative is smooth. The attitude is a cubic
spline s(t) through sign-continuous quaternions, normalised: q = s / |s| is as smooth as s and its
body rate is exactly 2 Im(conj(s) s') / |s|^2, because the component of s' along s only changes the
length. The rate thus matches the attitude given as truth exactly, at the cost of one spline
(scipy's RotationSpline solves a nonlinear system for the same order of smoothness).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import check_type, generator
from stario.sequences.errors import InputError
from stario.sequences.noise import PHONE_NOISE, ImuNoise
from stario.sequences.sequence import (
    GAP_STEPS,
    MAX_TRUTH_GAP,
    STANDARD_GRAVITY,
    FloatArray,
    ImuSequence,
    Trajectory,
    is_gap,
)
from stario.sequences.settings import check_number
from stario.sequences.simulation.magnetometer import MagneticField, simulate_magnetometer

_MIN_POSES = 6
"""Minimum number of points of a quintic spline."""


@dataclass(frozen=True)
class ImuErrors:
    """Errors of simulated sensors; every deviation is that of a zero-mean normal draw.

    A sample is `clip(T x + b + n)`: T contains a scale error per axis and a small rotation of the
    sensor's axes (drawn separately for each sensor), b is the turn-on bias and its random walk,
    n the white noise.

    Attributes:
        noise: continuous-time densities of white noise and bias random walk.
        gyro_turn_on: deviation of the gyroscope's bias at the first sample [rad/s].
        accel_turn_on: deviation of the accelerometer's bias at the first sample [m/s^2].
        gyro_scale: deviation of the gyroscope's scale error, per axis [1].
        accel_scale: deviation of the accelerometer's scale error, per axis [1].
        misalignment: deviation of a sensor's rotation relative to the body, per axis [rad].
        gyro_range: absolute rate beyond which an axis saturates [rad/s].
        accel_range: absolute specific force beyond which an axis saturates [m/s^2].

    Raises:
        InputError: a deviation is negative or not finite, or a range is not positive.
    """

    noise: ImuNoise = field(default_factory=ImuNoise)
    gyro_turn_on: float = 0.0
    accel_turn_on: float = 0.0
    gyro_scale: float = 0.0
    accel_scale: float = 0.0
    misalignment: float = 0.0
    gyro_range: float = math.inf
    accel_range: float = math.inf

    def __post_init__(self) -> None:
        for item in fields(self)[1:]:
            if not item.name.endswith("_range"):
                check_number(self, item.name)
            elif not getattr(self, item.name) > 0:
                raise InputError(item.name, repr(getattr(self, item.name)), "a number > 0, or inf")


PERFECT_IMU = ImuErrors(noise=ImuNoise(0.0, 0.0, 0.0, 0.0))
"""An IMU without errors."""

PHONE_IMU = ImuErrors(
    noise=PHONE_NOISE,
    gyro_turn_on=3e-3,
    accel_turn_on=0.05,
    gyro_scale=0.01,
    accel_scale=0.005,
    misalignment=0.01,
    gyro_range=math.radians(2000.0),
    accel_range=8.0 * STANDARD_GRAVITY,
)
"""A factory-calibrated phone IMU, with the biases and scale errors that remain: the yaw of Android
phones drifts by 0.08 to 0.23 deg/s (root mean square by phone, true attitudes of tyrex, KIPD and
RIDI; the raw rates of iPhones by 0.5 to 2.6)."""

GOOD_IMU = ImuErrors(
    noise=ImuNoise(gyro_noise=5e-5, accel_noise=5e-4, gyro_walk=2e-6, accel_walk=5e-5),
    gyro_turn_on=5e-4,
    accel_turn_on=0.01,
    gyro_scale=5e-4,
    accel_scale=5e-4,
    misalignment=5e-4,
    gyro_range=math.radians(2000.0),
    accel_range=16.0 * STANDARD_GRAVITY,
)
"""A calibrated industrial unit."""


def simulate_imu(
    trajectory: Trajectory,
    rate: float = 200.0,
    errors: ImuErrors = PHONE_IMU,
    seed: int = 0,
    gravity: float = STANDARD_GRAVITY,
    name: str = "simulated",
    magnetic_field: MagneticField | None = None,
) -> ImuSequence:
    """Simulate an IMU that moves along `trajectory`; samples are instantaneous.

    Args:
        trajectory: at least 6 poses, evenly sampled at any rate that resolves the motion. The
            spline bridges missing and invalid poses.
        rate: sampling rate of the IMU [Hz].
        errors: errors of the sensors.
        seed: seed of every random draw; the same seed gives the same recording.
        gravity: magnitude of gravity [m/s^2].
        name: name of the sequence.
        magnetic_field: field and errors of a magnetometer next to the IMU; None for none.

    Raises:
        InputError: too few poses, a gap between valid poses longer than 0.1 s and 1.8 median
            steps, a rate, gravity or seed out of range, or an argument has the wrong type.
    """
    check_type("trajectory", trajectory, Trajectory, "generate_walk(seed) returns one")
    check_type("errors", errors, ImuErrors, "such as PHONE_IMU; pass a seed by name: seed=7")
    _check(trajectory, rate, gravity)
    truth, gyro, acceleration_W = _sampled(trajectory, rate)
    up = np.array([0.0, 0.0, gravity])
    accel = truth.attitude_WB.apply(acceleration_W + up, inverse=True)
    rng = generator(seed)
    gyro = _measured(gyro, "gyro", rate, rng, errors)
    accel = _measured(accel, "accel", rate, rng, errors)
    seen = None if magnetic_field is None else simulate_magnetometer(truth, magnetic_field, seed)
    return ImuSequence(name, truth.time, gyro, accel, truth, magnetometer=seen)


def _check(trajectory: Trajectory, rate: float, gravity: float) -> None:
    if not (math.isfinite(rate) and rate > 0):
        raise InputError("rate", repr(rate), "a finite rate > 0 Hz")
    if not (math.isfinite(gravity) and gravity >= 0):
        raise InputError("gravity", repr(gravity), "a finite magnitude >= 0 m/s^2")
    known = np.flatnonzero(trajectory.valid)
    if len(known) < _MIN_POSES:
        raise InputError("trajectory", f"{len(known)} valid poses", f"at least {_MIN_POSES}")
    steps = np.diff(trajectory.time[known])
    usual = float(np.median(np.diff(trajectory.time)))
    bridged = is_gap(steps, max(MAX_TRUTH_GAP, GAP_STEPS * usual))
    if bridged.any():
        k = int(np.argmax(bridged))
        raise InputError(
            "trajectory",
            f"no valid pose for {steps[k]:.3f} s after {trajectory.time[known[k]]:.3f} s",
            "a trajectory without gaps", "simulate its parts separately",
        )  # fmt: skip


def _sampled(trajectory: Trajectory, rate: float) -> tuple[Trajectory, FloatArray, FloatArray]:
    """Return truth, body rate [rad/s] and acceleration in W [m/s^2] on the IMU's time grid."""
    t = trajectory.time[trajectory.valid]
    # Include the last pose even if rounding places it slightly beyond the end.
    count = int(np.floor((t[-1] - t[0]) * rate + 1e-6)) + 1
    time = np.minimum(t[0] + np.arange(count) / rate, t[-1])
    position = make_interp_spline(t, trajectory.position_W[trajectory.valid], k=5)
    attitude_WB, gyro = _attitude_and_rate(t, trajectory.quat_xyzw[trajectory.valid], time)
    truth = Trajectory(time, position(time), attitude_WB, velocity_W=position(time, 1))
    return truth, gyro, np.asarray(position(time, 2), dtype=np.float64)


def _attitude_and_rate(
    t: FloatArray, quat_xyzw: FloatArray, time: FloatArray
) -> tuple[Rotation, FloatArray]:
    # Signs such that neighbours lie on one half-sphere.
    dots = np.sum(quat_xyzw[1:] * quat_xyzw[:-1], axis=1)
    signs = np.cumprod(np.where(np.append(1.0, dots) < 0.0, -1.0, 1.0))
    spline = make_interp_spline(t, quat_xyzw * signs[:, None], k=3)
    s, ds = spline(time), spline(time, 1)
    vector, scalar = s[:, :3], s[:, 3:]
    rate = 2.0 * (scalar * ds[:, :3] - ds[:, 3:] * vector - np.cross(vector, ds[:, :3]))
    return Rotation.from_quat(s), rate / np.sum(s * s, axis=1, keepdims=True)


def _measured(
    true: FloatArray, sensor: str, rate: float, rng: np.random.Generator, errors: ImuErrors
) -> FloatArray:
    """Return the measurements (N, 3) by "gyro" or "accel" of the values `true` (N, 3)."""
    of_sensor = {**vars(errors.noise), **vars(errors)}
    white, walk, turn_on, scale, limit = (
        of_sensor[f"{sensor}_{name}"] for name in ("noise", "walk", "turn_on", "scale", "range")
    )
    axes = Rotation.from_rotvec(errors.misalignment * rng.standard_normal(3)).as_matrix()
    scales = 1.0 + scale * rng.standard_normal(3)
    steps = walk / math.sqrt(rate) * rng.standard_normal(true.shape)
    steps[0] = turn_on * rng.standard_normal(3)
    bias = np.cumsum(steps, axis=0)
    noise = white * math.sqrt(rate) * rng.standard_normal(true.shape)
    measured: FloatArray = np.clip(true @ axes.T * scales + bias + noise, -limit, limit)
    return measured
