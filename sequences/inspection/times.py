"""Detection of times that are out of order, rounded, in another unit, or those of batches."""

from __future__ import annotations

import numpy as np

from stario.sequences.clean_samples import MAX_RATE, MIN_RATE, SHARED_TIMES
from stario.sequences.errors import InputError
from stario.sequences.inspection.samples import disorder
from stario.sequences.sequence import ImuSequence
from stario.sequences.units import TIME_UNITS

_INSIDE = 0.5
"""Share of the magnetometer's samples during the IMU's below which its clock is another."""


def check_time(sequence: ImuSequence) -> None:
    """Check order, rate and unit of a recording's times.

    Raises:
        InputError: they are out of order, or there are not 50 to 1000 different ones a second.
    """
    if found := disorder(sequence.time):
        raise InputError(
            f"{sequence.name}: time", found, "increasing times", "sort the rows by time"
        )
    rate = sequence.rate
    if MIN_RATE <= rate <= MAX_RATE:
        return
    times = sequence.time[np.isfinite(sequence.time)]
    shared = len(times) / len(np.unique(times))
    if shared >= SHARED_TIMES:
        raise InputError(
            f"{sequence.name}: time", f"{shared:.3g} samples on average at each time",
            "a time for each sample",
            "a logger or spreadsheet rounded the times: export them with fractions of a second",
        )  # fmt: skip
    mean = (len(times) - 1) / float(times[-1] - times[0])
    if rate > MAX_RATE and MIN_RATE <= mean <= MAX_RATE:
        raise InputError(
            f"{sequence.name}: time",
            f"batches: {mean:.3g} samples/s, most {1.0 / rate:.2g} s apart",
            "a time for each sample",
            "these are the times at which batches arrived: space their samples evenly",
        )  # fmt: skip
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
    raise InputError(f"{sequence.name}: time", f"{rate:.4g} samples/s", "50 to 1000", fix)


def magnetometer_time_problems(sequence: ImuSequence) -> list[str]:
    """Describe a magnetometer of which most samples are at other times than the IMU's."""
    field, times = sequence.magnetometer, sequence.time[np.isfinite(sequence.time)]
    if field is None or not len(times):
        return []
    start, stop = float(times.min()), float(times.max())
    if ((field.time >= start) & (field.time <= stop)).mean() >= _INSIDE:
        return []
    longer = float(np.ptp(field.time)) / max(stop - start, 1e-9)
    units = (u for u, ns in TIME_UNITS.items() if u != "s" and 0.5 < longer * ns / 1e9 < 2.0)
    unit = next(units, None)
    fix = f"they seem to be in {unit}" if unit else "use one clock for both"
    return [
        f"{sequence.name}: magnetometer: found times from {field.time[0]:.6g} to "
        f"{field.time[-1]:.6g} s, expected most during the samples, {start:.6g} to {stop:.6g} s; "
        f"{fix}"
    ]
