"""What a file's numbers mean, told by its owner: units, axes, and whether gravity is in them."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import InputError
from stario.sequences.sequence import (
    STANDARD_GRAVITY,
    DeviceAttitude,
    FloatArray,
    ImuSequence,
    Magnetometer,
    Trajectory,
)
from stario.sequences.units import with_units

log = logging.getLogger(__name__)

GRAVITY = ("included", "removed")
"""Whether the accelerometer's numbers hold gravity; without it they are linear acceleration."""

ACCEL_SIGNS = ("up", "apple")
"""Where the accelerometer points at rest: up, as specific force does, or down, as Apple's."""

SAME_AXES = "x,y,z"


def with_conventions(
    sequence: ImuSequence,
    gyro_unit: str = "rad/s",
    accel_unit: str = "m/s^2",
    axes: str = SAME_AXES,
    gravity: str = "included",
    accel_sign: str = "up",
) -> ImuSequence:
    """The recording in rad/s, m/s^2 of specific force and the axes of its truth.

    Args:
        sequence: a recording whose numbers are as the other arguments say.
        gyro_unit: as for `with_units`.
        accel_unit: as for `with_units`.
        axes: as for `with_axes`.
        gravity: one of `GRAVITY`; "removed" is put back by `with_gravity`.
        accel_sign: one of `ACCEL_SIGNS`; "apple" turns all three axes over.

    Raises:
        InputError: an argument is unknown, a unit is given for numbers that were converted from
            the one their file names, or gravity cannot be put back.
    """
    if gravity not in GRAVITY:
        raise InputError("gravity", repr(gravity), f"one of {', '.join(GRAVITY)}")
    if accel_sign not in ACCEL_SIGNS:
        raise InputError("accel_sign", repr(accel_sign), f"one of {', '.join(ACCEL_SIGNS)}")
    if accel_sign == "apple":
        turned = accel_unit.removeprefix("-")
        accel_unit = turned if accel_unit.startswith("-") else f"-{accel_unit}"
    sequence = with_axes(with_units(sequence, gyro_unit, accel_unit), axes)
    return with_gravity(sequence) if gravity == "removed" else sequence


def with_axes(sequence: ImuSequence, axes: str) -> ImuSequence:
    """The recording with gyroscope, accelerometer and magnetometer turned to other axes.

    The truth stays as it is: this mends an IMU whose axes are not those whose attitude the truth
    gives. Where there is no truth, any right-handed axes do.

    Args:
        sequence: the recording.
        axes: what the new x, y and z are in the file's axes: `y,-x,z` takes y for x, -x for y.

    Raises:
        InputError: not a permutation of x, y, z with signs, or a left-handed one.
    """
    if axes == SAME_AXES:
        return sequence
    R = axes_matrix(axes)
    field, own = sequence.magnetometer, sequence.device_attitude
    turn = Rotation.from_matrix(R)
    return replace(
        sequence,
        gyro=sequence.gyro @ R.T,
        accel=sequence.accel @ R.T,
        magnetometer=None if field is None else Magnetometer(field.time, field.field @ R.T),
        device_attitude=(
            None if own is None else DeviceAttitude(own.time, own.attitude_WB * turn.inv())
        ),
    )


def axes_matrix(axes: str) -> FloatArray:
    """The rotation (3, 3) from the file's axes to those that `axes` names.

    Raises:
        InputError: as for `with_axes`.
    """
    words = [word.strip().lower().removeprefix("+") for word in axes.split(",")]
    expected = "x, y and z once each, with signs, such as y,-x,z"
    if sorted(word.removeprefix("-") for word in words) != ["x", "y", "z"]:
        raise InputError("axes", repr(axes), expected)
    R = np.zeros((3, 3))
    for row, word in enumerate(words):
        R[row, "xyz".index(word[-1])] = -1.0 if word[0] == "-" else 1.0
    if np.linalg.det(R) < 0.0:
        raise InputError(
            "axes", f"{axes!r}, left-handed", "right-handed axes", "turn one sign over"
        )
    return R


def axes_named(R: FloatArray) -> str:
    """The text that `axes_matrix` turns into the right-handed axes nearest to a rotation (3, 3)."""
    group = Rotation.create_group("O").as_matrix()
    best = group[int(np.argmax((group * R).sum(axis=(1, 2))))]
    return ",".join(("-" if row.min() < -0.5 else "") + "xyz"[np.abs(row).argmax()] for row in best)


def with_gravity(sequence: ImuSequence) -> ImuSequence:
    """Specific force from linear acceleration: gravity put back by the recording's attitude.

    f_B = a_B + R_WB^T (0, 0, g). Samples whose attitude is not known are dropped and their number
    is logged. The attitude is the truth's or, without one, the device's own: the track of a
    recording mended so rests on it.

    Raises:
        InputError: there is no truth, or it gives no sample's attitude.
    """
    found = "removed"
    fix = "record the raw accelerometer, or give the attitude: truth with px,py,pz,qx,qy,qz,qw"
    expected = "an attitude that says where gravity was"
    truth = _attitude_of(sequence)
    if truth is None or truth.valid.sum() < 2:
        raise InputError(f"{sequence.name}: gravity", f"{found} and no truth", expected, fix)
    times, index = np.unique(sequence.time, return_inverse=True)
    finite = np.isfinite(times)
    pose = truth.at(times[finite])
    known = np.zeros(len(times), dtype=np.bool_)
    known[finite] = pose.valid
    kept = known[index]
    if not kept.any():
        raise InputError(
            f"{sequence.name}: gravity", f"{found} and no attitude at any sample", expected, fix
        )
    if not kept.all():
        log.warning(
            "%s: %d of %d samples dropped: no attitude puts gravity back there",
            sequence.name, len(kept) - kept.sum(), len(kept),
        )  # fmt: skip
    R_WB = pose.attitude_WB[index[kept]]
    gravity_B = R_WB.apply([0.0, 0.0, STANDARD_GRAVITY], inverse=True)
    return replace(
        sequence,
        time=sequence.time[kept],
        gyro=sequence.gyro[kept],
        accel=sequence.accel[kept] + gravity_B,
    )


def _attitude_of(sequence: ImuSequence) -> Trajectory | None:
    """The true poses, or the device's own attitude as a track that stands still."""
    own = sequence.device_attitude
    if sequence.truth is not None or own is None:
        return sequence.truth
    return Trajectory(own.time, np.zeros((len(own), 3)), own.attitude_WB)
