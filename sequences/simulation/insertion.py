"""Insertion of a bad moment into a recording: time is opened at an instant and the moment put in.

The device is brought to rest from its motion at the instant, goes through the moment and returns to
that motion, so that samples, attitude and ground truth continue without a step. Samples before stay
as they were, those after come later.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import generator
from stario.sequences.attitude.rotations import GyroIntegral, about_z
from stario.sequences.attitude.stacks import composed
from stario.sequences.auxiliary import Timed
from stario.sequences.clean_samples import clean_samples
from stario.sequences.noise import PHONE_NOISE
from stario.sequences.sequence import (
    Barometer,
    FloatArray,
    ImuSequence,
    Magnetometer,
    PositionTrack,
    Trajectory,
)
from stario.sequences.simulation.imu import PHONE_IMU, ImuErrors, simulate_imu
from stario.sequences.simulation.magnetometer import MagneticField
from stario.sequences.simulation.moments import Moment, MomentMotion, ramp
from stario.sequences.units import METRES_PER_HPA

GYRO_ERROR = 0.015
"""Standard deviation of the gyroscope's errors of scale and alignment during a moment [1]."""

_POSE_RATE = 500.0
"""Rate of the poses that a moment's samples are derived from [Hz]: it resolves impacts."""

_HALT_SECONDS, _STILL_SECONDS = 2.0, 0.5
"""Time in which a walking device comes to rest, and in which its rotation does [s]."""

_BIAS_STRIDE = 0.2
"""Time over which gyroscope and poses are compared for the bias [s]."""

_PRESSURES = 16
"""Number of samples of the pressure near a moment from which those within it are drawn."""

_ERRORS = ImuErrors(
    noise=PHONE_NOISE, gyro_range=PHONE_IMU.gyro_range, accel_range=PHONE_IMU.accel_range
)


@dataclass(frozen=True, eq=False)
class Inserted:
    """A recording with a moment, which lasts from `start` to `stop` [s]."""

    sequence: ImuSequence
    start: float
    stop: float


@dataclass(frozen=True, eq=False)
class _Instant:
    """What is known of the device at the instant `time` [s], in a level frame L."""

    time: float
    position_L: FloatArray
    attitude_LB: Rotation
    velocity_L: FloatArray
    rate_B: FloatArray
    field_L: FloatArray | None


def insert_moment(
    sequence: ImuSequence, poses: Trajectory, moment: Moment, share: float, seed: int
) -> Inserted:
    """Insert a moment into a recording.

    The gyroscope keeps its bias, and has other errors of scale and alignment during the moment; the
    accelerometer keeps its measure of gravity.

    Args:
        sequence: the recording; the device's own attitude is left out of the result.
        poses: its ground truth if that has attitudes, else poses estimated from it.
        moment: the moment.
        share: when it begins, as a share of the recording's duration; 0 puts it before the first
            sample, where the device starts at rest.
        seed: seed of the moment and of the sensors' errors in it.

    Raises:
        InputError: the recording has fewer than two usable samples, or `poses` has no two valid.
    """
    time, gyro, accel = clean_samples(sequence)
    bias, gravity = _sensor_offsets(time, gyro, accel, poses)
    wanted = np.abs(time - (time[0] + share * (time[-1] - time[0])))
    first = int(np.argmin(np.where(poses.covers(time), wanted, np.inf)))
    instant = _at(float(time[first]), gyro[first] - bias, poses, sequence.magnetometer)
    rng = generator(seed)
    rate = sequence.rate
    count = round(moment.seconds * rate)
    grid = np.linspace(0.0, count / rate, round(count / rate * _POSE_RATE) + 1)
    motion = moment.motion(rng, grid, instant.attitude_LB)
    trajectory = _trajectory(grid, motion, instant, begins_at_rest=first == 0)
    inside = simulate_imu(trajectory, rate, _ERRORS, seed, gravity)
    assert inside.truth is not None
    inside_time = instant.time + inside.time[:count]
    errors = np.eye(3) + GYRO_ERROR * rng.standard_normal((3, 3))
    new_gyro = inside.gyro[:count] @ errors.T + bias
    later = count / rate
    new = replace(
        sequence,
        time=np.concatenate([time[:first], inside_time, time[first:] + later]),
        gyro=np.concatenate([gyro[:first], new_gyro, gyro[first:]]),
        accel=np.concatenate([accel[:first], inside.accel[:count], accel[first:]]),
        device_attitude=None,
    )
    moved = trajectory.position_W[-1] - instant.position_L
    if sequence.truth is not None:
        truth = inside.truth.select(np.arange(len(inside.truth)) < count)
        new = replace(new, truth=_with_poses(sequence.truth, truth, instant.time, later, moved))
    if sequence.positions is not None:
        positions = _with_positions(sequence.positions, instant.time, later, moved)
        new = replace(new, positions=positions)
    if sequence.barometer is not None:
        pressure = _pressure(sequence.barometer, inside.truth, instant, later, rng)
        new = replace(new, barometer=pressure)
    if sequence.satellites is not None:
        known = sequence.satellites
        new = replace(new, satellites=replace(known, time=_later(known, instant.time, later)))
    if sequence.magnetometer is not None and instant.field_L is not None:
        field = _field(sequence.magnetometer, inside.truth, motion, grid, instant, rng)
        new = replace(new, magnetometer=field)
    return Inserted(new, instant.time, instant.time + later)


