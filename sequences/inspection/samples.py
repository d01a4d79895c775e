"""Samples that are invalid by themselves: by their times, or by values that no sensor measures."""

from __future__ import annotations

import logging

import numpy as np

from stario.sequences.arrays import runs
from stario.sequences.clean_samples import usable
from stario.sequences.inspection.constant_values import stuck_problems
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.time_order import MAX_IMU_GAP, ahead_mask, increasing_mask

_log = logging.getLogger(__name__)

_OUT_OF_ORDER = 0.05
"""Share of backward steps above which the rows are out of order."""

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

_MIN_LIMIT_SHARE, _MIN_LIMIT_COUNT = 0.005, 3
"""Minimum share and number of samples at the limit for a report."""


def sample_problems(sequence: ImuSequence) -> list[str]:
    """Return problems of the samples, one line each; `disorder` reports rows out of order."""
    problems = _late_problems(sequence)
    values = np.column_stack([sequence.gyro, sequence.accel])
    invalid = int((np.isfinite(values).all(axis=1) & ~usable(sequence)).sum())
    if invalid:
        count = "1 sample" if invalid == 1 else f"{invalid} samples"
        problems.append(f"{sequence.name}: values that no sensor can measure, in {count}")
    given = usable(sequence) & np.isfinite(sequence.time)
    samples = sequence.time[given], sequence.gyro[given], sequence.accel[given]
    return problems + stuck_problems(sequence.name, *samples) + _limit_problems(sequence)


def _late_problems(sequence: ImuSequence) -> list[str]:
    """Report the longest run of late samples, as the health of a run does."""
    time = sequence.time[np.isfinite(sequence.time)]
    if disorder(time):
        return []
    newest = np.maximum.accumulate(time)
    late = [(float(time[b - 1] - time[a]), a) for a, b in runs(time < newest)]
    seconds, first = max(late, default=(0.0, 0))
    if seconds < _LATE_SECONDS:
        return []
    by, at = float(newest[first] - time[first]), float(time[first - 1] - time[0])
    if by > _SET_BACK:
        return [
            f"{sequence.name}: time: the clock jumps back by {by:.3g} s at {at:.1f} s; "
            "split the recording there"
        ]
    return [
        f"{sequence.name}: time: samples come late for {seconds:.1f} s in a row after {at:.1f} s: "
        f"logged twice, or from a clock that was set back by {by:.3g} s; if so, that time is "
        "missing: split the recording there"
    ]


def _limit_problems(sequence: ImuSequence) -> list[str]:
    """Report a sensor at its limit, as streams do (`fusion.imu.faults`)."""
    given = usable(sequence)
    return [
        f"{sequence.name}: {words}"
        for words in (
            limit_words("gyroscope", sequence.gyro[given], "rad/s", _LARGE_RAD_S),
            limit_words("accelerometer", sequence.accel[given], "m/s^2", LARGE_M_S2),
        )
        if words
    ]


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


def disorder(time: FloatArray) -> str:
    """Return how many of the times (n,) [s] go back, in words; empty if few do."""
    back = int((np.diff(time[np.isfinite(time)]) < 0.0).sum())
    many = back > _OUT_OF_ORDER * len(time)
    return f"{back} of {len(time)} times earlier than the one above" if many else ""


def in_order(sequence: ImuSequence) -> ImuSequence:
    """Sort a recording by time if many rows are out of order, each by little.

    Some loggers write samples of a few milliseconds in any order. Dropping them, as is done with a
    few, would lose a twentieth of the samples. Rows that are far out of order are not sorted.
    """
    time = sequence.time
    if not disorder(time):
        return sequence
    back = float((np.maximum.accumulate(time) - time).max())
    if not back < MAX_IMU_GAP:
        return sequence
    _log.warning(
        "%s: %s, by up to %.0f ms: sorted by time", sequence.name, disorder(time), 1e3 * back
    )
    return sequence.select(np.argsort(time, kind="stable"))


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
