"""Detection of wrong units, missing gravity and the like, before a recording is processed.

One rule holds for every recording, however the device was moved: specific force, rotated into one
frame by the integrated gyroscope, averages to gravity, because a person's velocity stays bounded.
A gyroscope in deg/s rotates it 57 times too far, and the average collapses. A sign that is wrong
for all three axes of the accelerometer cannot be detected that way (both the force and the average
change sign), only against a true attitude; nor can a gyroscope that is 57 times too slow, which
looks like a device held still.
"""

from __future__ import annotations

import math

import numpy as np

from stario.sequences.arrays import check_type
from stario.sequences.attitude.rotations import integrated_gyro
from stario.sequences.clean_samples import clean_samples, unbroken, without_spikes
from stario.sequences.errors import InputError
from stario.sequences.findings import Finding, warn
from stario.sequences.inspection.gyro_axes import check_gyro_axes
from stario.sequences.inspection.samples import LARGE_M_S2, check_not_dead, check_time, limit_words
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, ImuSequence
from stario.sequences.truth.fit import TruthFit, fit_truth
from stario.sequences.truth.positions import fit_positions
from stario.sequences.units import FAST_RAD_S, GYRO_UNITS

MIN_SECONDS = 1.5
"""Shortest recording that holds a window and a margin around it [s]."""

_SHORTEST_S = 0.9
_WINDOW_S = 4.0
_WINDOWS = 12
"""Least and usual length [s] and number of the stretches that are checked, spread over the
recording: the cost does not grow with its length."""

_NO_SENSOR = 1e4
"""Largest median magnitude that a sensor can have, in deg/s, m/s^2 or any unit in between."""

_OFF_GRAVITY = 0.1
"""Relative error of the average force above any calibration error; recordings reach 0.008."""

_SHAKEN_OFF_GRAVITY = 0.35
"""The same for a shaken device, whose sensors saturate; without gravity it is near 1."""

_SATURATED_OFF_GRAVITY = 0.6
"""The same if the accelerometer is at its limit: 2 g cut a runner's steps to 5.9 m/s^2."""

_MIN_LOSS_RATIO = 6.0
"""Factor by which a wrong gyroscope unit reduces the average more than the right one."""

_COHERENT = 0.7
"""Ratio of average to median force below which gravity does not dominate."""

_NO_GRAVITY = 0.3
"""An average force below this has no gravity in any unit: a device at rest, gravity removed."""

_G_RANGE = (0.8, 1.25)
_FORCE_RANGE = (6.4, 12.5)
"""Average force of a recording in g and in m/s^2. Sensors are off by a few percent; in the hand of
a runner they saturate, and the average is as low as 7.4 m/s^2."""

_SUSTAINED_RAD_S, _UNDECIDED, _ABOUT_UP = 3.0, 0.005, 0.8
"""Rate that a twentieth of the samples exceed above which the unit is asked for, if the average
force in both units differs by less than this share of it and at least this share of the rate's
square is about the force: the device turns about the vertical."""

_DOWNWARD = -0.9
"""Cosine between z and the mean force below which a device lies face down, or the sign is wrong."""

_UNIT_NAMED = "its unit is the one named in the file: is that right?"
"""Remedy if `with_units` accepts no other unit."""

_SAMPLES = 10_000
"""Maximum number of samples rotated by the true attitude; more do not improve the average force."""

_SAME_MOTION = 0.5
"""Correlation of accelerations from the positions and the accelerometer that is no accident."""

_TO_Z_UP = "write px,-py,-pz,qw,-qz,qy,-qx as px,py,pz,qx,qy,qz,qw in the file"
"""Remedy for a world with z down: half a turn about its x axis."""

_MAX_TILT_RAD = math.radians(20.0)
"""Largest angle between the vertical and the average force, rotated by the true attitude."""


