"""Samples that are invalid by themselves: order, rate, unit and rounding of times; values.

Values that repeat exactly although the device moves are those of a sensor or axis that stopped or
is broken. Data simulated in a plane have constant axes too. So an axis of the gyroscope counts as
dead only if the rates about both others vary, and one of the accelerometer only if the gyroscope
turns gravity into it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import runs, scatter
from stario.sequences.auxiliary import Timed
from stario.sequences.clean_samples import MAX_RATE, MIN_RATE, SHARED_TIMES, usable
from stario.sequences.errors import InputError
from stario.sequences.findings import Finding
from stario.sequences.sequence import STANDARD_GRAVITY, BoolArray, FloatArray, ImuSequence
from stario.sequences.time_order import ahead_mask, disorder, hour_advice, increasing_mask
from stario.sequences.units import TIME_UNITS

_SET_BACK = 5.0
"""Late samples that are late by more than this [s] come from a clock that was set back."""

_LATE_SECONDS = 0.5
"""Duration of late samples in a row [s] beyond which to report them; a few late ones do no harm."""

_LARGE_RAD_S, LARGE_M_S2 = 3.0, 15.0
"""Smallest maxima taken for a limit: below them, repeated values are coarsely rounded ones."""

_TOP, _NEAR, _BELOW = 99.9, 0.95, 0.9
"""Percentile that stands for a limit with noise, and shares of it that bound two bands below it."""

_PILED_SHARE, _PILED = 0.02, 4.0
"""Share of samples in the upper band, and its ratio to that in the lower one, that show a limit.

Of 427 axes of recordings that reach 15 m/s^2 or 3 rad/s, the seven with both are runners' phones
whose accelerometers end at 2 g; a sine has a ratio of 2.4."""

_INSIDE = 0.25
"""Share of another sensor's samples or of known positions during the IMU's below which its clock is
another. Surveys list waypoints before and after a recording too: six in ten of one in 269."""

_CLOCKS = {
    "magnetometer": "field",
    "barometer": "pressure",
    "satellites": "satellites",
    "positions": "positions",
}
"""Parts that have times of their own, and what the codes of their findings begin with."""

_MIN_LIMIT_SHARE, _MIN_LIMIT_COUNT = 0.005, 3
"""Minimum share and number of samples at the limit for a report."""

_STUCK_S = 1.0
"""Time [s] for which a stuck sensor's values repeat exactly; those of others repeat for 0.1 s."""

_SHAKEN_M_S2 = 0.5
_TILTING_RAD_S = 0.1
"""Scatter of the force, and of the rate that turns it in the device's axes, above which a device
moves."""

_VARIES_RAD_S = 0.01
"""Scatter of a rate above which it varies: far above rounding, below any hand or vehicle."""

_REMEDY = "is another column meant, or is the sensor broken?"


def sample_findings(sequence: ImuSequence) -> list[Finding]:
    """Return findings about the samples; `disorder` reports rows out of order."""
    found = _late(sequence)
    values = np.column_stack([sequence.gyro, sequence.accel])
    invalid = int((np.isfinite(values).all(axis=1) & ~usable(sequence)).sum())
    if invalid:
        count = "1 sample" if invalid == 1 else f"{invalid} samples"
        text = f"values that no sensor can measure, in {count}"
        found.append(Finding("values_impossible", text, values={"samples": invalid}))
    given = usable(sequence) & np.isfinite(sequence.time)
    samples = sequence.time[given], sequence.gyro[given], sequence.accel[given]
    found += stuck_findings(*samples)
    fix = "choose a larger range of the sensor, if the logger offers one"
    for sensor, of_all, unit, large in (
        ("gyroscope", sequence.gyro, "rad/s", _LARGE_RAD_S),
        ("accelerometer", sequence.accel, "m/s^2", LARGE_M_S2),
    ):  # as streams do (`fusion.imu.faults`)
        if words := limit_words(sensor, of_all[usable(sequence)], unit, large):
            found.append(Finding(f"{sensor}_limit", words, fix))
    return found


def _late(sequence: ImuSequence) -> list[Finding]:
    """Report the longest run of late samples, as the health of a run does, or else a lost hour."""
    time = sequence.time[np.isfinite(sequence.time)]
    if not len(time) or disorder(time):
        return []
    newest = np.maximum.accumulate(time)
    late = [(float(time[b - 1] - time[a]), a) for a, b in runs(time < newest)]
    seconds, first = max(late, default=(0.0, 0))
    if seconds < _LATE_SECONDS:
        steps = np.diff(time, append=time[-1])
        first = int(np.argmax(steps))
        by, at = float(steps[first]), float(time[first] - time[0])
        text = f"time: the clock jumps ahead by {by:.4g} s at {at:.1f} s"
        values = {"by_s": by, "at_s": at}
        advice = hour_advice(by)  # of the code by which a run tells of gaps: told once
        return [Finding("gaps", text, advice, values=values)] if advice else []
    by, at = float(newest[first] - time[first]), float(time[first - 1] - time[0])
    code, text = "clock_set_back", f"time: the clock jumps back by {by:.4g} s at {at:.1f} s"
    if by <= _SET_BACK:
        code = "samples_late"
        text = (
            f"time: samples come late for {seconds:.1f} s in a row after {at:.1f} s: logged twice, "
            f"or from a clock that was set back by {by:.3g} s; if so, that time is missing"
        )
    values = {"by_s": by, "at_s": at, "longest_s": seconds}
    return [Finding(code, text, hour_advice(by) or "split the recording there", values=values)]


