"""Times of a batch: their middle, and the readings whose times can be right."""

from __future__ import annotations

from stario.fusion.live.payload import Batch, Reading

BACKWARD = 5 * 10**9
"""A batch whose middle is this [ns] before the newest sample comes from a clock set back."""

_STRAY_SHARE = 0.1
"""Maximum share of a batch's readings whose times, `BACKWARD` or more from the batch's middle, are
taken to be wrong; more are a backlog."""


def with_credible_time(batch: Batch) -> list[Reading]:
    """Return the readings without single ones far from the rest, which would seem to be newest."""
    middle = middle_time(batch)
    near = [reading for reading in batch.readings if abs(reading.time_ns - middle) < BACKWARD]
    stray = len(batch.readings) - len(near)
    return near if stray <= _STRAY_SHARE * len(batch.readings) else batch.readings


def middle_time(batch: Batch) -> int:
    """Return the median time of a batch that is not empty [ns]."""
    times = sorted(reading.time_ns for reading in batch.readings)
    return times[len(times) // 2]