def check_units(sequence: ImuSequence) -> None:
    """Check that a recording's numbers can be in s, rad/s and m/s^2; log what stays in doubt.

    Raises:
        InputError: as for `unit_findings`.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    warn(sequence.name, unit_findings(sequence))


def unit_findings(sequence: ImuSequence) -> list[Finding]:
    """Check a recording's units, and return what nothing in the file tells.

    These are a gyroscope that turns about the vertical only, fast enough for deg/s, an
    accelerometer that may have Apple's sign, and a sensor that went on without the other.

    Raises:
        InputError: it is too short or holds no number, time is in another unit, a sensor is dead,
            the gyroscope is in deg/s or has other axes or signs than the accelerometer, or that is
            in g, lacks gravity or has the opposite sign (detected only with a true attitude). The
            text names the option that fixes it.
    """
    _check_content(sequence)
    check_time(sequence)
    time, gyro, accel = clean_samples(sequence)
    if time[-1] - time[0] < MIN_SECONDS:
        raise InputError(
            f"{sequence.name}: duration", f"{time[-1] - time[0]:.2f} s", f"at least {MIN_SECONDS} s"
        )
    check_not_dead(sequence.name, time, gyro, accel)
    pieces, found = _pieces(time), list[Finding]()
    if pieces:  # otherwise gaps leave nothing to average over
        fix = _UNIT_NAMED if "gyro" in sequence.converted else _advice(sequence, "gyro", "deg/s")
        force, average, found = check_gyro(sequence.name, time, gyro, accel, pieces, fix)
        saturated = limit_words("accelerometer", accel, "m/s^2", LARGE_M_S2)
        found += _check_force(sequence, force, average, saturated)
        check_gyro_axes(sequence.name, time, gyro, accel, pieces)
    _check_direction(sequence, time, accel)
    if sequence.maybe_apple and sequence.truth is None:
        text = (
            "accelerometer: gravity was logged apart, as Sensor Logger does on iPhones, whose sign "
            "is inverted"
        )
        fix = "if it is from an iPhone, pass `--accel-sign apple`"
        found.append(Finding("apple_sign_open", text, fix, level="note"))
    if alone_s := sequence.alone_s or _alone_s(sequence):
        times = " and ".join(f"only the {name} for {s:.1f} s" for name, s in alone_s.items())
        text = f"samples: found {times}, which are left out"
        fix = "was a file cut short, or did the app start or stop one of them alone?"
        found.append(Finding("sensor_alone", text, fix, values=alone_s))
    if not sequence.source:  # a reader would have told the sign, or asked
        found += downward(accel)
    return found


def _alone_s(sequence: ImuSequence) -> dict[str, float]:
    """Return seconds at either end in which one sensor alone holds numbers, as files of one do."""
    samples = sequence.gyro, sequence.accel
    gyro, accel = (np.flatnonzero(np.isfinite(x).all(axis=1))[[0, -1]] for x in samples)
    longer = (gyro - accel) * [-1, 1]  # the gyroscope at the start and at the end, in samples
    counts = {"gyroscope": longer.clip(min=0), "accelerometer": -longer.clip(max=0)}
    alone_s = {name: float(count.sum()) / sequence.rate for name, count in counts.items()}
    return {name: s for name, s in alone_s.items() if s > _SHORTEST_S}


def downward(accel: FloatArray) -> list[Finding]:
    """Report forces (N, 3) that point along -z on average: a sign that no other check can tell."""
    mean = accel.mean(axis=0)
    if mean[2] >= _DOWNWARD * np.linalg.norm(mean):
        return []
    text = f"accelerometer: found {mean[2]:.1f} m/s^2 along z on average"
    fix = (
        "right for a device face down or axes with z down; if it lay face up, give -accel: "
        "specific force points up at rest"
    )
    return [Finding("downward_open", text, fix, level="note", values={"z_m_s2": float(mean[2])})]


def _advice(sequence: ImuSequence, sensor: str, unit: str) -> str:
    """Return how to convert a sensor that is in another unit, by where its numbers come from."""
    fix = {
        "deg/s": "give np.radians(gyro)",
        "g": f"give {STANDARD_GRAVITY} * accel",
        "mg": f"give {STANDARD_GRAVITY / 1e3} * accel",
        "mdps": "give np.radians(gyro / 1000)",
    }[unit]
    if sequence.source:
        title = f"write `{sensor[0]}x [{unit}]` in the CSV's header"
        fix = f"pass `--{sensor}-unit {unit}` or {title}"
    return f"if it is in {unit}, {fix}"


def _check_content(sequence: ImuSequence) -> None:
    sensors = {"gyro": sequence.gyro, "accel": sequence.accel}
    for field, values in {"time": sequence.time, **sensors}.items():
        if not np.isfinite(values.reshape(len(values), -1)).all(axis=1).any():
            raise InputError(f"{sequence.name}: {field}", "no finite sample", "numbers")
    if len(sequence) < 2:
        raise InputError(f"{sequence.name}: samples", "1", f"at least {MIN_SECONDS} s of them")
    for field, values in sensors.items():
        with np.errstate(over="ignore"):  # single values may be huge: the median ignores them
            size = float(np.nanmedian(np.linalg.norm(values, axis=1)))
        if size > _NO_SENSOR:
            fix = "is another column meant, or is one of them a clock?"
            fix += f" Or {_advice(sequence, field, 'mdps')}" if field == "gyro" else ""
            found = f"{size:.3g} on average"
            raise InputError(f"{sequence.name}: {field}", found, "a plausible sensor value", fix)


def check_gyro(
    name: str, time: FloatArray, gyro: FloatArray, accel: FloatArray, pieces: list[slice], fix: str
) -> tuple[float, float, list[Finding]]:
    """Check the rotations (N, 3) [rad/s] against the accelerometer (N, 3) [m/s^2].

    The force is averaged over unbroken `pieces`. Its median magnitude and that of its average over
    a piece [m/s^2] are returned, and a finding if it cannot tell the gyroscope's unit.

    Raises:
        InputError: the gyroscope cannot be in rad/s; `fix` is what to do if it is in deg/s.
    """
    force = float(np.median(np.linalg.norm(accel, axis=1)))
    if abs(force / STANDARD_GRAVITY - 1.0) > _SHAKEN_OFF_GRAVITY:
        _check_swapped(name, time, gyro, accel, pieces)
    average = _average_force(time, gyro, accel, pieces)
    in_degrees = _average_force(time, gyro * GYRO_UNITS["deg/s"], accel, pieces)
    speed = float(np.percentile(np.linalg.norm(gyro, axis=1), 95))
    # On a swinging arm centripetal acceleration makes samples exceed their average, which is still
    # gravity. So an average that equals gravity, in m/s^2 or g, clears the gyroscope.
    off = min(abs(average / STANDARD_GRAVITY - 1.0), abs(average - 1.0))
    lost, lost_in_degrees = force - average, max(force - in_degrees, 0.0)
    found = f"rotations of {speed:.3g} rad/s"
    if off > _OFF_GRAVITY and lost > max(_OFF_GRAVITY * force, _MIN_LOSS_RATIO * lost_in_degrees):
        found += " that contradict the accelerometer"
    elif speed <= FAST_RAD_S:
        undecided = abs(force - in_degrees - lost) < _UNDECIDED * force
        if not (speed > _SUSTAINED_RAD_S and undecided and fix != _UNIT_NAMED):
            return force, average, []
        up = accel / np.linalg.norm(accel, axis=1, keepdims=True)
        if np.sum(np.sum(gyro * up, axis=1) ** 2) <= _ABOUT_UP * np.sum(gyro**2):
            return force, average, []
        text = (
            f"gyroscope: found rotations of {speed:.3g} rad/s, all about the vertical, of which "
            "the accelerometer tells nothing"
        )
        finding = Finding("gyro_unit_open", text, fix, values={"rate_rad_s": speed})
        return force, average, [finding]
    if speed <= FAST_RAD_S:  # plausible by hand; in deg/s, a stationary device
        fix = "are its axes and signs the accelerometer's? If the device lay still, is it in deg/s?"
    elif fix != _UNIT_NAMED and speed * GYRO_UNITS["deg/s"] > FAST_RAD_S:
        fix = "these are neither rad/s nor deg/s: convert a sensor's counts to one of the two"
    raise InputError(f"{name}: gyroscope", found, "rad/s", fix)


def _check_swapped(
    name: str, time: FloatArray, gyro: FloatArray, accel: FloatArray, pieces: list[slice]
) -> None:
    """Check that the gyroscope's values, rotated by the accelerometer's, do not give gravity."""
    size = float(np.median(np.linalg.norm(gyro, axis=1)))
    average = _average_force(time, accel, gyro, pieces)
    if (
        max(abs(size / STANDARD_GRAVITY - 1.0), abs(average / STANDARD_GRAVITY - 1.0))
        < _SHAKEN_OFF_GRAVITY
    ):
        found = f"values of {size:.3g} that average to gravity"
        fix = "gyroscope and accelerometer are swapped: exchange them"
        raise InputError(f"{name}: gyroscope", found, "rad/s", fix)


def _check_force(
    sequence: ImuSequence, force: float, average: float, saturated: str
) -> list[Finding]:
    field, found = f"{sequence.name}: accelerometer", f"an average of {average:.3g}"
    expected = f"about {STANDARD_GRAVITY:.2f} m/s^2"
    # Shaking makes samples exceed gravity: an average that equals gravity is accepted anyway. In
    # the hand of a runner both sensors saturate, and the average loses a fourth.
    off = abs(average / STANDARD_GRAVITY - 1.0)
    if saturated and _SHAKEN_OFF_GRAVITY < off <= _SATURATED_OFF_GRAVITY:
        return [Finding("accelerometer_limit", f"{saturated}: {found} instead of gravity")]
    gravity = off <= _SHAKEN_OFF_GRAVITY
    if not (gravity or average > _COHERENT * force) or average < _NO_GRAVITY:
        found += f" from samples of {force:.3g}"
        expected = f"specific force with gravity, {expected} on average"
        fix = "record the raw accelerometer: gravity cannot be restored without a true attitude"
        if sequence.truth is not None or sequence.device_attitude is not None:
            fix = "pass `--gravity removed`"
            if not sequence.source:
                fix = "give with_conventions(sequence, gravity='removed')"
        fix = f"if it is linear or user acceleration, {fix}"
    elif any(_G_RANGE[0] <= average / size <= _G_RANGE[1] for size in (1.0, 1e3)):
        unit = "g" if average <= _G_RANGE[1] else "mg"
        fix = _advice(sequence, "accel", unit)
        if sequence.source:
            fix += "; from an iPhone, pass `--accel-sign apple` as well"
        if "accel" in sequence.converted:
            fix = _UNIT_NAMED
    elif not _FORCE_RANGE[0] <= average <= _FORCE_RANGE[1]:
        fix = "convert it to m/s^2 or g, with gravity included"
        if _G_RANGE[0] <= average / STANDARD_GRAVITY**2 <= _G_RANGE[1]:
            fix = "it seems to be in m/s^2 already: omit the unit g"
        if abs(average / STANDARD_GRAVITY - 2.0) < _SHAKEN_OFF_GRAVITY:
            fix = "it is twice gravity: omit `--gravity removed` if the file's force contains it"
    else:
        return []
    raise InputError(field, found, expected, fix)


def _check_direction(sequence: ImuSequence, time: FloatArray, accel: FloatArray) -> None:
    """Check that the true attitude rotates the mean force (N, 3) at `time` (N,) upwards."""
    truth = sequence.truth
    if truth is None or truth.valid.sum() < 2:
        return
    used = without_spikes(accel)
    time, accel = time[used], accel[used]
    step = -(-len(time) // _SAMPLES)
    time, accel = time[::step], accel[::step]
    pose = truth.at(time)
    if not pose.valid.any():
        return
    up = pose.attitude_WB[pose.valid].apply(accel[pose.valid]).mean(axis=0)
    tilt = math.atan2(math.hypot(up[0], up[1]), up[2])
    if tilt < _MAX_TILT_RAD:
        return
    try:
        fit = fit_truth(sequence)
    except InputError:
        fit = None
    remedy = fit and fit.axes_remedy()
    if tilt > math.pi - _MAX_TILT_RAD and remedy is None:
        raise _downward(sequence, fit)
    fix = "omit the truth if it is wrong: it is only needed for error metrics"
    raise InputError(
        f"{sequence.name}: truth's attitude",
        f"an average force {math.degrees(tilt):.0f} degrees off the vertical",
        "quaternion x y z w, body to a world with z up",
        f"the IMU's axes are not the truth's: {remedy}" if remedy else fix,
    )


def _downward(sequence: ImuSequence, fit: TruthFit | None) -> InputError:
    """Return the error for a force that points down under the true attitude.

    The accelerometer has the opposite sign, or the truth's world has z down: its positions' own
    acceleration, or the opposite, is what the accelerometer measures.
    """
    sign = (
        "pass `--accel-sign apple` (leave it out if you did) or write `ax [-m/s^2]` (or `[-g]`) in "
        "the CSV's header"
    )
    sign = _UNIT_NAMED if "sign" in sequence.converted else sign
    fix = f"{sign}; or if the truth's world has z down, {_TO_Z_UP}"
    positions = fit_positions(sequence, fit.time_offset) if fit and fit.consistent else None
    if positions is not None and positions.correlation > _SAME_MOTION:
        return InputError(
            f"{sequence.name}: truth",
            "a world with z down, in which its positions agree with the accelerometer",
            "a world with z up",
            f"{_TO_Z_UP}; only if that is wrong, the accelerometer's sign is: {sign}",
        )
    if positions is not None and positions.correlation < -_SAME_MOTION:
        fix = sign
    return InputError(
        f"{sequence.name}: accelerometer",
        "a force that points down under the true attitude",
        "specific force, which points up at rest",
        fix,
    )


def _pieces(time: FloatArray) -> list[slice]:
    """Return up to 12 stretches of up to 4 s, none shorter than 0.9 s and none across a gap.

    The gyroscope misses rotation within a gap, so samples on both sides have no common frame.
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


def _average_force(
    time: FloatArray, gyro: FloatArray, accel: FloatArray, pieces: list[slice]
) -> float:
    """Return the median over pieces of the magnitude of the mean force [m/s^2].

    The force is averaged in the axes of the first sample of its piece.
    """
    sizes = []
    for piece in pieces:
        R_0B = integrated_gyro(time[piece], gyro[piece])
        sizes.append(np.linalg.norm(R_0B.apply(accel[piece]).mean(axis=0)))
    return float(np.median(sizes))
