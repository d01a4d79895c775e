"""Columns of a track over time as drawn by the report: thinned, with standard deviations."""

from __future__ import annotations

import numpy as np
import pandas as pd

from stario.fusion.values.state import Track
from stario.sequences.arrays import evenly_spaced, interpolated
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.drawing.figures import indices_after_gaps
from stario.sequences.sequence import MAX_TRUTH_GAP, FloatArray, Trajectory

MAX_POINTS = 1000
"""Maximum number of poses drawn per track; a screen shows no more, and the file stays small."""


def track_series(trajectory: Trajectory, start: float, track: Track | None = None) -> pd.DataFrame:
    """Return what is drawn of a trajectory; without velocities, speed is taken from positions.

    The index is the time since the recording's first sample [s]. Columns are x, y, z [m], speed
    [m/s] and yaw [deg], unwrapped; with a covariance also its xx, xy, yy [m^2], "sigma z" [m] and
    "sigma", the larger semi-axis of the horizontal 1-sigma ellipse [m]. A row is NaN where the pose
    is not valid, and once in each gap. As far as a track has them: "sigma speed" [m/s], "sigma yaw"
    [deg], and of each axis "gyro x" [deg/s] and "accel x" [m/s^2], which are biases, with "sigma
    gyro x" and "sigma accel x".

    Args:
        trajectory: the poses as drawn.
        start: time of the recording's first sample [s].
        track: the track of which these are the poses, one for one.
    """
    velocity, P = trajectory.velocity_W, trajectory.position_covariance_W
    columns = dict(zip("xyz", trajectory.position_W.T, strict=True))
    columns["speed"] = _speed(trajectory) if velocity is None else np.linalg.norm(velocity, axis=1)
    columns["yaw"] = np.degrees(np.unwrap(yaw_of(trajectory.attitude_WB)))
    if P is not None:
        columns |= {"xx": P[:, 0, 0], "xy": P[:, 0, 1], "yy": P[:, 1, 1]}
        columns["sigma z"] = np.sqrt(P[:, 2, 2])
        columns["sigma"] = np.sqrt(np.linalg.eigvalsh(P[:, :2, :2])[:, 1])
    if track is not None and track.covariance is not None:
        columns |= _estimates(track, track.covariance)
    return _thinned(trajectory, columns, start)


def _estimates(track: Track, P: FloatArray) -> dict[str, FloatArray]:
    """Return the columns of a track beyond its poses, from its covariance (N, 15, 15)."""
    sigma = np.sqrt(P[:, range(15), range(15)])
    columns = {"sigma yaw": np.degrees(sigma[:, 2])}
    if (velocity := track.trajectory.velocity_W) is not None:
        columns["sigma speed"] = _speed_sigma(velocity, P[:, 3:6, 3:6])
    biases = ("gyro", track.b_g, 9, np.degrees(1.0)), ("accel", track.b_a, 12, 1.0)
    for name, bias, first, unit in biases:
        if bias is None:
            continue
        for k, axis in enumerate("xyz"):
            columns[f"{name} {axis}"] = unit * bias[:, k]
            columns[f"sigma {name} {axis}"] = unit * sigma[:, first + k]
    return columns


def ellipse(xx: float, xy: float, yy: float) -> FloatArray:
    """Return the closed outline (49, 2) of the 3-sigma ellipse of a covariance about zero [m]."""
    values, axes = np.linalg.eigh([[xx, xy], [xy, yy]])
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    outline: FloatArray = (axes * 3.0 * np.sqrt(np.maximum(values, 0.0))) @ circle
    return outline.T


def _thinned(trajectory: Trajectory, columns: dict[str, FloatArray], start: float) -> pd.DataFrame:
    """Return at most `MAX_POINTS` rows, with one that is not shown in the middle of each gap."""
    time = trajectory.time
    rows = evenly_spaced(len(time), MAX_POINTS)
    after = np.unique(np.searchsorted(rows, indices_after_gaps(time, MAX_TRUTH_GAP)))
    middle = 0.5 * (time[rows[after - 1]] + time[rows[after]])
    shown = np.insert(trajectory.valid[rows], after, False)
    at = np.insert(time[rows], after, middle) - start
    table = pd.DataFrame(columns).iloc[np.insert(rows, after, rows[after])].set_index(at)
    table[~shown] = np.nan
    return table


def _speed_sigma(velocity: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the sigma of the norm of v to first order: sqrt(u'Pu), u the direction of v."""
    norm = np.linalg.norm(velocity, axis=1, keepdims=True)
    # At rest there is no direction: take the largest variance of any.
    largest = np.linalg.eigvalsh(covariance)[:, -1]
    u = velocity / np.maximum(norm, 1e-9)
    along = np.einsum("ni,nij,nj->n", u, covariance, u)
    return np.sqrt(np.where(norm[:, 0] > 1e-6, along, largest))


def _speed(trajectory: Trajectory) -> FloatArray:
    """Return the speed (N,) by central differences over one second, to suppress noise of poses."""
    t, half = trajectory.time, 0.5
    valid = np.flatnonzero(trajectory.valid)
    if len(valid) < 2:
        return np.full(len(t), np.nan)
    first, last = t[valid[0]], t[valid[-1]]
    before, after = (np.clip(t + sign * half, first, last) for sign in (-1.0, 1.0))
    ends = [interpolated(at, t[valid], trajectory.position_W[valid]) for at in (before, after)]
    span = np.maximum(after - before, 1e-9)
    return np.asarray(np.linalg.norm(ends[1] - ends[0], axis=1) / span)