def _sensor_offsets(
    time: FloatArray, gyro: FloatArray, accel: FloatArray, poses: Trajectory
) -> tuple[FloatArray, float]:
    """Return the gyroscope's bias (3,) [rad/s] and gravity as the accelerometer measures it."""
    known = poses.covers(time)
    force_L = poses.at(time[known]).attitude_WB.apply(accel[known])
    ticks = np.arange(time[0], time[-1], _BIAS_STRIDE)
    ticks = ticks[poses.covers(ticks)]
    neighbours = np.diff(ticks) < 1.5 * _BIAS_STRIDE
    true, measured = (
        composed(attitude[:-1].inv(), attitude[1:])[neighbours]
        for attitude in (poses.at(ticks).attitude_WB, GyroIntegral(time, gyro).attitude(ticks))
    )
    excess = composed(true.inv(), measured).as_rotvec() / _BIAS_STRIDE
    return np.median(excess, axis=0), float(np.linalg.norm(force_L.mean(axis=0)))


def _at(
    time: float, rate_B: FloatArray, poses: Trajectory, magnetometer: Magnetometer | None
) -> _Instant:
    near = np.clip(time + np.array([-0.1, 0.0, 0.1]), *poses.time[poses.valid][[0, -1]])
    near = np.unique(near)
    around = poses.at(near)
    velocity = np.diff(around.position_W[[0, -1]], axis=0)[0] / (near[-1] - near[0])
    middle = int(np.searchsorted(near, time))
    field_L = None
    if magnetometer is not None and (close := magnetometer.slice(time - 0.5, time + 0.5)):
        inside = close.slice(*poses.time[poses.valid][[0, -1]])
        if inside is not None:
            field_L = poses.at(inside.time).attitude_WB.apply(inside.field).mean(axis=0)
    attitude = around.attitude_WB[middle]
    return _Instant(time, around.position_W[middle], attitude, velocity, rate_B, field_L)


def _trajectory(
    time: FloatArray, motion: MomentMotion, instant: _Instant, begins_at_rest: bool
) -> Trajectory:
    """Return the poses of a moment, whose time begins at 0 [s]."""
    halt = _coasting(time, _HALT_SECONDS, begins_at_rest)
    still = _coasting(time, _STILL_SECONDS, begins_at_rest)
    own = Rotation.from_rotvec(still[:, None] * instant.rate_B)
    attitude = composed(composed(Rotation.from_rotvec(motion.turn_L), instant.attitude_LB), own)
    position = instant.position_L + motion.offset_L + halt[:, None] * instant.velocity_L
    return Trajectory(time, position, attitude)


