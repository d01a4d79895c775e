"""Samples at times of their own clock: its unit, and joining of sensors sampled apart."""

from __future__ import annotations

import logging
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stario.sequences.arrays import interpolated
from stario.sequences.clean_samples import MAX_RATE, MIN_RATE, SHARED_TIMES
from stario.sequences.errors import ReadError
from stario.sequences.readers.checked import magnetometer
from stario.sequences.readers.phones.sensor_words import XSENS_CLOCK
from stario.sequences.readers.text import Column, IntArray, seconds
from stario.sequences.sequence import MAX_TRUTH_GAP, FloatArray, ImuSequence
from stario.sequences.time_order import MAX_IMU_GAP, disorder, hour_advice, increasing_mask
from stario.sequences.units import FILETIME_1970, FILETIME_NS, TIME_UNITS

_log = logging.getLogger(__name__)

_RATES = (9.0, 1.05 * MAX_RATE)
"""Plausible rates of sensors and captures [Hz], with slack for rounding; the range spans less than
the factor between two units, so that only one unit fits."""


_CLOCKS = {XSENS_CLOCK: {"ticks of 100 us": 10**5, "us": 10**3}}
"""Units [ns] of clocks by title: Xsens counts ticks in MT devices, microseconds in DOTs."""

_MARGIN_S = 60.0
"""Maximum time [s] by which rare rows may precede or follow their recording."""

_DAY_NS, _EXCEL_DAYS = 86_400 * 10**9, (25_569.0, 73_050.0)
"""Unit of the dates of spreadsheets, and those of 1970 and 2100: days since the end of 1899."""

_DATE = re.compile(
    r"(19[7-9]|20\d)\d(0[1-9]|1[0-2])(0[1-9]|[12]\d|3[01])([01]\d|2[0-3])([0-5]\d){2}(\d{3})?"
)
"""Year, month, day, hour, minute, second and perhaps milliseconds without separators."""

_LATEST_S = 4.1e9
"""Seconds from 1970 to 2100: a unit that makes times later is not theirs."""

_SINCE_1970_S = 1e8
"""Times beyond this [s] are counted from 1970 rather than from a start."""

_FEW_LOST, _SHORT_S = 0.05, 1.0
"""Share of samples without those of another sensor, and time [s] of those before its start and
after its end, that need no mention."""

_FEW_ROWS = 10
"""Number of rows below which a count may be a coincidence."""


@dataclass(frozen=True)
class Samples:
    """Samples of a sensor.

    Attributes:
        stamps_ns: (N,) times [ns].
        values: (N, K) values.
        unit: unit named in the file; empty if none.
        assumed: ", times taken as" and a unit, if they name none; empty if it is certain.
    """

    stamps_ns: IntArray
    values: FloatArray
    unit: str = ""
    assumed: str = ""

    def seconds(self, origin_ns: np.int64) -> FloatArray:
        """Return the times (N,) [s] since an origin."""
        return seconds(self.stamps_ns, origin_ns)


def joined_sequence(
    path: Path, name: str, gyro: Samples, accel: Samples, mag: Samples | None = None
) -> tuple[ImuSequence, np.int64]:
    """Return a recording of sensors sampled apart, and its first sample's time [ns]."""
    stamps, rate, force, alone = resample_to_gyro(path, gyro, accel)
    start_ns = stamps[0]
    field = None if mag is None else magnetometer(mag.seconds(start_ns), mag.values)
    time = seconds(stamps, start_ns)
    return ImuSequence(name, time, rate, force, magnetometer=field, alone_s=alone), start_ns


