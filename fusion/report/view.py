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
from stario.fusion.values.state import Track
from stario.sequences.drawing.figures import split_at_gaps, split_at_nan
from stario.sequences.errors import InputError
from stario.sequences.lazy import optional_package
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory

rr: Any = optional_package("rerun", "view")

_AXIS_LENGTH = 0.4
_SIGMAS = 3.0
_BLUE, _BLACK = (0, 114, 178), (0, 0, 0)
_AXIS_COLOURS = ((0, 114, 178), (213, 94, 0), (0, 158, 115))


def write_view(path: Path, found: Comparison) -> Path:
    """Write a run as a rerun file.

    Args:
        path: file to write, ending in .rrd; its folder must exist.
        found: the recording, with its sensors and ground truth, and its track.

    Returns:
        The path.

    Raises:
        InputError: the file cannot be written.
    """
    sequence, track, aligned = found.sequence, found.track, found.aligned()["track"]
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
    for entity, time, values in _quantities(sequence, track):
        path_of, what = rr.new_entity_path(entity), entity[1].partition(" [")[0].split()[-1]
        stream.send_columns(path_of, _times(time - start), rr.Scalars.columns(scalars=values))
        names, colours = ("xyz", _AXIS_COLOURS) if values.shape[1] == 3 else ([what], [_BLUE])
        stream.log(path_of, rr.SeriesLines(colors=colours, names=[*names]), static=True)
    stream.disconnect()
    return path


def open_view(path: Path) -> None:
    """Open a file in the viewer, which keeps running on its own.

    Raises:
        InputError: the viewer cannot be started.
    """
    command, quiet = [sys.executable, "-m", "rerun", str(path)], subprocess.DEVNULL
    try:
        subprocess.Popen(command, start_new_session=True, stdout=quiet, stderr=quiet)
    except OSError as error:
        raise InputError("view", str(error), "the rerun viewer") from error


def _log_path(
    stream: Any, entity: str, trajectory: Trajectory, colour: tuple[int, int, int]
) -> None:
    """Log a whole path at once, broken in gaps and where poses are not valid."""
    _, path = split_at_gaps(trajectory.time, trajectory.position_W, trajectory.valid)
    lines = rr.LineStrips3D(split_at_nan(path), colors=[colour], radii=[0.02])
    stream.log(entity, lines, static=True)


def _log_device(stream: Any, trajectory: Trajectory, start: float) -> None:
    """Log the device's axes at its position, with the 3-sigma ellipsoid of the position."""
    valid = trajectory.valid
    index, position = _times(trajectory.time[valid] - start), trajectory.position_W[valid]
    turned = trajectory.quat_xyzw[valid]
    columns = rr.Transform3D.columns(translation=position, quaternion=turned)
    stream.send_columns("world/device", index, columns)
    axes = rr.Arrows3D(vectors=_AXIS_LENGTH * np.eye(3), colors=_AXIS_COLOURS)
    stream.log("world/device", axes, static=True)
    covariance = trajectory.position_covariance_W
    if covariance is None:
        return
    values, vectors = np.linalg.eigh(covariance[valid])
    vectors[np.linalg.det(vectors) < 0.0, :, 0] *= -1.0  # a rotation, not a reflection
    columns = rr.Ellipsoids3D.columns(
        centers=position,
        half_sizes=_SIGMAS * np.sqrt(np.maximum(values, 0.0)),
        quaternions=Rotation.from_matrix(vectors).as_quat(),
    ).partition(np.ones(len(position), dtype=int))
    stream.send_columns(rr.new_entity_path(["world", "3 sigma"]), index, columns)


def _quantities(
    sequence: ImuSequence, track: Track
) -> Iterator[tuple[tuple[str, str], FloatArray, FloatArray]]:
    """Yield path, times (N,) and values (N, 1) or (N, 3), by axis, of each quantity over time."""
    finite = np.isfinite(sequence.time)
    sensors = {"gyroscope [rad/s]": sequence.gyro, "specific force [m/s^2]": sequence.accel}
    for name, values in sensors.items():
        yield ("sensors", name), sequence.time[finite], values[finite]
    estimates = {"gyroscope bias [rad/s]": track.b_g, "accelerometer bias [m/s^2]": track.b_a}
    if (velocity := track.trajectory.velocity_W) is not None:
        estimates["speed [m/s]"] = np.linalg.norm(velocity, axis=1)[:, None]
    if track.covariance is not None:
        sigma = np.sqrt(track.covariance[:, range(15), range(15)])
        estimates |= {"sigma of position [m]": sigma[:, 6:9], "sigma of yaw [rad]": sigma[:, 2:3]}
    for name, known in estimates.items():
        if known is not None:
            yield ("estimate", name), track.time, known
    innovations = track.innovations
    if innovations is not None and len(innovations.time):
        yield ("estimate", "NIS [1]"), innovations.time, innovations.nis[:, None]


def _times(seconds: FloatArray) -> list[Any]:
    return [rr.TimeColumn("time", duration=seconds)]
