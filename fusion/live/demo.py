"""A simulated phone, for those without one: a recording becomes pushes at its own speed."""

from __future__ import annotations

import asyncio
import time

import numpy as np

from stario.fusion.live.hub import Hub
from stario.fusion.live.payload import BAROMETER, GYRO, MAG, TOTAL, Batch, Reading
from stario.sequences.sequence import ImuSequence

PERIOD = 0.2
"""Time between two pushes [s], as of an app."""

DEVICE = "simulated phone"


async def walk(hub: Hub, recording: ImuSequence) -> None:
    """Send a recording as if its device were walking now; its track then ends."""
    readings = _readings(recording)
    times = np.array([reading.time_ns for reading in readings])
    began = time.monotonic()
    for number in range(int(recording.duration / PERIOD) + 1):
        end = (number + 1) * PERIOD
        await asyncio.sleep(began + end - time.monotonic())
        begin, stop = np.searchsorted(times, [round(1e9 * number * PERIOD), round(1e9 * end)])
        await hub.take(Batch(DEVICE, recording.name, readings[begin:stop], number))
    await hub.command(DEVICE, "stop")


def _readings(recording: ImuSequence) -> list[Reading]:
    """Return a recording's readings in order of time, which starts at zero."""
    streams = [(GYRO, recording.time, recording.gyro), (TOTAL, recording.time, recording.accel)]
    if (field := recording.magnetometer) is not None:
        streams.append((MAG, field.time, field.field))
    if (pressure := recording.barometer) is not None:
        streams.append((BAROMETER, pressure.time, pressure.pressure_hPa[:, None]))
    readings = [
        Reading(sensor, round(1e9 * (t - recording.time[0])), tuple(value))
        for sensor, times, values in streams
        for t, value in zip(times.tolist(), values.tolist(), strict=True)
        if t >= recording.time[0]
    ]
    return sorted(readings, key=lambda reading: reading.time_ns)
