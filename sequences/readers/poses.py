"""Poses that an augmented-reality app logged alongside an IMU, transformed to the IMU's frames.

Rows are time, position xyz [m] and a quaternion, or the upper three rows of a pose matrix (ARKit).
Files differ in the body they describe (camera, display, sensor), in the quaternion's order, which
some headers name wrongly, and in the world's vertical (y for ARCore and ARKit). Each file and order
is compared with the gyroscope (`stario.sequences.attitude.alignment`), and the best is used. Its
constant rotation relative to the IMU's axes is removed, and its world is levelled with the mean
specific force. If several agree, the one with the smallest rotation is the sensor's own.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import interpolated
from stario.sequences.attitude.alignment import BodyAlignment, align_tracked_body, clock_offset
from stario.sequences.attitude.levelling import MIN_GRAVITY_FORCE
from stario.sequences.attitude.rotations import NORM_TOLERANCE, tilt_aligning
from stario.sequences.clean_samples import clean_samples
from stario.sequences.conventions import axes_named
from stario.sequences.errors import InputError, ReadError
from stario.sequences.readers.clocks import time_unit
from stario.sequences.readers.phones.files import names_both_sensors
from stario.sequences.readers.phones.sensor_words import words_of
from stario.sequences.readers.table_head import table_heads
from stario.sequences.readers.text import IntArray, seconds
from stario.sequences.sequence import FloatArray, ImuSequence, Trajectory
from stario.sequences.time_order import increasing_mask

_log = logging.getLogger(__name__)

_NAMES = ("pose", "arcore", "arkit")
_OTHER = {"point", "points", "cloud", "intrinsics", "image", "frames"}
_SUFFIXES = (".txt", ".csv")

_MIN_CORRELATION = 0.9
"""Minimum correlation of angular rates for a pose to be that of the IMU's device."""

_TIE_MARGIN = 0.02
_DOWN = 0.985
"""Minimum cosine between a mean force and a world's -y or -z for it to point down."""

_SQUARE_RAD = np.deg2rad(15.0)
"""Rotations relative to the IMU that are closer than this to right angles are rounded to them:
cameras and displays are mounted along a phone's edges, and the rest is estimation error."""

_GRAVITY_KEPT = 0.9
"""Minimum ratio of the mean force along the vertical to its mean magnitude if axes are right."""

_BETTER, _SHARPER = 0.2, 0.02
"""Margins by which another axis order must exceed the logged and the next best in that ratio."""

_SAME_AXES_RAD = np.deg2rad(1.0)
_SAME_CLOCK_S = 0.1
"""Maximum lag between pose and gyroscope if both use the same clock."""


@dataclass(frozen=True)
class _Poses:
    """A pose file's rows, read in an order "xyzw", "wxyz" or "matrix".

    Times (N,) [ns] increase strictly; positions (N, 3) [m] and N rotations are from an unknown body
    to an unknown world.
    """

    file: Path
    stamps_ns: IntArray
    position: FloatArray
    attitude: Rotation
    order: str


def pose_files(folder: Path, key: str = "") -> list[Path]:
    """Return pose files by name, but no table of both sensors; `key` holds words that all share."""
    found = []
    for file in sorted(folder.iterdir()):
        words = set(words_of(file.stem))
        named = any(name in "".join(words_of(file.stem)) for name in _NAMES)
        if file.suffix.lower() not in _SUFFIXES or not named or _OTHER & words:
            continue
        if set(key.split()) <= words and not names_both_sensors(file):
            found.append(file)
    return found


