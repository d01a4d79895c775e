"""Joining of a phone's sensors to a recording: common times, gravity, sign, attitude, truth.

The accelerometer is interpolated to the gyroscope's times in their common time span. If its file
lacks gravity and there is a file of gravity, that is added. Apple's accelerometers report the
opposite of specific force, in g: this is determined from the app and system that the folder
indicates (Sensor Logger's `Metadata.csv`), or from the phone's own attitude.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import magnetometer
from stario.sequences.readers.clocks import resample_to_gyro, source_words
from stario.sequences.readers.lines import may_be_read
from stario.sequences.readers.phones.alongside import Recording
from stario.sequences.readers.phones.attitude import device_attitude, logged_attitude
from stario.sequences.readers.phones.barometer_file import recorded_pressure
from stario.sequences.readers.phones.files import NO_SAMPLES, PhoneFiles, app_of
from stario.sequences.readers.phones.known_positions import (
    as_known_positions,
    reference_points,
    reported_positions,
)
from stario.sequences.readers.phones.sensor_table import Samples, SensorTable, read_samples
from stario.sequences.readers.phones.sensor_words import Sensor
from stario.sequences.readers.phones.sign import accel_sign, is_in_g
from stario.sequences.readers.poses import with_pose
from stario.sequences.readers.text import IntArray, seconds
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence, Magnetometer

_log = logging.getLogger(__name__)

_GRAVITY_REMOVED = 5.0
"""Median force [m/s^2] below which gravity was removed."""


def assemble_recording(
    name: str,
    files: PhoneFiles,
    poses: list[Path],
    orders: Collection[str] = ("xyzw", "wxyz", "matrix"),
    core_motion: bool = False,
) -> ImuSequence:
    """Assemble the recording of a set of files.

    Args:
        name: name of the recording.
        files: files by sensor.
        poses: pose files alongside them.
        orders: orders to try for their attitude, as for `with_pose`.
        core_motion: whether an iPhone wrote the files: values in g have Apple's sign.

    Raises:
        ReadError: a file is malformed or the sensors do not overlap in time.
    """
    folder = files.gyro.parent
    for file in files.unread:
        why = f"it has {NO_SAMPLES}" if may_be_read(file) else "no permission"
        _log.warning("%s: not read: %s", file, why)
    gyro = _read(files.tables["gyro"][0], "gyro")
    attitude = logged_attitude(files, gyro)
    accel = _force(files, attitude, core_motion)
    stamps, rate, force = resample_to_gyro(
        folder, gyro.stamps_ns, gyro.values, accel.samples.stamps_ns, accel.samples.values
    )
    converted = {"gyro": gyro.unit not in ("", "rad/s"), **accel.converted}
    recording = Recording(files.gyro, files.key, stamps[0], stamps[-1])
    reported = reported_positions(recording)
    first = next(reported, None)
    sequence = ImuSequence(
        name=name,
        time=seconds(stamps, stamps[0]),
        gyro=rate,
        accel=force,
        converted=frozenset(sensor for sensor, done in converted.items() if done),
        magnetometer=_magnetometer(files, stamps[0], stamps[-1]),
        device_attitude=device_attitude(attitude, stamps[0]),
        barometer=recorded_pressure(recording),
        satellites=first,
        source="" if core_motion else source_words(app_of(files), gyro.assumed_time_unit),
        maybe_apple=accel.maybe_apple,
    )
    sequence = with_pose(sequence, stamps[0], poses, orders)
    if sequence.truth is not None:
        return sequence
    positions = reference_points(recording)
    if positions is None and first is not None:
        tracks = map(as_known_positions, chain([first], reported))
        positions = next((track for track in tracks if track is not None), None)
    return replace(sequence, positions=positions)


def _read(table: SensorTable, sensor: Sensor) -> Samples:
    """Read the columns that the header gives for the sensor, or those of a file that names none."""
    axes = next((key for key in (sensor, "") if key in table.axes), next(iter(table.axes), None))
    if axes is None:
        raise ReadError(table.file, "header", "no x, y and z", f"the axes of the {sensor}")
    return read_samples(table, sensor, axes)


@dataclass(frozen=True)
class _Force:
    """Specific force, which of unit and sign were converted, and whether Apple's sign is left."""

    samples: Samples
    converted: dict[str, bool]
    maybe_apple: bool


def _force(
    files: PhoneFiles, attitude: tuple[IntArray, Rotation] | None, core_motion: bool
) -> _Force:
    """Return the specific force, with gravity added if that was logged apart."""
    candidates = [_read(table, "accel") for table in files.tables.get("accel", [])]
    gravity_table = files.first("gravity")
    gravity = None if gravity_table is None else _read(gravity_table, "gravity")
    total = _with_gravity(candidates, or_g=gravity is None)
    accel = total or (candidates[0] if candidates else _read(files.tables["linear"][0], "linear"))
    in_two_parts = total is None and gravity is not None
    if total is None and gravity is not None:
        stamps, force, gravity_B = resample_to_gyro(
            files.gyro.parent, accel.stamps_ns, accel.values, gravity.stamps_ns, gravity.values,
            ("linear acceleration", "gravity"),
        )  # fmt: skip
        accel = replace(accel, stamps_ns=stamps, values=force + gravity_B)
        _log.info("%s: added gravity from its own columns or file", files.shown)
    in_g = not accel.unit and is_in_g(accel.values)
    sign = -1.0 if in_g and core_motion else accel_sign(files, accel, attitude)
    inverted = sign == -1.0
    factor = -1.0 if inverted else 1.0
    # In g without a sign, `check_units` asks for both unless the caller has given them.
    factor *= STANDARD_GRAVITY if in_g and inverted else 1.0
    return _Force(
        samples=replace(accel, values=factor * accel.values),
        converted={
            "accel": inverted or accel.unit.removeprefix("-") not in ("", "m/s^2"),
            "sign": inverted or accel.unit.startswith("-"),
        },
        maybe_apple=sign is None and in_two_parts and not in_g,
    )


def _with_gravity(candidates: list[Samples], or_g: bool) -> Samples | None:
    """Return the first candidate with gravity in m/s^2, else the steadiest that may be in g."""
    sizes = [np.linalg.norm(candidate.values, axis=1) for candidate in candidates]
    for candidate, size in zip(candidates, sizes, strict=True):
        if float(np.median(size)) >= _GRAVITY_REMOVED:
            return candidate
    shares = [float(np.percentile(size, 10) / max(np.median(size), 1e-9)) for size in sizes]
    maybe = [k for k, candidate in enumerate(candidates) if or_g and is_in_g(candidate.values)]
    return candidates[max(maybe, key=shares.__getitem__)] if maybe else None


def _magnetometer(files: PhoneFiles, start_ns: np.int64, stop_ns: np.int64) -> Magnetometer | None:
    table = files.first("mag")
    if table is None:
        return None
    try:
        samples = _read(table, "mag")
    except ReadError as error:  # the magnetometer is optional
        _log.warning("magnetometer skipped: %s", error)
        return None
    inside = (samples.stamps_ns >= start_ns) & (samples.stamps_ns <= stop_ns)
    if not inside.any():
        _log.warning("magnetometer skipped: none of its samples is within the recording")
        return None
    return magnetometer(seconds(samples.stamps_ns, start_ns), samples.values)
