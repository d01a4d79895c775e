"""Wrong units, missing gravity and the like, found in the numbers before anything runs on them.

What a recording must obey whatever was done with the device: specific force, turned into one
frame by the integrated gyroscope, averages to gravity, because a person's velocity stays bounded.
A gyroscope in deg/s turns it 57 times too far, and the average falls apart. A sign that is wrong
for all three axes of the accelerometer cannot be seen that way (both the force and the average
change sign), only against a true attitude; nor can a gyroscope that is 57 times too slow, which
looks like a device held still.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.attitude.rotations import cumulative_rotations
from stario.sequences.errors import InputError
from stario.sequences.inspection.samples import dead_gyro, disorder
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, ImuSequence
from stario.sequences.truth.fit import fit_truth
from stario.sequences.units import GYRO_UNITS, TIME_UNITS
from stario.sequences.windows import MAX_RATE, MIN_RATE, clean_samples, unbroken

MIN_SECONDS = 1.5
"""Shortest recording that holds a window and something around it [s]."""

_SHORTEST_S = 0.9
_WINDOW_S = 4.0
_WINDOWS = 12
"""Length, least and usual [s], and number of the stretches that are looked at, spread over the
recording: the cost does not grow with it."""

_NO_SENSOR = 1e4
"""Larger on average is no sensor's, in deg/s, m/s^2 or any unit between."""

_FAST_RAD_S = 15.0
"""Nobody turns a device faster for a twentieth of the time; the fastest recorded is 2.7 rad/s,
the slowest one read as deg/s 41."""

_OFF_GRAVITY = 0.1
"""Relative error of the average force that no calibration leaves; recorded are 0.008 at most."""

_SHAKEN_OFF_GRAVITY = 0.25
"""The same of a device that is shaken, whose sensors saturate; without gravity it is near 1."""

_APART_RATIO = 6.0
"""Factor by which a wrong turning takes more from the average than the right one does."""

_COHERENT = 0.7
"""A force that keeps less of its size in its average is not dominated by gravity."""

_NO_GRAVITY = 0.3
"""A smaller average force holds gravity in no unit: a device at rest whose gravity was removed."""

_G_RANGE = (0.8, 1.25)
_FORCE_RANGE = (7.5, 12.5)
"""Average force of a recording in g and in m/s^2: sensors are off by a few percent, not by 25."""

_UNIT_NAMED = "its unit is the one that the file names: is that right?"
"""Where `with_units` takes no other."""

_SAMPLES = 10_000
"""That are turned by the true attitude: more say nothing more of the average force."""

_MAX_TILT_RAD = math.radians(20.0)
"""Largest angle between the average force, turned by the true attitude, and the vertical."""


def check_units(sequence: ImuSequence) -> None:
    """Refuse a recording whose numbers cannot be in s, rad/s and m/s^2.

    Raises:
        InputError: it is too short or holds no number, time is in another unit, the gyroscope is
            dead or in deg/s, the accelerometer is in g, lacks gravity or has its sign turned
            (known only where there is a true attitude). The text names the option that mends it.
    """
    _check_content(sequence)
    _check_time(sequence)
    time, gyro, accel = clean_samples(sequence)
    if time[-1] - time[0] < MIN_SECONDS:
        raise InputError(
            f"{sequence.name}: duration", f"{time[-1] - time[0]:.2f} s", f"at least {MIN_SECONDS} s"
        )
    if dead_gyro(time, gyro, accel):
        raise InputError(
            f"{sequence.name}: gyroscope", "values that never change while the accelerometer moves",
            "angular rates", "is another column meant?",
        )  # fmt: skip
    pieces = _pieces(time)
    if pieces:  # else the gaps leave nothing to average over
        force = float(np.median(np.linalg.norm(accel, axis=1)))
        average = average_force(time, gyro, accel, pieces)
        in_degrees = average_force(time, gyro * GYRO_UNITS["deg/s"], accel, pieces)
        known = "gyro" in sequence.converted
        check_gyro(sequence.name, gyro, force, average, in_degrees, known)
        _check_force(sequence, force, average)
    _check_direction(sequence, time, accel)