def limit_words(sensor: str, values: FloatArray, unit: str, large: float) -> str:
    """Return how many samples (N, 3) are at the sensor's limit, in words; empty if hardly any are.

    At a limit above `large`, values repeat at the largest magnitude of an axis; or, if they were
    interpolated or have noise added, they are much more frequent near it than a little below.
    """
    size = np.abs(values)
    largest = size.max(axis=0, initial=0.0)
    at_limit = (values[1:] == values[:-1]) & (size[1:] >= largest) & (largest > large)
    if not at_limit.any() and len(size):
        top = np.percentile(size, _TOP, axis=0)
        near, below = size >= _NEAR * top, (size >= _BELOW * top) & (size < _NEAR * top)
        share = near.mean(axis=0)
        piled = (top > large) & (share > _PILED_SHARE) & (share > _PILED * below.mean(axis=0))
        at_limit, largest = near & piled, top
    count = int(at_limit.any(axis=1).sum())
    share_lost = count / max(len(at_limit), 1)
    if share_lost < _MIN_LIMIT_SHARE or count < _MIN_LIMIT_COUNT:
        return ""
    limit = float(largest[at_limit.any(axis=0)].max())
    return (
        f"{sensor}: {share_lost:.1%} of its samples are at its limit of {limit:.3g} {unit}: "
        "stronger motion was not recorded"
    )


def without_times_ahead(sequence: ImuSequence) -> ImuSequence:
    """Return the recording without the samples whose times are ahead of those after them.

    One wild time would otherwise count as a gap of years and as a clock that is set back. Rows out
    of order are kept, for `disorder` to report.
    """
    given = np.flatnonzero(np.isfinite(sequence.time))
    time = sequence.time[given]
    ahead = ahead_mask(time, increasing_mask(time))
    if not ahead.any() or disorder(time):
        return sequence
    keep = np.ones(len(sequence), dtype=np.bool_)
    keep[given[ahead]] = False
    return sequence.select(keep)


def check_time(sequence: ImuSequence) -> None:
    """Check order, rate and unit of a recording's times.

    Raises:
        InputError: they are out of order, or there are not 50 to 1000 different ones a second.
    """
    field, each = f"{sequence.name}: time", "a time for each sample"
    if found := disorder(sequence.time):
        raise InputError(field, found, "increasing times", "sort the rows by time")
    rate = sequence.rate
    if MIN_RATE <= rate <= MAX_RATE:
        return
    times = sequence.time[np.isfinite(sequence.time)]
    shared = len(times) / len(np.unique(times))
    if shared >= SHARED_TIMES:
        fix = "a logger or spreadsheet rounded the times: export them with fractions of a second"
        raise InputError(field, f"{shared:.3g} samples on average at each time", each, fix)
    mean = (len(times) - 1) / float(times[-1] - times[0])
    if rate > MAX_RATE and MIN_RATE <= mean <= MAX_RATE:
        found = f"batches: {mean:.3g} samples/s, most {1.0 / rate:.2g} s apart"
        fix = "these are the times at which batches arrived: space their samples evenly"
        raise InputError(field, found, each, fix)
    fix = "set the app to 50 Hz or more" if 1.0 <= rate < MIN_RATE else ""
    for unit, ns in TIME_UNITS.items():
        per_second = 10**9 // ns
        if rate and unit != "s" and MIN_RATE <= rate * per_second <= MAX_RATE:
            fix = f"time seems to be in {unit}: convert it, or write `t [{unit}]` in a CSV's header"
        if rate and unit != "s" and MIN_RATE <= rate / per_second <= MAX_RATE:
            fix = (
                f"its steps are {per_second:.0e} times too short for its unit: convert it, or name "
                "another in a CSV's header, such as `t [s]`"
            )
    raise InputError(field, f"{rate:.4g} samples/s", "50 to 1000", fix)