def resample_to_gyro(
    path: Path,
    gyro: Samples,
    accel: Samples,
    names: tuple[str, str] = ("gyroscope", "accelerometer"),
) -> tuple[IntArray, FloatArray, FloatArray, dict[str, float]]:
    """Return times [ns], gyroscope and accelerometer, interpolated to it in their common time span.

    `ImuSequence.alone_s` follows. Samples in an accelerometer gap of more than 0.1 s are skipped,
    since the force there is unknown. Both clocks have one origin; `names` are for messages if they
    are other sensors'.
    """
    accel = _sorted_samples(path, names[1], accel, _rate(gyro.stamps_ns))
    gyro_ns, accel_ns = gyro.stamps_ns, accel.stamps_ns
    kept = (gyro_ns >= accel_ns[0]) & (gyro_ns <= accel_ns[-1])
    if not kept.any():
        origin = min(gyro_ns.min(), accel_ns[0])
        spans = [
            f"{name} from {time.min():.3f} to {time.max():.3f} s"
            for name, time in zip(names, (gyro.seconds(origin), accel.seconds(origin)), strict=True)
        ]
        raise ReadError(path, "time", ", ".join(spans), "overlapping times on one clock")
    right = np.clip(np.searchsorted(accel_ns, gyro_ns), 1, len(accel_ns) - 1)
    before, after = accel_ns[right - 1], accel_ns[right]
    exact = (gyro_ns == before) | (gyro_ns == after)
    kept &= exact | (after - before <= round(MAX_TRUTH_GAP * 1e9))
    if not kept.any():
        step = float(np.median(np.diff(accel_ns))) * 1e-9
        found, fix = f"samples {step:.3g} s apart", "is its unit the one that the header names?"
        raise ReadError(path, "time", found, f"at most {MAX_TRUTH_GAP} s", fix)
    if (lost := int((~kept).sum())) > _FEW_LOST * len(kept):
        _log.warning(
            "%s: dropped %d of %d samples at whose times only one of two sensors was recorded",
            path, lost, len(kept),
        )  # fmt: skip
    time = seconds(gyro_ns[kept], accel_ns[0])
    force = interpolated(time, accel.seconds(accel_ns[0]), accel.values)
    alone = {names[0]: _alone_s(gyro_ns, accel_ns), names[1]: _alone_s(accel_ns, gyro_ns)}
    return gyro_ns[kept], gyro.values[kept], force, {name: s for name, s in alone.items() if s}


def _alone_s(stamps_ns: IntArray, other_ns: IntArray) -> float:
    """Return the time [s] of samples before another sensor's start and after its end, 0 for few.

    They are counted, so that a single wild time is not taken for years.
    """
    outside = (stamps_ns < other_ns.min()) | (stamps_ns > other_ns.max())
    alone_s = len(np.unique(stamps_ns[outside])) / _rate(stamps_ns)
    return alone_s if alone_s > _SHORT_S and outside.mean() > _FEW_LOST else 0.0


def _sorted_samples(path: Path, name: str, samples: Samples, other_rate: float) -> Samples:
    """Return a sensor's samples by increasing time, one at each, for interpolation.

    Rows late by milliseconds are sorted. Those of a clock that was set back are dropped: sorted,
    they would alternate with samples from another time.
    """
    stamps_ns, values = samples.stamps_ns, samples.values
    time = samples.seconds(stamps_ns[0])
    set_back = float((np.maximum.accumulate(time) - time).max())
    if set_back > MAX_IMU_GAP and not disorder(time):
        kept = increasing_mask(time)
        stamps_ns, values = stamps_ns[kept], values[kept]
        _log.warning(
            "%s: %s: dropped %d of %d samples whose times go back or jump ahead, by up to %.3g s: "
            "%s", path, name, (~kept).sum(), len(kept), set_back,
            hour_advice(set_back) or "split the recording there",
        )  # fmt: skip
    order = np.argsort(stamps_ns, kind="stable")
    stamps_ns, values = stamps_ns[order], values[order]
    fresh = np.append(True, np.diff(stamps_ns) > 0)
    differing = np.append(True, np.diff(values, axis=0).any(axis=1))
    shared, rate = float((fresh | differing).sum()) / int(fresh.sum()), _rate(stamps_ns[fresh])
    if shared >= SHARED_TIMES:
        _log.warning(
            "%s: %s: found %.3g samples on average at each time, of which one is used, expected a "
            "time for each: export them unrounded, and not in batches", path, name, shared,
        )  # fmt: skip
    elif rate < min(MIN_RATE, other_rate):  # a recording of that rate is refused later
        _log.warning(
            "%s: %s: found %.3g samples/s, expected 50 to 1000: set the app to 50 Hz or more",
            path, name, rate,
        )  # fmt: skip
    return Samples(stamps_ns[fresh], values[fresh])


def _rate(stamps_ns: IntArray) -> float:
    """Return the median rate [Hz] of times [ns], infinite for a single one."""
    steps = np.diff(stamps_ns)
    steps = steps[steps > 0]
    return 1e9 / float(np.median(steps)) if len(steps) else math.inf