def with_pose(
    sequence: ImuSequence,
    start_ns: np.int64 | int,
    files: list[Path],
    orders: Collection[str] = ("xyzw", "wxyz", "matrix"),
) -> ImuSequence:
    """Return a recording without truth with the best of the pose files as such, if one agrees.

    Its first sample is at `start_ns` on the poses' clock [ns]; `orders` of the attitude are tried.
    """
    candidates = [poses for file in files for poses in _read_poses(file) if poses.order in orders]
    fits = [fit for poses in candidates if (fit := _fitted(sequence, start_ns, poses)) is not None]
    if not fits:
        names = ", ".join(file.name for file in files)
        if candidates:
            names = ", ".join(dict.fromkeys(poses.file.name for poses in candidates))
            _log.warning("%s: no poses in %s agree with the gyroscope", sequence.name, names)
        elif files:
            _log.warning("%s: no row in %s holds a pose", sequence.name, names)
        return sequence
    best = max(fit.aligned.correlation for fit in fits)
    near = [fit for fit in fits if fit.aligned.correlation > best - _TIE_MARGIN]
    chosen = min(near, key=lambda fit: fit.turn)
    _log_choice(sequence, fits, chosen)
    return _posed(sequence, chosen)


def _read_poses(file: Path) -> list[_Poses]:
    """Return a file's poses in each possible interpretation; none if it holds no poses."""
    head = next(table_heads(file), None)
    if head is None or head.rows.shape[1] < 8:
        return []
    columns = 13 if head.rows.shape[1] >= 13 else 8
    table = head.read(columns)
    stamps = table.stamps_ns(time_unit(file, table.values[:, 0]))
    numbers = table.values[:, 1:]
    if columns == 13:
        matrices = numbers.reshape(-1, 3, 4)
        position, rotation = matrices[:, :, 3], matrices[:, :, :3]
        size = np.linalg.det(rotation)
    else:
        position, rotation = numbers[:, :3], numbers[:, 3:]
        size = np.linalg.norm(rotation, axis=1)
    good = (np.abs(size - 1.0) < NORM_TOLERANCE) & np.isfinite(numbers).all(axis=1)
    if not good.any():
        return []
    used = np.flatnonzero(good)[np.argsort(stamps[good], kind="stable")]
    used = used[increasing_mask(seconds(stamps[used], stamps[used[0]]))]
    stamps, position, rotation = stamps[used], position[used], rotation[used]
    if columns == 13:
        read = {"matrix": Rotation.from_matrix(rotation)}
    else:
        orders = {"xyzw": [0, 1, 2, 3], "wxyz": [1, 2, 3, 0]}
        read = {name: Rotation.from_quat(rotation[:, order]) for name, order in orders.items()}
    return [_Poses(file, stamps, position, attitude, order) for order, attitude in read.items()]


@dataclass(frozen=True)
class _Fit:
    """Fit of poses to the IMU: times on the IMU's clock, alignment and mount R_PB."""

    poses: _Poses
    time: FloatArray
    aligned: BodyAlignment
    mount: Rotation

    @property
    def turn(self) -> float:
        """Angle between the pose's axes and the IMU's [rad]."""
        return float(self.mount.magnitude())


def _fitted(sequence: ImuSequence, start_ns: np.int64 | int, poses: _Poses) -> _Fit | None:
    time, gyro, accel = clean_samples(sequence)
    pose_time, attitude = seconds(poses.stamps_ns, start_ns), poses.attitude
    valid = np.ones(len(pose_time), dtype=np.bool_)
    try:
        same_clock = bool(pose_time[0] < time[-1] and pose_time[-1] > time[0])
        if same_clock:
            aligned = align_tracked_body(time, gyro, accel, pose_time, attitude, valid)
            agrees = aligned.correlation >= _MIN_CORRELATION
            same_clock = agrees and abs(aligned.lag) <= _SAME_CLOCK_S
        if not same_clock:
            pose_time = pose_time + clock_offset(time, gyro, pose_time, attitude, valid)
            aligned = align_tracked_body(time, gyro, accel, pose_time, attitude, valid)
    except InputError:
        return None
    if aligned.correlation < _MIN_CORRELATION:
        return None
    mount = max(aligned.mounts, key=lambda piece: piece[1] - piece[0])[2]
    square = Rotation.create_group("O")
    away = (square.inv() * mount).magnitude()
    mount = square[int(np.argmin(away))] if away.min() < _SQUARE_RAD else mount
    return _Fit(poses, pose_time, aligned, mount)


