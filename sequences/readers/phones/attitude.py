"""Attitude logged by a phone's own sensor fusion, and the sign of its accelerometer.

Apps differ in the order of a quaternion and in whether it takes the body to the world or back, so
all variants are compared with the gyroscope: over a step the attitude rotates by R_k^T R_k+1 in the
body's axes.

Accelerometer and gyroscope do not reveal whether the former measures specific force or, as on
Apple's phones, its opposite: a world upside down moves the same way. The phone's own attitude does,
since specific force points up, or the operating system that an app names.
"""

from __future__ import annotations

import csv
import logging
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import integral, interpolated
from stario.sequences.attitude.rotations import NORM_TOLERANCE
from stario.sequences.errors import ReadError
from stario.sequences.readers.clocks import Samples, time_unit
from stario.sequences.readers.phones.files import PhoneFiles
from stario.sequences.readers.text import IntArray, head_lines, seconds
from stario.sequences.sequence import DeviceAttitude, FloatArray
from stario.sequences.time_order import increasing_mask

_ORDERS = ([0, 1, 2, 3], [1, 2, 3, 0])
"""Possible places of x, y, z and w in rows without a header."""

_EXPLAINED = 0.5
"""Share of the gyroscope's rotation that an attitude must explain to be the phone's."""

_MAX_STEP_S = 0.3

_log = logging.getLogger(__name__)

_G_RANGE = (0.7, 1.4)
_STEADY = 0.4
"""With gravity, fewer than a tenth of the samples fall below this share of their median."""

_CORE_MOTION = ("arkit", "arposes", "motarh", "motmagnfull", "devicemotion")
"""Beginnings of names of files that only loggers on iOS write."""

_SURE = 0.7
"""Minimum mean cosine between an attitude's vertical and the force that determines the sign."""


def logged_attitude(files: PhoneFiles, gyro: Samples) -> tuple[IntArray, Rotation] | None:
    """Return times (N,) [ns] and N rotations, body to a world with z up; None if none fits."""
    table = files.first("attitude")
    if table is None or not table.quaternion:
        return None
    try:
        rows = table.head.read([table.clock, *table.quaternion])
        unit_ns = time_unit(table.file, rows.values[:, 0], table.clock.unit)
        stamps = rows.stamps_ns(unit_ns)
    except ReadError:  # attitude is optional
        return None
    return agreeing_attitude(stamps, rows.values[:, 1:], gyro, table.quaternion[0].title != "")


def device_attitude(
    attitude: tuple[IntArray, Rotation] | None, start_ns: np.int64
) -> DeviceAttitude | None:
    """Return an attitude, as the functions here return it, in seconds since a time."""
    return None if attitude is None else DeviceAttitude(seconds(attitude[0], start_ns), attitude[1])


def agreeing_attitude(
    stamps: IntArray, quaternion: FloatArray, gyro: Samples, named: bool = True
) -> tuple[IntArray, Rotation] | None:
    """Return the reading of quaternions (N, 4) that best fits the gyroscope, or None if none fits.

    They are x, y, z and w at times (N,) [ns] on its clock; unless their order is `named`, w, x, y
    and z is tried as well. Those that are not unit quaternions are skipped.
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


def is_in_g(values: FloatArray) -> bool:
    """Return whether an accelerometer's samples (N, 3) have norms of about one: gravity in g."""
    size = np.linalg.norm(values, axis=1)
    low, median = np.percentile(size, [10, 50])
    return bool(_G_RANGE[0] <= median <= _G_RANGE[1] and low > _STEADY * median)


def accel_sign(
    files: PhoneFiles, accel: Samples, attitude: tuple[IntArray, Rotation] | None
) -> float | None:
    """Return 1.0, -1.0 if the accelerometer has Apple's sign, or None if nothing tells.

    `attitude` is the phone's own, as `logged_attitude` returns it.
    """
    sign = _by_attitude(attitude, accel)
    if sign is None:
        sign = _by_system(files.gyro.parent, is_in_g(accel.values))
    if sign is None and accel.unit == "g" and _has_core_motion(files):
        sign = -1.0
    if sign == -1.0:
        _log.info("%s: inverted the accelerometer, which has Apple's sign", files.shown)
    return sign


def _by_system(folder: Path, in_g: bool) -> float | None:
    """Return the sign by the system that an app or its files indicate; None if neither does.

    Sensor Logger's `Metadata.csv` names it: iOS has Apple's sign unless the app standardised it.
    SensLogs writes `record.properties` on Android, `description.txt` on iOS; files of ARKit and of
    Core Motion come from iOS and have Apple's sign if they are in g.
    """
    names = {file.name.lower(): file for file in sorted(folder.glob("*"))}
    if "metadata.csv" in names:
        return _by_metadata(names["metadata.csv"])
    if "record.properties" in names:
        return 1.0
    if "BootTime" in "".join(head_lines(names.get("description.txt", folder))):
        return -1.0
    from_apple = any(name.startswith(_CORE_MOTION) for name in names)
    return -1.0 if from_apple and in_g else None


def _by_metadata(file: Path) -> float | None:
    lines = [line for line in head_lines(file) if line.strip()][:2]
    if len(lines) < 2:
        return None
    titles, cells = ([c.strip().lower() for c in row] for row in csv.reader(lines))
    fields = dict(zip(titles, cells, strict=False))
    system = fields.get("platform", "") or fields.get("device name", "")
    if not any(word in system for word in ("ios", "iphone", "ipad")):
        return 1.0 if system else None
    return 1.0 if fields.get("standardisation", fields.get("standardization")) == "true" else -1.0


def _has_core_motion(files: PhoneFiles) -> bool:
    """Return whether a wide file has columns that apps name after Apple's Core Motion."""
    titles = [
        place.title.lower() for axes in files.tables["gyro"][0].axes.values() for place in axes
    ]
    return any(title.startswith(("motion", "accelerometeracceleration")) for title in titles)


def _by_attitude(attitude: tuple[IntArray, Rotation] | None, accel: Samples) -> float | None:
    """Return the sign of the mean cosine between an attitude's vertical and the force, or None."""
    if attitude is None:
        return None
    stamps_ns, attitude_WB = attitude
    inside = (accel.stamps_ns >= stamps_ns[0]) & (accel.stamps_ns <= stamps_ns[-1])
    if inside.sum() < 2:
        return None
    up_B = attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
    time, clock = (seconds(ns, stamps_ns[0]) for ns in (accel.stamps_ns[inside], stamps_ns))
    vertical = interpolated(time, clock, up_B)
    force = accel.values[inside]
    sizes = np.linalg.norm(vertical, axis=1) * np.linalg.norm(force, axis=1)
    cosine = float(np.mean(np.sum(vertical * force, axis=1) / np.maximum(sizes, 1e-9)))
    return float(np.sign(cosine)) if abs(cosine) > _SURE else None