def _check_content(sequence: ImuSequence) -> None:
    for field, values in (
        ("time", sequence.time),
        ("gyro", sequence.gyro),
        ("accel", sequence.accel),
    ):
        if not np.isfinite(values.reshape(len(values), -1)).all(axis=1).any():
            raise InputError(f"{sequence.name}: {field}", "no finite sample", "numbers")
    if len(sequence) < 2:
        raise InputError(f"{sequence.name}: samples", "1", f"at least {MIN_SECONDS} s of them")
    for field, values in (("gyro", sequence.gyro), ("accel", sequence.accel)):
        size = float(np.nanmedian(np.linalg.norm(values, axis=1)))
        if size > _NO_SENSOR:
            raise InputError(
                f"{sequence.name}: {field}", f"{size:.3g} on average", "what a sensor can give",
                "is another column meant, or a clock among them?",
            )  # fmt: skip


def _check_time(sequence: ImuSequence) -> None:
    if found := disorder(sequence.time):
        raise InputError(
            f"{sequence.name}: time", found, "times that go on", "sort the rows by time"
        )
    rate = sequence.rate
    if MIN_RATE <= rate <= MAX_RATE:
        return
    fix = "set the app to 50 Hz or more" if 1.0 <= rate < MIN_RATE else ""
    for unit, per_second in TIME_UNITS.items():
        if rate and unit != "s" and MIN_RATE <= rate * per_second <= MAX_RATE:
            fix = f"time seems to be in {unit}: write `t [{unit}]` in the CSV's header"
        if rate and unit != "s" and MIN_RATE <= rate / per_second <= MAX_RATE:
            fix = "time seems to be in seconds already: write `t [s]` in the CSV's header"
    raise InputError(f"{sequence.name}: time", f"{rate:.4g} samples/s", "50 to 1000", fix)


def check_gyro(
    name: str,
    gyro: FloatArray,
    force: float,
    average: float,
    in_degrees: float,
    unit_known: bool = False,
) -> None:
    """Refuse a gyroscope whose turns the accelerometer contradicts.

    Args:
        name: of the recording.
        gyro: (N, 3) [rad/s].
        force: median size of the specific force [m/s^2].
        average: `average_force` of it [m/s^2].
        in_degrees: the same with the gyroscope read as deg/s.
        unit_known: from the file, which takes no option then.

    Raises:
        InputError: it cannot be in rad/s.
    """
    speed = float(np.percentile(np.linalg.norm(gyro, axis=1), 95))
    # A swinging arm presses the device outward: its samples exceed their average, which is
    # gravity all the same. So an average that is gravity, in either unit, clears the gyroscope.
    off = min(abs(average / STANDARD_GRAVITY - 1.0), abs(average - 1.0))
    lost, lost_in_degrees = force - average, max(force - in_degrees, 0.0)
    seen = f"turns of {speed:.3g} rad/s"
    if off > _OFF_GRAVITY and lost > max(_OFF_GRAVITY * force, _APART_RATIO * lost_in_degrees):
        seen += " that the accelerometer does not see"
    elif speed <= _FAST_RAD_S:
        return
    fix = "if it is in deg/s, pass `--gyro-unit deg/s` or write `gx [deg/s]` in the CSV's header"
    if speed <= _FAST_RAD_S:  # as fast as a hand turns it; in deg/s a device that lies still
        fix = "are its axes and signs the accelerometer's? If the device lay still, is it in deg/s?"
    elif unit_known:
        fix = _UNIT_NAMED
    raise InputError(f"{name}: gyroscope", seen, "rad/s", fix)