def _log_choice(sequence: ImuSequence, fits: list[_Fit], chosen: _Fit) -> None:
    name = chosen.poses.file.name
    _log.info(
        "%s: truth is %s, attitude as %s, %.0f degrees from the IMU's axes, correlation %.3f",
        sequence.name, name, chosen.poses.order, np.degrees(chosen.turn),
        chosen.aligned.correlation,
    )  # fmt: skip
    for other in fits:
        if other.poses.file != chosen.poses.file and other.turn > _SAME_AXES_RAD:
            _log.warning(
                "%s: the ground truth is %s; %s is rotated %.0f degrees from the IMU's axes",
                sequence.name, name, other.poses.file.name, np.degrees(other.turn),
            )  # fmt: skip


def _posed(sequence: ImuSequence, fit: _Fit) -> ImuSequence:
    poses, time = fit.poses, fit.time + fit.aligned.lag
    attitude_PB = poses.attitude * fit.mount
    truth = Trajectory(time, poses.position, attitude_PB, valid=fit.aligned.valid)
    sequence = accel_axes(sequence, truth)
    inside = (sequence.time >= time[0]) & (sequence.time <= time[-1])
    pose = truth.at(np.unique(sequence.time[inside]))
    force = interpolated(pose.time, sequence.time, sequence.accel)
    up = pose.attitude_WB.apply(force)[pose.valid].mean(axis=0)
    if np.linalg.norm(up) < MIN_GRAVITY_FORCE:
        message = "%s: rejected %s: no gravity to level its poses"
        _log.warning(message, sequence.name, poses.file.name)
        return replace(sequence, truth=None)
    if min(up[1:]) < -_DOWN * np.linalg.norm(up):  # worlds have y or z up
        _log.warning("%s: inverted the accelerometer, which has Apple's sign", sequence.name)
        converted = sequence.converted | {"accel", "sign"}
        sequence, up = replace(sequence, accel=-sequence.accel, converted=converted), -up
    R_WP = tilt_aligning(up)
    try:
        truth = replace(
            truth, position_W=R_WP.apply(truth.position_W), attitude_WB=R_WP * truth.attitude_WB
        )
    except InputError as error:
        raise ReadError(poses.file, "poses", str(error), "finite numbers") from None
    return replace(sequence, truth=truth)


def accel_axes(sequence: ImuSequence, truth: Trajectory) -> ImuSequence:
    """Rotate the accelerometer to the gyroscope's axes if it was logged in others.

    Rotated by the true attitude, in a world with y or z up, the specific force averages to gravity.
    If it does not, but does in another right-handed axis order (some phones log it so), that order
    is used, with a warning.
    """
    finite = np.isfinite(sequence.time) & np.isfinite(sequence.accel).all(axis=1)
    times, first = np.unique(sequence.time[finite], return_index=True)
    accel = sequence.accel[finite][first]
    pose = truth.at(times)
    if not pose.valid.any():
        return sequence
    R_WB, force = pose.attitude_WB[pose.valid], accel[pose.valid]
    size = float(np.linalg.norm(force, axis=1).mean())
    turns = Rotation.create_group("O")
    up = np.array([R_WB.apply(turn.apply(force)).mean(axis=0) for turn in turns]) / size
    kept = up[:, 1:].max(axis=1)
    same = int(np.argmin(turns.magnitude()))
    best, second = np.argsort(kept)[[-1, -2]]
    if np.abs(up[same, 1:]).max() > _GRAVITY_KEPT:  # perhaps upside down: Apple's sign
        return sequence
    if kept[best] < max(_GRAVITY_KEPT, kept[same] + _BETTER, kept[second] + _SHARPER):
        return sequence
    R = turns[best]
    _log.warning(
        "%s: the accelerometer's axes are not the gyroscope's: its %s is used as x,y,z",
        sequence.name, axes_named(R.as_matrix()),
    )  # fmt: skip
    return replace(sequence, accel=R.apply(sequence.accel))
