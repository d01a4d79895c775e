"""Attitude logged by a phone's own sensor fusion.

Apps differ in the order of a quaternion and in whether it takes the body to the world or back, so
all variants are compared with the gyroscope: over a step the attitude rotates by R_k^T R_k+1 in the
body's axes.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import integral, interpolated
from stario.sequences.attitude.rotations import NORM_TOLERANCE
from stario.sequences.errors import ReadError
from stario.sequences.readers.phones.files import PhoneFiles
from stario.sequences.readers.phones.sensor_table import Samples, read_quaternion
from stario.sequences.readers.text import IntArray, seconds
from stario.sequences.sequence import DeviceAttitude, FloatArray
from stario.sequences.time_order import increasing_mask

_ORDERS = ([0, 1, 2, 3], [1, 2, 3, 0])
"""Possible places of x, y, z and w in rows without a header."""

_EXPLAINED = 0.5
"""Share of the gyroscope's rotation that an attitude must explain to be the phone's."""

_MAX_STEP_S = 0.3


def logged_attitude(files: PhoneFiles, gyro: Samples) -> tuple[IntArray, Rotation] | None:
    """Return times (N,) [ns] and N rotations, body to a world with z up; None if none fits."""
    table = files.first("attitude")
    if table is None or not table.quaternion:
        return None
    try:
        stamps, quaternion = read_quaternion(table)
    except ReadError:  # attitude is optional
        return None
    return agreeing_attitude(stamps, quaternion, gyro, table.quaternion[0].title != "")


def device_attitude(
    attitude: tuple[IntArray, Rotation] | None, start_ns: np.int64
) -> DeviceAttitude | None:
    """Return an attitude, as the functions here return it, in seconds since a time."""
    return None if attitude is None else DeviceAttitude(seconds(attitude[0], start_ns), attitude[1])


def agreeing_attitude(
    stamps: IntArray, quaternion: FloatArray, gyro: Samples, named: bool = True
) -> tuple[IntArray, Rotation] | None:
    """Return the reading of an attitude that best fits the gyroscope, or None if none fits.

    Args:
        stamps: (N,) times [ns].
        quaternion: (N, 4) x, y, z and w; rows that are not unit quaternions are skipped.
        gyro: gyroscope samples, on the same clock.
        named: whether the order is known; otherwise w, x, y and z is tried as well.

    Returns:
        Time stamps (K,) [ns] and K rotations, body to a world with z up.
    """
    good = np.abs(np.linalg.norm(quaternion, axis=1) - 1.0) < NORM_TOLERANCE
    stamps, quaternion = stamps[good], quaternion[good]
    kept = increasing_mask(stamps.astype(np.float64))
    stamps, quaternion = stamps[kept], quaternion[kept]
    if len(stamps) < 2:
        return None
    orders = _ORDERS[:1] if named else _ORDERS
    variants = [Rotation.from_quat(quaternion[:, order]) for order in orders]
    variants += [variant.inv() for variant in variants]
    shares = [_explained(stamps, variant, gyro) for variant in variants]
    best = int(np.argmax(shares))
    return (stamps, variants[best]) if shares[best] > _EXPLAINED else None


def _explained(stamps_ns: IntArray, attitude_WB: Rotation, gyro: Samples) -> float:
    """Return the share of the gyroscope's rotation that an attitude's steps explain, by medians.

    A phone's attitude occasionally jumps when its fusion revises its magnetic field estimate.
    """
    order = np.unique(gyro.stamps_ns, return_index=True)[1]
    clock = seconds(gyro.stamps_ns[order], stamps_ns[0])
    time = seconds(stamps_ns, stamps_ns[0])
    turned = interpolated(time, clock, integral(clock, gyro.values[order]))
    logged = (attitude_WB[:-1].inv() * attitude_WB[1:]).as_rotvec()
    inside = (time[:-1] >= clock[0]) & (time[1:] <= clock[-1]) & (np.diff(time) < _MAX_STEP_S)
    if not inside.any():
        return 0.0
    measured = np.diff(turned, axis=0)[inside]
    size, left = (
        float(np.median(np.linalg.norm(steps, axis=1)))
        for steps in (measured, logged[inside] - measured)
    )
    return 1.0 - left / size if size > 0.0 else 0.0