def _coasting(time: FloatArray, seconds: float, begins_at_rest: bool) -> FloatArray:
    """Return how far (N,) [s] an earlier motion of unit rate goes on and comes back.

    Its rate is 1 at both ends (only at the last with `begins_at_rest`), its value 0 there and in
    between.
    """
    left = time - time[-1]
    back = left * (1.0 - ramp(-left / seconds))
    on = 0.0 if begins_at_rest else time * (1.0 - ramp(time / seconds))
    return np.asarray(back + on)


def _with_poses(
    truth: Trajectory, inside: Trajectory, start: float, later: float, moved: FloatArray
) -> Trajectory:
    before, after = truth.time < start, truth.time >= start
    position = truth.position_W
    quat = [truth.quat_xyzw[before], inside.quat_xyzw, truth.quat_xyzw[after]]
    valid = [truth.valid[before], inside.valid, truth.valid[after]]
    return Trajectory(
        time=np.concatenate([truth.time[before], start + inside.time, truth.time[after] + later]),
        position_W=np.concatenate([position[before], inside.position_W, position[after] + moved]),
        attitude_WB=Rotation.from_quat(np.concatenate(quat)),
        valid=np.concatenate(valid),
    )


def _with_positions(
    known: PositionTrack, start: float, later: float, moved: FloatArray
) -> PositionTrack:
    after = (known.time >= start).astype(np.float64)
    # A moment moves nothing horizontally, and the frame L may differ from the positions' in yaw.
    up = after[:, None] * moved[2] * [0.0, 0.0, 1.0]
    columns = known.position_W.shape[1]
    return replace(
        known, time=_later(known, start, later), position_W=known.position_W + up[:, :columns]
    )


def _later(known: Timed, start: float, later: float) -> FloatArray:
    """Return times (N,) [s], those after a moment's start later by its duration."""
    return np.asarray(known.time + later * (known.time >= start))


def _pressure(
    before: Barometer, inside: Trajectory, instant: _Instant, later: float, rng: np.random.Generator
) -> Barometer:
    """Return the pressure with that of a moment: the last before it, its noise, the new heights."""
    time, hPa = before.time, before.pressure_hPa
    after = time >= instant.time
    near = hPa[np.argsort(np.abs(time - instant.time))[:_PRESSURES]]
    ticks = np.arange(0.0, later - 1e-6, 1.0 / before.rate) if before.rate else np.empty(0)
    rise = np.interp(ticks, inside.time, inside.position_W[:, 2]) - instant.position_L[2]
    own = rng.choice(near, len(ticks)) - rise / METRES_PER_HPA
    lasting = (inside.position_W[-1, 2] - instant.position_L[2]) / METRES_PER_HPA
    return Barometer(
        np.concatenate([time[~after], instant.time + ticks, time[after] + later]),
        np.concatenate([hPa[~after], own, hPa[after] - lasting]),
    )


def _field(
    before: Magnetometer,
    inside: Trajectory,
    motion: MomentMotion,
    grid: FloatArray,
    instant: _Instant,
    rng: np.random.Generator,
) -> Magnetometer:
    assert instant.field_L is not None
    later = float(grid[-1])
    time = np.arange(0.0, later - 1e-6, 1.0 / before.rate)
    turn, scale = (np.interp(time, grid, v) for v in (motion.field_turn, motion.field_scale))
    field_L = scale[:, None] * about_z(turn).apply(instant.field_L)
    field = inside.at(time).attitude_WB.apply(field_L, inverse=True)
    field += MagneticField().noise * rng.standard_normal(field.shape)
    earlier, after = before.time < instant.time, before.time >= instant.time
    return Magnetometer(
        np.concatenate([before.time[earlier], instant.time + time, before.time[after] + later]),
        np.concatenate([before.field[earlier], field, before.field[after]]),
    )