def _refuse_counts_and_dates(file: Path, title: str, time: FloatArray) -> None:
    """Refuse a column without a unit that counts rows, or whose digits are dates.

    Rows are counted as 0, 1, 2, ... or 1, 2, 3, ...; digits such as 20240501120059990 are a date
    and a time of day to the millisecond. Taken for one of the units either would be plausible.
    """
    count = len(time)
    if count < _FEW_ROWS:
        return
    if np.array_equal(time - time[0], np.arange(count)) and time[0] in (0.0, 1.0):
        found = f"{time[0]:.0f}, {time[0] + 1:.0f}, {time[0] + 2:.0f}, ..., which counts the rows"
        fix = f"name a column of times `t [s]`; if these are times, name their unit: `{title} [ms]`"
        raise ReadError(file, title, found, "times", fix)
    known = time[np.isfinite(time)]
    if len(known) and all(_DATE.fullmatch(f"{one:.0f}") for one in known.tolist()):
        expected = "seconds, or dates such as 2024-05-01 12:00:59.990"
        raise ReadError(file, title, f"{time[0]:.0f}, a date without separators", expected)


def unit_within(file: Path, time: FloatArray, start_ns: np.int64, stop_ns: np.int64) -> int:
    """Return the time unit [ns] with which most times (N,) lie within a recording on one clock.

    For rows too rare for `time_unit`; they may precede or follow it by a minute.
    """
    start, stop = float(start_ns) * 1e-9 - _MARGIN_S, float(stop_ns) * 1e-9 + _MARGIN_S
    # Times from zero fit finer units as well, but all at the start.
    fitting = {
        unit: int(((time * unit * 1e-9 > start) & (time * unit * 1e-9 < stop)).sum())
        for unit in sorted(TIME_UNITS.values(), reverse=True)
    }
    unit = max(fitting, key=lambda unit: fitting[unit])
    if not fitting[unit]:
        found = f"times from {time.min():.12g} to {time.max():.12g}"
        whole = f"{float(start_ns) * 1e-9:.3f} to {float(stop_ns) * 1e-9:.3f} s"
        expected = f"some within the recording's, {whole}, in any unit"
        raise ReadError(file, "time", found, expected, "write both in one clock")
    return unit


def clock_unit(
    file: Path, clock: Column, time: FloatArray, or_seconds: bool = False
) -> tuple[int, str]:
    """Return the unit [ns] of a clock's times (N,), and `assumed` of `Samples`.

    Without a unit, counts of rows and dates without separators are refused: either would pass for
    times. Those at a rate of no unit are too, or taken as seconds unless that is after 2100.
    """
    if clock.unit:
        return time_unit(file, time, clock.unit), ""
    _refuse_counts_and_dates(file, clock.title or "time", time)
    first = float(time[:1].sum())
    try:
        unit_ns = time_unit(file, time)
    except ReadError:
        if not or_seconds or abs(first) > _LATEST_S:
            raise
        return TIME_UNITS["s"], ""
    if first * unit_ns * 1e-9 > _SINCE_1970_S:  # which fits no other unit
        return unit_ns, ""
    name = next(unit for unit, ns in TIME_UNITS.items() if ns == unit_ns)
    return unit_ns, f", times taken as {name}"


def time_unit(file: Path, time: FloatArray, unit: str = "") -> int:
    """Return the unit of times (N,) [ns], inferred from the rate if none is named.

    Samples that share a rounded time are spread over the time to the next one.
    """
    if unit in TIME_UNITS:
        return TIME_UNITS[unit]
    candidates = _CLOCKS.get(unit, TIME_UNITS)
    if unit and unit not in _CLOCKS:
        raise ReadError(file, "time", f"unit {unit!r}", ", ".join(TIME_UNITS))
    steps = np.diff(time)
    forward = steps[steps > 0]
    step = float(np.median(forward)) * len(forward) / len(steps) if len(forward) else 0.0
    first = float(time[np.isfinite(time)][:1].sum())

    def fits(unit_ns: int) -> bool:
        return step > 0.0 and _RATES[0] <= 1e9 / (step * unit_ns) <= _RATES[1]

    if not unit and 0.0 < (first - FILETIME_1970) * FILETIME_NS * 1e-9 < _LATEST_S:
        return FILETIME_NS
    if not unit and _EXCEL_DAYS[0] < first < _EXCEL_DAYS[1] and fits(_DAY_NS):
        return _DAY_NS
    for name, unit_ns in candidates.items():
        if first * unit_ns * 1e-9 < _LATEST_S and fits(unit_ns):
            _log.info("%s: its times name no unit, their rate fits %s", file, name)
            return unit_ns
    expected = f"10 to {MAX_RATE:.0f} samples per second in one of {', '.join(candidates)}"
    raise ReadError(file, "time", f"a step of {step:.4g}", expected)
