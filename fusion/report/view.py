"""A run for the rerun viewer: track, attitude, covariance and sensors over time.

The content is written to a file, which the viewer opens; the file can be reopened or shared.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.compare import Comparison
from stario.fusion.state import Track
from stario.sequences.drawing.figures import split_at_gaps, split_at_nan
from stario.sequences.errors import InputError
from stario.sequences.lazy import optional_package
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory

rr: Any = optional_package("rerun", "view")

_AXIS_LENGTH = 0.4
_SIGMAS = 3.0
_BLUE, _BLACK = (0, 114, 178), (0, 0, 0)
_AXIS_COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115))


def write_view(path: Path, run: Comparison) -> Path:
    """Write a run as a rerun file.

    Args:
        path: file to write, ending in .rrd; its folder must exist.
        run: the recording, with its sensors and ground truth, and its track.

    Returns:
        The path.

    Raises:
        InputError: the file cannot be written.
    """
    sequence, track, aligned = run.sequence, run.track, run.aligned()["track"]
    stream = rr.RecordingStream("stario", recording_id=None)
    try:
        stream.save(path)
    except (OSError, RuntimeError) as error:
        raise InputError("view", f"{path}: {error}", "a writable path") from error
    start = float(sequence.time[np.isfinite(sequence.time)][0])
    stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_path(stream, "world/track", aligned, _BLUE)
    if sequence.truth is not None:
        _log_path(stream, "world/truth", sequence.truth, _BLACK)
    _log_device(stream, aligned, start)
    for entity, time, values, labels in _quantities(sequence, track):
        name, index = rr.new_entity_path(entity), _times(time - start)
        stream.send_columns(name, index, rr.Scalars.columns(scalars=values))
        colours = [list(colour) for colour in _AXIS_COLOURS[: values.shape[1]]]
        stream.log(name, rr.SeriesLines(colors=colours, names=labels), static=True)
    stream.disconnect()
    return path


def open_view(path: Path) -> None:
    """Open a file in the viewer, which keeps running on its own.

    Raises:
        InputError: the viewer cannot be started.
    """
    command = [sys.executable, "-m", "rerun", str(path)]
    try:
        subprocess.Popen(
            command, start_new_session=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
    except OSError as error:
        raise InputError("view", str(error), "the rerun viewer") from error


def _log_path(
    stream: Any, entity: str, trajectory: Trajectory, colour: tuple[int, int, int]
) -> None:
    """Log a whole path at once, broken in gaps and where poses are not valid."""
    _, path = split_at_gaps(trajectory.time, trajectory.position_W, trajectory.valid)
    stream.log(
        entity, rr.LineStrips3D(split_at_nan(path), colors=[colour], radii=[0.02]), static=True
    )


def _log_device(stream: Any, trajectory: Trajectory, start: float) -> None:
    """Log the device's axes at its position, with the 3-sigma ellipsoid of the position."""
    index = _times(trajectory.time[trajectory.valid] - start)
    position = trajectory.position_W[trajectory.valid]
    columns = rr.Transform3D.columns(
        translation=position, quaternion=trajectory.quat_xyzw[trajectory.valid]
    )
    stream.send_columns("world/device", index, columns)
    axes = rr.Arrows3D(vectors=_AXIS_LENGTH * np.eye(3), colors=_AXIS_COLOURS)
    stream.log("world/device", axes, static=True)
    covariance = trajectory.position_covariance_W
    if covariance is None:
        return
    values, vectors = np.linalg.eigh(covariance[trajectory.valid])
    vectors[np.linalg.det(vectors) < 0.0, :, 0] *= -1.0  # a rotation, not a reflection
    count = np.ones(len(position), dtype=int)
    columns = rr.Ellipsoids3D.columns(
        centers=position,
        half_sizes=_SIGMAS * np.sqrt(np.maximum(values, 0.0)),
        quaternions=Rotation.from_matrix(vectors).as_quat(),
    )
    stream.send_columns(rr.new_entity_path(["world", "3 sigma"]), index, columns.partition(count))


def _quantities(
    sequence: ImuSequence, track: Track
) -> Iterator[tuple[list[str], FloatArray, FloatArray, list[str]]]:
    """Yield path, times (N,), values (N, k) and labels of each quantity over time."""
    finite, axes = np.isfinite(sequence.time), list("xyz")
    time = sequence.time[finite]
    yield ["sensors", "gyroscope [rad/s]"], time, sequence.gyro[finite], axes
    yield ["sensors", "specific force [m/s^2]"], time, sequence.accel[finite], axes
    for name, bias in (
        ("gyroscope bias [rad/s]", track.b_g),
        ("accelerometer bias [m/s^2]", track.b_a),
    ):
        if bias is not None:
            yield ["estimate", name], track.time, bias, axes
    if track.trajectory.velocity_W is not None:
        speed = np.linalg.norm(track.trajectory.velocity_W, axis=1)[:, None]
        yield ["estimate", "speed [m/s]"], track.time, speed, ["speed"]
    if track.covariance is not None:
        sigma = np.sqrt(track.covariance[:, range(15), range(15)])
        yield ["estimate", "sigma of position [m]"], track.time, sigma[:, 6:9], axes
        yield ["estimate", "sigma of yaw [rad]"], track.time, sigma[:, 2:3], ["yaw"]
    innovations = track.innovations
    if innovations is not None and len(innovations.time):
        yield ["estimate", "NIS [1]"], innovations.time, innovations.nis[:, None], ["NIS"]


def _times(seconds: FloatArray) -> list[Any]:
    return [rr.TimeColumn("time", duration=seconds)]
