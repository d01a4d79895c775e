"""Tracks to compare with the filter's: the IMU alone, and the network alone.

The network's displacements become a track by taking each window's mean velocity as the velocity
at its middle and integrating: all overlapping windows have equal weight.
"""

from __future__ import annotations

from time import perf_counter

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stario.fusion.imu.inference import Predictor, StatefulInference
from stario.fusion.imu.preintegration import preintegrate
from stario.fusion.recording import PreprocessedRecording
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.state import Track
from stario.sequences.arrays import check_type, integral, interpolated, runs, trapezoids
from stario.sequences.attitude.so3 import exp_so3
from stario.sequences.clean_samples import clean_samples
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.windows import (
    WINDOW_RATE,
    WINDOW_SAMPLES,
    WINDOW_SECONDS,
    cut_windows,
    headings_at,
    imu_in_world,
)


def true_poses(sequence: ImuSequence) -> Trajectory:
    """Return a recording's true poses.

    Raises:
        InputError: it has none; the error names what it has instead.
    """
    if sequence.truth is None:
        field, found = f"{sequence.name}: truth", sequence.truth_summary()
        raise InputError(field, found, "a recording with true poses")
    return sequence.truth


def inertial_track(
    preprocessed: PreprocessedRecording, config: NavigatorConfig | None = None
) -> Track:
    """Integrate the IMU alone (strapdown) from the levelled start at rest, with zero biases.

    Raises:
        InputError: an argument has the wrong type.
    """
    _check_preprocessed(preprocessed)
    config = config or NavigatorConfig()
    began = perf_counter()
    start = preprocessed.start
    zero = np.zeros(3)
    R, v, p = start.R_WB, zero, zero
    rows = [(start.time, R, v, p)]
    for interval in preprocessed.intervals:
        if interval.gap:
            p = p + v * (interval.stop - interval.start)
        else:
            samples = interval.time, interval.gyro, interval.accel
            segment = preintegrate(*samples, zero, zero, config.noise, config.gravity)
            R, v, p = segment.predict(R, v, p, zero, zero)
        rows.append((interval.stop, R, v, p))
    trajectory = Trajectory(
        time=np.array([row[0] for row in rows]),
        position_W=np.array([row[3] for row in rows]),
        attitude_WB=Rotation.from_matrix(np.array([row[1] for row in rows])),
        velocity_W=np.array([row[2] for row in rows]),
    )
    return Track(trajectory, seconds_filter=perf_counter() - began)


def network_track(preprocessed: PreprocessedRecording) -> Track:
    """Chain the network's displacements along the attitude levelled from the IMU, without truth.

    Raises:
        InputError: the argument has the wrong type.
    """
    _check_preprocessed(preprocessed)
    began = perf_counter()
    start = preprocessed.start
    time = np.array([start.time, *(e.stop for e in preprocessed.intervals)])
    attitude = np.stack([start.R_WB, *(e.R_NB for e in preprocessed.intervals)])
    windows = [
        (e, m.d_N)
        for e, m in zip(preprocessed.intervals, preprocessed.measurements, strict=True)
        if m is not None
    ]
    middle = np.array([e.stop - 0.5 * WINDOW_SECONDS for e, _ in windows])
    velocity = np.array([d for _, d in windows]) / WINDOW_SECONDS
    trajectory = _chained(time, Rotation.from_matrix(attitude), middle, velocity)
    return Track(
        trajectory,
        seconds_network=preprocessed.seconds_network,
        seconds_filter=preprocessed.seconds_front_end + perf_counter() - began,
    )


def _check_preprocessed(preprocessed: object) -> None:
    remedy = "navigator.observe(recording) returns one"
    check_type("preprocessed", preprocessed, PreprocessedRecording, remedy)


def network_track_true_attitude(
    model: Predictor, sequence: ImuSequence, config: NavigatorConfig
) -> Track:
    """Chain displacements of windows rotated by the true attitude, the papers' protocol.

    Across gaps of the truth the gyroscope propagates the attitude: a track without the
    displacements of those seconds would measure the gap and not the network.

    Raises:
        InputError: the recording has no true poses, or no second of valid ones.
    """
    began = perf_counter()
    truth = _propagated_through_gaps(sequence, true_poses(sequence))
    time, windows, heading = _true_windows(sequence, truth, 1.0 / config.filter.update_rate)
    prepared = perf_counter()
    network = StatefulInference(model, config.filter.window_updates)
    begins = np.diff(time, prepend=time[0]) * network.updates > 1.5
    displacement, _ = network.predict(windows, heading, begins)
    done = perf_counter()
    middle = time + 0.5 * WINDOW_SECONDS
    ticks = np.append(middle - 0.5 * WINDOW_SECONDS, middle[-1] + 0.5 * WINDOW_SECONDS)
    attitude = truth.at(ticks).attitude_WB
    trajectory = _chained(ticks, attitude, middle, displacement / WINDOW_SECONDS)
    return Track(
        trajectory,
        seconds_network=done - prepared,
        seconds_filter=prepared - began + perf_counter() - done,
    )


def _propagated_through_gaps(sequence: ImuSequence, truth: Trajectory) -> Trajectory:
    """Return poses at the samples within the truth, with the attitude propagated through gaps."""
    time, gyro, _ = clean_samples(sequence)
    covered = np.flatnonzero(truth.covers(time))
    if len(covered) == 0:
        raise InputError(f"{sequence.name}: truth", "no valid pose", "at least one second of them")
    inside = slice(covered[0], covered[-1] + 1)
    time, gyro = time[inside], gyro[inside]
    poses = truth.at(time)
    R_WB = poses.attitude_WB.as_matrix()
    turns = trapezoids(time, gyro)
    for start, stop in runs(~truth.covers(time)):
        for k in range(start, stop):
            R_WB[k] = R_WB[k - 1] @ exp_so3(turns[k - 1])
    return Trajectory(time, poses.position_W, Rotation.from_matrix(R_WB))


def _true_windows(
    sequence: ImuSequence, truth: Trajectory, period: float
) -> tuple[FloatArray, NDArray[np.float32], FloatArray]:
    """Return start times (M,), windows (M, 6, 200) and headings (M,) where there is no gap."""
    world = imu_in_world(sequence, truth, "true")
    bad_before = np.concatenate([[0], np.cumsum(~world.usable)])
    stride = round(period * WINDOW_RATE)
    starts = np.arange(0, len(world.time) - WINDOW_SAMPLES + 1, stride)
    starts = starts[bad_before[starts + WINDOW_SAMPLES] == bad_before[starts]]
    if len(starts) == 0:
        raise InputError(f"{sequence.name}: truth", "no second without gaps", "at least one")
    windows = cut_windows(world.imu, starts)
    return world.time[starts], windows, headings_at(world.facing, starts)


def _chained(
    time: FloatArray, attitude: Rotation, middle: FloatArray, velocity: FloatArray
) -> Trajectory:
    """Return the trajectory at `time` from velocities at the windows' middles."""
    at_time = interpolated(time, middle, velocity)
    return Trajectory(time, integral(time, at_time), attitude, velocity_W=at_time)