def _check_force(sequence: ImuSequence, force: float, average: float) -> None:
    field = f"{sequence.name}: accelerometer"
    # A device that is shaken presses harder than it weighs: an average that is gravity clears it.
    # In a running hand the gyroscope saturates now and then, and the average loses a fifth.
    gravity = abs(average / STANDARD_GRAVITY - 1.0) <= _SHAKEN_OFF_GRAVITY
    if not (gravity or average > _COHERENT * force) or average < _NO_GRAVITY:
        raise InputError(
            field,
            f"an average of {average:.3g} in samples of {force:.3g}",
            f"specific force with gravity, about {STANDARD_GRAVITY:.2f} m/s^2 on average",
            "if it is linear or user acceleration, "
            + (
                "record the raw accelerometer: gravity cannot be put back without a true attitude"
                if sequence.truth is None
                else "pass `--gravity removed`"
            ),
        )
    if _G_RANGE[0] <= average <= _G_RANGE[1]:
        raise InputError(
            field,
            f"an average of {average:.3g}",
            f"about {STANDARD_GRAVITY:.2f} m/s^2",
            _UNIT_NAMED
            if "accel" in sequence.converted
            else "if it is in g, pass `--accel-unit g` (and `--accel-sign apple` if an iPhone "
            "wrote it) or write `ax [g]` in the CSV's header",
        )
    if not _FORCE_RANGE[0] <= average <= _FORCE_RANGE[1]:
        raise InputError(
            field,
            f"an average of {average:.3g}",
            f"about {STANDARD_GRAVITY:.2f} m/s^2",
            "bring it to m/s^2 or g, with gravity left in",
        )


def _check_direction(sequence: ImuSequence, time: FloatArray, accel: FloatArray) -> None:
    """The true attitude must turn the average force (N, 3) at `time` (N,) upright."""
    truth = sequence.truth
    if truth is None or truth.valid.sum() < 2:
        return
    step = -(-len(time) // _SAMPLES)
    time, accel = time[::step], accel[::step]
    pose = truth.at(time)
    if not pose.valid.any():
        return
    up = pose.attitude_WB[pose.valid].apply(accel[pose.valid]).mean(axis=0)
    tilt = math.atan2(math.hypot(up[0], up[1]), up[2])
    if tilt < _MAX_TILT_RAD:
        return
    axes = _axes(sequence)
    if tilt > math.pi - _MAX_TILT_RAD and axes is None:
        raise InputError(
            f"{sequence.name}: accelerometer",
            "a force that points down in the true attitude",
            "specific force: up at rest",
            _UNIT_NAMED
            if "accel" in sequence.converted
            else "pass `--accel-unit=-m/s^2` (or -g) or write `ax [-m/s^2]` in the CSV's header",
        )
    raise InputError(
        f"{sequence.name}: truth's attitude",
        f"an average force {math.degrees(tilt):.0f} degrees off the vertical",
        "quaternion x y z w, body to a world with z up",
        f"the IMU's axes are not the truth's: pass `--axes={axes}`"
        if axes
        else "leave the truth out if it is wrong: nothing but the figures needs it",
    )


def _axes(sequence: ImuSequence) -> str | None:
    """The `--axes` that gyroscope and true attitude ask for, None if none."""
    try:
        return fit_truth(sequence).axes()
    except InputError:
        return None


def _pieces(time: FloatArray) -> list[slice]:
    """Up to 12 stretches of up to 4 s, none shorter than one and none across a gap.

    Across a gap the gyroscope has not seen the turning, and nothing can be brought to one frame.
    """
    length = round(_WINDOW_S / float(np.median(np.diff(time))))
    pieces = []
    for start, stop in unbroken(time):
        size = min(length, stop - start)
        for first in np.linspace(start, stop - size, (stop - start) // size).astype(int):
            if time[first + size - 1] - time[first] >= _SHORTEST_S:
                pieces.append(slice(first, first + size))
    chosen = np.linspace(0, len(pieces) - 1, min(_WINDOWS, len(pieces))).astype(int)
    return [pieces[k] for k in chosen]


def average_force(
    time: FloatArray, gyro: FloatArray, accel: FloatArray, pieces: list[slice]
) -> float:
    """Size [m/s^2] of a piece's force averaged in the frame of its first sample; the median."""
    sizes = []
    for piece in pieces:
        dt = np.diff(time[piece])[:, None]
        turns = Rotation.from_rotvec(0.5 * dt * (gyro[piece][1:] + gyro[piece][:-1]))
        R_0B = Rotation.from_quat(cumulative_rotations(turns))
        sizes.append(np.linalg.norm(R_0B.apply(accel[piece]).mean(axis=0)))
    return float(np.median(sizes))
