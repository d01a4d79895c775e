"""Preprocessing of a recording: cut into intervals, displacements inferred from its windows."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from stario.fusion.imu.direction import Direction, direction, weighted_force
from stario.fusion.imu.faults import ClockSetBackError
from stario.fusion.imu.front_end import FrontEnd
from stario.fusion.imu.inference import (
    BATCH,
    Predictor,
    StatefulInference,
    WindowDisplacement,
    displacements_of,
)
from stario.fusion.imu.intervals import ImuInterval, Start
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.health import Health
from stario.sequences.arrays import check_type
from stario.sequences.errors import InputError
from stario.sequences.findings import warn
from stario.sequences.inspection.checks import check_units
from stario.sequences.inspection.samples import dead_axes
from stario.sequences.sequence import FloatArray, ImuSequence, PositionTrack, Satellites
from stario.sequences.time_order import MAX_IMU_GAP
from stario.sequences.windows import WINDOW_SECONDS

Progress = Callable[[float], None]
"""Callback that receives the fraction of the work done, 0 to 1."""


def silent(share: float) -> None:
    """Ignore progress."""


@dataclass(frozen=True, eq=False, repr=False)
class PreprocessedRecording:
    """A recording after front end and network.

    Attributes:
        intervals: IMU intervals, in order, without their windows.
        update_rate: network updates per second that it was cut for.
        measurements: predicted displacement of the window ending with each interval, None if no
            window ends there.
        start: time and levelled attitude of the first sample.
        counts: report of its samples, gaps and network.
        satellites: its satellite positions, None if it has none.
        positions: its positions known without attitude, None if it has none.
        seconds_front_end: computing time of the front end [s].
        seconds_network: computing time of the network [s].
    """

    intervals: list[ImuInterval]
    update_rate: int
    measurements: list[WindowDisplacement | None]
    start: Start
    counts: Health
    satellites: Satellites | None
    positions: PositionTrack | None
    seconds_front_end: float
    seconds_network: float

    def __repr__(self) -> str:
        windows = sum(m is not None for m in self.measurements)
        return f"PreprocessedRecording({len(self.intervals)} intervals, {windows} windows)"


def preprocess(
    sequence: ImuSequence, model: Predictor, config: NavigatorConfig, progress: Progress
) -> PreprocessedRecording:
    """Cut a recording into intervals and predict the displacements of its windows.

    Raises:
        InputError: the recording is shorter than 1.5 s, its units or rate are wrong, or an argument
            has the wrong type.
    """
    check_type("sequence", sequence, ImuSequence, "read_recording(path) returns one")
    if not callable(progress):
        remedy = "pass fixes by name: fixes=[...]"
        raise InputError("progress", f"{progress!r:.60}", "a function of the fraction done", remedy)
    check_units(sequence)
    warn(sequence.name, dead_axes(sequence))
    began = perf_counter()
    intervals, front_end = cut_recording(sequence, config)
    if front_end.start is None or not any(e.window is not None for e in intervals):
        raise InputError(
            f"{sequence.name}: samples",
            f"{front_end.counts.samples['used']} usable over {sequence.duration:.2f} s",
            f"an unbroken stretch of at least {WINDOW_SECONDS:g} s",
        )
    seconds_front_end = perf_counter() - began
    progress(0.1)
    began = perf_counter()
    network = StatefulInference(model, config.filter.window_updates)
    measurements = _displacements(intervals, network, front_end.counts, progress)
    return PreprocessedRecording(
        [interval.without_window() for interval in intervals],
        config.filter.update_rate,
        measurements,
        front_end.start,
        front_end.counts,
        sequence.satellites,
        sequence.positions,
        seconds_front_end,
        seconds_network=perf_counter() - began,
    )


def cut_recording(
    sequence: ImuSequence, config: NavigatorConfig
) -> tuple[list[ImuInterval], FrontEnd]:
    """Cut a recording into intervals; return them and the front end with its counts and start.

    Samples after the clock was set back are skipped, and the counts report it.
    """
    front_end = FrontEnd(config)
    intervals: list[ImuInterval] = []
    magnetometer, barometer = sequence.magnetometer, sequence.barometer
    fields, pressures = deque[tuple[float, FloatArray]](), deque[tuple[float, float]]()
    if magnetometer is not None:
        fields.extend(zip(magnetometer.time.tolist(), magnetometer.field, strict=True))
    if barometer is not None:
        pressures.extend(np.column_stack([barometer.time, barometer.pressure_hPa]).tolist())
    for sample in np.column_stack([sequence.time, sequence.gyro, sequence.accel]).tolist():
        # A wild timestamp must not release all later fields at once.
        until = min(sample[0], front_end.newest + MAX_IMU_GAP)
        while fields and fields[0][0] <= until:
            front_end.push_field(*fields.popleft())
        while pressures and pressures[0][0] <= until:
            front_end.push_pressure(*pressures.popleft())
        try:
            intervals += front_end.push(tuple(sample))
        except ClockSetBackError as error:
            front_end.counts.set_back = error.by
            break
    front_end.finish()
    unused = config.filter.magnetometer and all(e.field_B is None for e in intervals)
    if magnetometer is not None and unused:  # it has another clock
        front_end.counts.fields_dropped = len(magnetometer.time)
    if barometer is not None and all(e.height is None for e in intervals):
        front_end.counts.pressures_dropped = len(barometer.time)
    return intervals, front_end


def _displacements(
    intervals: Sequence[ImuInterval],
    network: StatefulInference,
    counts: Health,
    progress: Progress,
) -> list[WindowDisplacement | None]:
    """Predict the displacement of the window that ends with each interval; None without one."""
    ends = [k for k, interval in enumerate(intervals) if interval.window is not None]
    gaps = np.cumsum([interval.gap for interval in intervals])[ends]
    begins = np.diff(gaps, prepend=gaps[0]) > 0
    measurements: list[WindowDisplacement | None] = [None] * len(intervals)
    weighted = []
    for first in range(0, len(ends), BATCH):
        batch = ends[first : first + BATCH]
        windows = [window for k in batch if (window := intervals[k].window) is not None]
        displacements = displacements_of(network, windows, begins[first : first + BATCH])
        weighted.append(weighted_force(np.stack([window.imu_N for window in windows])))
        for k, displacement in zip(batch, displacements, strict=True):
            measurements[k] = displacement
        progress(0.1 + 0.5 * (batch[-1] + 1) / len(intervals))
    moved = np.array([m.d_N for m in measurements if m is not None])
    cuts = np.flatnonzero(begins)
    parts = zip(np.split(np.concatenate(weighted), cuts), np.split(moved, cuts), strict=True)
    found = sum((direction(w, d, network.updates) for w, d in parts), Direction())
    if found.sigma < math.pi:
        counts.network_turn, counts.network_turn_sigma = found.turn, found.sigma
    return measurements