def clock_findings(sequence: ImuSequence) -> list[Finding]:
    """Report other sensors, and positions, of which most are at other times than the IMU's."""
    imu, found = sequence.time[np.isfinite(sequence.time)], list[Finding]()
    for words, code in _CLOCKS.items() if len(imu) else ():
        part: Timed | None = getattr(sequence, words)
        time, start, stop = np.empty(0) if part is None else part.time, imu.min(), imu.max()
        if not len(time) or ((time >= start) & (time <= stop)).mean() >= _INSIDE:
            continue
        longer = float(np.ptp(time)) / max(stop - start, 1e-9)
        units = (u for u, ns in TIME_UNITS.items() if u != "s" and 0.5 < longer * ns / 1e9 < 2.0)
        unit = next(units, None)
        text = (
            f"{words}: found times from {time[0]:.6g} to {time[-1]:.6g} s, "
            f"expected most during the samples, {start:.6g} to {stop:.6g} s"
        )
        fix = f"they seem to be in {unit}" if unit else "use one clock for both"
        values = {"first_s": float(time[0]), "last_s": float(time[-1])}
        found.append(Finding(f"{code}_clock", text, fix, values=values))
    return found


def dead_axes(sequence: ImuSequence) -> list[Finding]:
    """Return a finding for each sensor with dead axes: data simulated in a plane may be meant."""
    given = usable(sequence)
    gyro, accel = sequence.gyro[given], sequence.accel[given]
    if len(gyro) < 2:
        return []
    varies = gyro.std(axis=0) > _VARIES_RAD_S
    turned = np.cross(accel.mean(axis=0), gyro).std(axis=0)  # the force's rate of change
    constant = _constant(accel)
    alone = constant.sum() < 3  # otherwise the whole sensor is dead
    dead = {
        "gyroscope": _constant(gyro) & (varies.sum() == 2),
        "accelerometer": constant & alone & (turned > _TILTING_RAD_S * STANDARD_GRAVITY),
    }
    found = []
    for sensor, flags in dead.items():
        if axes := " and ".join(np.array(["x", "y", "z"])[flags]):
            text = f"{sensor}: its {axes} axis never changes, although the device turns"
            found.append(Finding(f"{sensor}_dead_axis", text, _REMEDY, values={"axes": axes}))
    return found


def _constant(values: FloatArray) -> BoolArray:
    return np.asarray((values == values[0]).all(axis=0))


def stuck_findings(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> list[Finding]:
    """Report a sensor that repeats while the other moves; `check_units` refuses a dead one."""
    found = []
    for sensor, values, other, moves in (
        ("gyroscope", gyro, "accelerometer", contradicts_constant_gyro),
        ("accelerometer", accel, "gyroscope", contradicts_constant_accel),
    ):
        repeated = np.asarray(~np.diff(values, axis=0).any(axis=1))
        stuck = [
            (float(time[a] - time[0]), float(time[b] - time[0]))
            for a, b in runs(repeated)
            if time[b] - time[a] >= _STUCK_S
            and b - a >= MIN_RATE * _STUCK_S  # in another unit two samples make a second
            and moves(time[a : b + 1], gyro[a : b + 1], accel[a : b + 1])
        ]
        if stuck and not repeated.all():
            start, stop = max(stuck, key=lambda stretch: stretch[1] - stretch[0])
            seconds = sum(b - a for a, b in stuck)
            text = (
                f"{sensor}: its values repeat exactly for {seconds:.1f} s while the {other} "
                f"shows motion, longest from {start:.1f} to {stop:.1f} s"
            )
            fix = "restart the device and record again; if it recurs, the sensor or app is faulty"
            values_of = {"seconds": seconds, "start_s": start, "stop_s": stop}
            found.append(Finding(f"{sensor}_stopped", text, fix, values=values_of))
    return found


def check_not_dead(name: str, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> None:
    """Raise InputError if a sensor's values (n, 3) are constant while the other shows motion."""
    if not np.diff(gyro, axis=0).any() and contradicts_constant_gyro(time, gyro, accel):
        found = "values that never change while the accelerometer's do"
        raise InputError(f"{name}: gyroscope", found, "angular rates", _REMEDY)
    if not np.diff(accel, axis=0).any() and contradicts_constant_accel(time, gyro, accel):
        found = "values that never change while the gyroscope tilts them"
        raise InputError(f"{name}: accelerometer", found, "specific forces", _REMEDY)


def contradicts_constant_gyro(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Return whether a force (n, 3) contradicts both rest and steady rotation at the first rate.

    In steady rotation the force is constant, in the device's axes (moving in a circle) or in the
    world's (turning in place).
    """
    turned = Rotation.from_rotvec(np.outer(time - time[0], gyro[0])).apply(accel)
    return min(scatter(accel), scatter(turned)) > _SHAKEN_M_S2


def contradicts_constant_accel(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Return whether the rate (n, 3) perpendicular to the force varies.

    A constant force rules that out; one of zero, which has no direction, any rate that varies.
    """
    size = float(np.linalg.norm(accel[0]))
    across = np.cross(gyro, accel[0] / size) if size > 0.0 else gyro
    return scatter(across) > _TILTING_RAD_S
