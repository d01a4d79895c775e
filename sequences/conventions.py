"""Conventions of a file's numbers, stated by the user: units, axes, with or without gravity."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import check_choice, check_type
from stario.sequences.errors import InputError
from stario.sequences.sequence import (
    STANDARD_GRAVITY,
    DeviceAttitude,
    FloatArray,
    ImuSequence,
    Magnetometer,
    Trajectory,
)
from stario.sequences.units import FAST_RAD_S, unit_named, with_units

log = logging.getLogger(__name__)

GRAVITY = ("included", "removed")
"""Whether the accelerometer's values include gravity; without it they are linear acceleration."""

ACCEL_SIGNS = ("up", "apple")
"""Direction of the accelerometer's values at rest: up (specific force) or down (Apple)."""

SAME_AXES = "x,y,z"


def with_conventions(
    sequence: ImuSequence,
    gyro_unit: str = "rad/s",
    accel_unit: str = "m/s^2",
    axes: str = SAME_AXES,
    gravity: str = "included",
    accel_sign: str = "up",
) -> ImuSequence:
    """Convert a recording to rad/s, specific force in m/s^2 and the axes of its ground truth.

    Args:
        sequence: recording whose numbers follow the conventions in the other arguments.
        gyro_unit: as for `with_units`.
        accel_unit: as for `with_units`.
        axes: as for `with_axes`.
        gravity: one of `GRAVITY`; if "removed", `with_gravity` restores it.
        accel_sign: one of `ACCEL_SIGNS`; "apple" negates all three axes.

    Raises:
        InputError: an argument's value is unknown, a unit is given for numbers already converted
            from the one named in their file, gravity cannot be restored, or the recording has the
            wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    check_choice("gravity", gravity, GRAVITY)
    check_choice("accel_sign", accel_sign, ACCEL_SIGNS)
    if accel_sign == "apple":
        turned = accel_unit.removeprefix("-")
        accel_unit = turned if accel_unit.startswith("-") else f"-{accel_unit}"
    if unit_named(gyro_unit) == "deg/s":
        _warn_if_in_radians(sequence)
    sequence = replace(
        sequence, maybe_apple=sequence.maybe_apple and not accel_unit.startswith("-")
    )
    sequence = with_axes(with_units(sequence, gyro_unit, accel_unit), axes)
    return with_gravity(sequence) if gravity == "removed" else sequence


def _warn_if_in_radians(sequence: ImuSequence) -> None:
    """Warn of deg/s given for rates that are plausible in rad/s, whatever the header says."""
    speeds = np.linalg.norm(sequence.gyro, axis=1)
    speeds = speeds[np.isfinite(speeds)]
    if len(speeds) and (speed := float(np.percentile(speeds, 95))) <= FAST_RAD_S:
        log.warning(
            "%s: its rates, up to %.2g, fit rad/s; --gyro-unit deg/s divides them by 57: omit it "
            "unless the device lay still", sequence.name, speed,
        )  # fmt: skip


def with_axes(sequence: ImuSequence, axes: str) -> ImuSequence:
    """Rotate gyroscope, accelerometer, magnetometer and device attitude to other axes.

    The ground truth is unchanged: this fixes an IMU whose axes are not those whose attitude the
    truth describes. Without a truth, any right-handed axes are fine.

    Args:
        sequence: the recording.
        axes: the new x, y and z in the file's axes: `y,-x,z` makes y the new x and -x the new y.

    Raises:
        InputError: `axes` is not a signed permutation of x, y, z, or is left-handed.
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
        axes=axes_named(R @ axes_matrix(sequence.axes)),
    )


def axes_matrix(axes: str) -> FloatArray:
    """Return the rotation (3, 3) from the file's axes to those described by `axes`.

    Raises:
        InputError: as for `with_axes`.
    """
    check_type("axes", axes, str, "a text such as y,-x,z")
    words = [word.strip().lower().removeprefix("+") for word in axes.split(",")]
    expected = "x, y and z once each, optionally with a minus, such as y,-x,z"
    if sorted(word.removeprefix("-") for word in words) != ["x", "y", "z"]:
        raise InputError("axes", repr(axes), expected)
    R = np.zeros((3, 3))
    for row, word in enumerate(words):
        R[row, "xyz".index(word[-1])] = -1.0 if word[0] == "-" else 1.0
    if np.linalg.det(R) < 0.0:
        raise InputError(
            "axes", f"{axes!r}, left-handed", "right-handed axes", "change the sign of one axis"
        )
    return R


def axes_named(R: FloatArray) -> str:
    """Return the `axes` text of the right-handed axes nearest to a rotation (3, 3)."""
    group = Rotation.create_group("O").as_matrix()
    return permuted(group[int(np.argmax((group * R).sum(axis=(1, 2))))], "xyz")


def permuted(R: FloatArray, names: Sequence[str]) -> str:
    """Return three names in the order and with the signs of a signed permutation (3, 3)."""
    return ",".join(("-" if row.min() < -0.5 else "") + names[np.abs(row).argmax()] for row in R)


def with_gravity(sequence: ImuSequence) -> ImuSequence:
    """Restore specific force from linear acceleration with the recorded attitude.

    f_B = a_B + R_WB^T (0, 0, g). Samples without a known attitude are dropped and their number is
    logged. The attitude is the ground truth's or, without one, the device's own; a track estimated
    from the result depends on it.

    Raises:
        InputError: there is no attitude, or none at the time of any sample.
    """
    field, expected = f"{sequence.name}: gravity", "an attitude to restore gravity with"
    fix = "record the raw accelerometer, or add the attitude: truth with px,py,pz,qx,qy,qz,qw"
    truth = _attitude_of(sequence)
    if truth is None or truth.valid.sum() < 2:
        raise InputError(field, "removed and no truth", expected, fix)
    times, index = np.unique(sequence.time, return_inverse=True)
    finite = np.isfinite(times)
    pose = truth.at(times[finite])
    known = np.zeros(len(times), dtype=np.bool_)
    known[finite] = pose.valid
    kept = known[index]
    if not kept.any():
        raise InputError(field, "removed and no sample with an attitude", expected, fix)
    if not kept.all():
        log.warning(
            "%s: %d of %d samples dropped: gravity cannot be restored without an attitude",
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
    """Return the true poses, or else the device's own attitude as a stationary trajectory."""
    own = sequence.device_attitude
    if sequence.truth is not None or own is None:
        return sequence.truth
    return Trajectory(own.time, np.zeros((len(own), 3)), own.attitude_WB)
