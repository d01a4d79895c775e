"""The front end: raw samples to intervals for network and filter, the same in stream and batch.

Samples are checked, brought into strictly increasing time and cut at an even grid of times, with
the IMU interpolated exactly there (so that nothing is integrated twice or skipped). Each interval
holds its samples and, at the times of a network update, the window that ends there, provided that
the last second of samples is unbroken.
Samples that jump ahead in time wait until others confirm them, so that one wild timestamp does not
make all later samples look late (`sequences.time_order`). After a gap the attitude is levelled
again by the mean force of a second, as at the start: a phone in a swinging hand turns by 30 degrees
within a third of a second.

Nothing here depends on the filter, so batch runs can pass all windows to the network at once and
still reproduce the streamed track.
"""

from __future__ import annotations

import math
import statistics

import numpy as np

from stario.fusion.imu.barometer import HEIGHT_SECONDS, HeightBuffer
from stario.fusion.imu.buffers import FieldBuffer
from stario.fusion.imu.faults import (
    ClockSetBackDetector,
    FrozenSensorDetector,
    OutlierDetector,
)
from stario.fusion.imu.gap import gap_rotation
from stario.fusion.imu.inference import WindowBuffer
from stario.fusion.imu.intervals import (
    NO_FLAGS,
    Flags,
    ImuInterval,
    Sample,
    Start,
    interpolated_sample,
)
from stario.fusion.imu.units import SensorCheck, warn_of_field
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.health import Health
from stario.sequences.attitude.levelling import START_SECONDS, LevelledAttitude, start_from_gravity
from stario.sequences.clean_samples import MAX_RATE, replace_spikes
from stario.sequences.errors import InputError
from stario.sequences.sequence import MAX_SENSOR_VALUE, FloatArray
from stario.sequences.time_order import CONFIRMED, CONFIRMED_FAR, FAR_AHEAD, MAX_IMU_GAP

BRIDGED = 0.2
"""A hole no longer than this [s] is bridged by interpolating between the samples at its ends, which
a pedestrian's step hardly changes; a longer one is a gap, which no window spans."""

_HOLE_SECONDS = 0.05
"""A time step longer than this [s] is a hole: the motion within it is poorly known."""

_ISOLATED_SAMPLES = 20
"""This many samples in a row, each isolated by gaps, show that times are not in seconds; this many
batches, that they are those of arrival."""

_REPEATED_SAMPLES = 1000
"""This many samples with the first one's time show that times have too few digits."""

_GAPS_LISTED = 100
"""Maximum number of gaps listed one by one; an endless stream may have any number."""

_SAMPLES = ("used", "not_finite", "frozen", "duplicate", "out_of_order", "future")
"""What becomes of samples: used, or dropped because a value is NaN, infinite or absurdly large,
because it repeats those before though the device is not at rest, or because of its time."""


class FrontEnd:
    """Collects samples and yields intervals.

    Args:
        config: update rate, gravity, and whether the magnetometer is used.

    Attributes:
        newest: time of the newest accepted sample [s]; minus infinity before the first.
        sensors: check of units for streams, which cannot be checked as a whole.
        counts: report of samples used, dropped and flagged, and of gaps.
        start: time and levelled attitude of the first sample; None during the first second.
    """

    def __init__(self, config: NavigatorConfig) -> None:
        self._config = config
        rate = config.filter.output_rate
        self._period = 1.0 / rate
        self._samples: list[Sample] = []
        self._attitude: LevelledAttitude | None = None
        self._origin, self._index = 0.0, 0
        self._next = -math.inf
        self.newest = -math.inf
        self._windows = WindowBuffer(rate)
        self._hole = (-math.inf, -math.inf)  # ends of the last hole [s]
        self._unconfirmed: list[Sample] = []  # jumped ahead in time, not confirmed yet
        self._before_gap: Sample | None = None  # after which gravity has not been averaged yet
        self._fields, self._pressures = FieldBuffer(), HeightBuffer()
        self._clock = ClockSetBackDetector()
        self._frozen = FrozenSensorDetector(config.gravity)
        self._outliers = OutlierDetector()
        self.sensors = SensorCheck()
        flagged = {"spike": 0, "saturated": 0}
        self.counts = Health(samples=dict.fromkeys(_SAMPLES, 0), flagged=flagged)
        self.start: Start | None = None

    def push(self, sample: Sample) -> list[ImuInterval]:
        """Add a sample; return the intervals that it completes (usually none, rarely several).

        Raises:
            InputError: every sample so far is isolated by gaps, or all have the same time.
            ClockSetBackError: this and the preceding samples come from a clock that was set back.
        """
        time = sample[0]
        if not (math.isfinite(time) and sum(map(abs, sample[1:])) < MAX_SENSOR_VALUE):
            self.counts.samples["not_finite"] += 1
            return []
        if stopped := self._frozen.stopped(sample):
            self.counts.samples["frozen"] += 1
            if stopped != "both":
                self.counts.stopped[stopped] = self.counts.stopped.get(stopped, 0) + 1
            return []
        if self._unconfirmed and time > self.newest:
            self._drop_ahead(time)
        newest = self.newest
        if self._unconfirmed and time > newest:
            newest = self._unconfirmed[-1][0]
        if time == newest:
            self.counts.samples["duplicate"] += 1
            if self._samples and sample == self._samples[-1]:
                self._clock.logged_twice()
            self._check_time_advances(time)
        elif time < newest:
            self.counts.samples["out_of_order"] += 1
            late = self._clock.note_late(time, newest)
            self.counts.longest_late = max(self.counts.longest_late, late)
        elif self._unconfirmed or time - newest > MAX_IMU_GAP:
            return self._confirm(sample)
        else:
            return self._accept(sample)
        return []

    def push_field(self, time: float, field_B: FloatArray) -> None:
        """Add a magnetic field (3,) [uT] in B, before any later sample is pushed."""
        if self._config.filter.magnetometer and not self._fields.add(time, field_B, self.newest):
            self.counts.fields_dropped += 1

    def push_pressure(self, time: float, pressure_hPa: float) -> None:
        """Add a pressure [hPa], before any later sample is pushed."""
        if not self._pressures.add(time, pressure_hPa, self.newest):
            self.counts.pressures_dropped += 1

    def finish(self) -> None:
        """End the stream: drop the samples that still wait for others to confirm their times."""
        self.counts.samples["future"] += len(self._unconfirmed)
        self._unconfirmed = []

    def _drop_ahead(self, time: float) -> None:
        """Drop the waiting samples whose times are refuted by a new sample at `time`."""
        ahead = self._unconfirmed
        count = len(ahead)
        if time < ahead[0][0]:
            ahead.clear()
        while len(ahead) > 1 and ahead[-1][0] > max(time, ahead[-2][0] + MAX_IMU_GAP):
            ahead.pop()
        self.counts.samples["future"] += count - len(ahead)

    def _confirm(self, sample: Sample) -> list[ImuInterval]:
        """Queue a sample that jumps ahead in time or follows one; accept all once confirmed."""
        ahead = self._unconfirmed
        ahead.append(sample)
        far = ahead[0][0] - self.newest > FAR_AHEAD
        if len(ahead) < (CONFIRMED_FAR if far else CONFIRMED):
            return []
        self._unconfirmed = []
        return [interval for waiting in ahead for interval in self._accept(waiting)]

    def _accept(self, sample: Sample) -> list[ImuInterval]:
        time = sample[0]
        # On a clock that was set back, the sample before has the time of the first late one.
        before, self.newest = min(self.newest, self._clock.on_time(time)), time
        self.counts.samples["used"] += 1
        if self._samples and time - before > _HOLE_SECONDS:
            self._hole = before, time
            if time - before > MAX_IMU_GAP:
                self._count_gap(before, time - before)
            if time - before > BRIDGED:
                return self._span_gap(before, sample)
        self._samples.append(sample)
        if time < self._next:
            return []
        if self._attitude is None or self._before_gap is not None:
            return self._begin()
        return self._complete()

    def _begin(self) -> list[ImuInterval]:
        """Level the attitude once `START_SECONDS` have been collected, at first or after a gap."""
        first = self._samples[0][0]
        # A single sample here: its time is so large that adding a second is lost in rounding.
        if self.newest < first + START_SECONDS or len(self._samples) == 1:
            self._next = first + START_SECONDS
            return []
        table = np.array(self._samples)
        # Those after the first are replaced in the samples, and counted, when these are cut.
        self.counts.flagged["spike"] += int(replace_spikes(table[:, 1:])[0].any())
        self._samples[0] = tuple(table[0].tolist())
        gravity = start_from_gravity(table[:, 0], table[:, 1:4], table[:, 4:7])
        rate = 1.0 / float(np.median(np.diff(table[:, 0])))
        start = Start(**vars(gravity), time=first, rate=rate)
        self._origin, self._index, self._next = first, 1, first + self._period
        if self._attitude is None:
            warn_of_field(self._fields.waiting)
            self.start, self._attitude = start, LevelledAttitude(start)
            return self._complete()
        assert self._before_gap is not None
        ends = np.array([self._before_gap, self._samples[0]])
        turn = gap_rotation(ends, first - ends[0, 0], self._attitude.b_g)
        self._attitude.level(turn, start)
        self._before_gap = None
        gap = ImuInterval(ends, self._attitude.R_NB, levelled=start)
        return [gap, *self._complete()]

    def _count_gap(self, start: float, length: float) -> None:
        counts = self.counts
        counts.gap_count += 1
        counts.longest_gap = max(counts.longest_gap, length)
        counts.gaps = [*counts.gaps, (start, length)][-_GAPS_LISTED:]

    def _check_times(self, before: list[Sample]) -> None:
        """Refuse a stream in which every sample so far is isolated by gaps, or batches are."""
        gaps, count = self.counts.gap_count, len(before)
        if gaps < _ISOLATED_SAMPLES or self._attitude is not None:
            return
        if self.counts.samples["used"] == gaps + 1:
            step = statistics.median(length for _, length in self.counts.gaps)
            raise InputError(
                "time", f"samples {step:.3g} s apart", "50 to 1000 per second", "give times in s"
            )
        if count > 1 and before[-1][0] - before[0][0] < (count - 1) / MAX_RATE:
            found = (
                f"batches of {count} samples at {before[0][0]:.10g} s and {gaps - 1} other times"
            )
            fix = "these are the times at which batches arrived: space their samples evenly"
            raise InputError("time", found, "a time for each sample", fix)

    def _check_time_advances(self, time: float) -> None:
        """Refuse a stream that only repeats its first time, as seconds since 1970 in float32 do."""
        repeated = self.counts.samples["duplicate"]
        if self.counts.samples["used"] <= 1 and repeated >= _REPEATED_SAMPLES:
            found = f"{repeated + 1} samples at {time:.10g} s"
            remedy = "give times in s with 64 bits"
            raise InputError("time", found, "a time that advances", remedy)

    def _span_gap(self, start: float, sample: Sample) -> list[ImuInterval]:
        """End the current interval; `_begin` spans the gap since `start` with one of its own."""
        before = self._samples
        self._samples = [sample]
        self._check_times(before)
        self._windows.clear()
        self._next = -math.inf
        if self._attitude is None or self._before_gap is not None:
            return []
        table = np.array(before)
        flags = self._flag_outliers(table) if len(before) > 1 else NO_FLAGS
        self._before_gap = (start, *table[-1, 1:].tolist())
        if len(before) == 1:
            return []
        self._attitude.advance(table[:, 0], table[:, 1:4], table[:, 4:])
        return [ImuInterval(table, self._attitude.R_NB, flags=flags)]

    def _complete(self) -> list[ImuInterval]:
        intervals = []
        while self.newest >= self._next:
            intervals.append(self._with_window(*self._cut()))
        return intervals

    def _cut(self) -> tuple[FloatArray, Flags]:
        """Cut the samples of one period, interpolated at its end; keep the later ones."""
        stop = self._next
        later = next(k for k, sample in enumerate(self._samples) if sample[0] >= stop)
        table = np.array(self._samples[: later + 1])
        flags = self._flag_outliers(table)
        if self._hole[1] > table[0, 0] and self._hole[0] < stop:
            flags = flags._replace(missing=True)
        if flags.spikes:
            self._samples[later] = tuple(table[later].tolist())
        after = self._samples[later]
        if after[0] == stop:
            end = after
        else:
            end = tuple(interpolated_sample(table[later - 1], table[later], stop).tolist())
        rest = self._samples[later:]
        self._samples = rest if rest[0][0] == stop else [end, *rest]
        self._index += 1
        self._next = self._origin + self._index * self._period
        table[later] = end
        return table, flags

    def _flag_outliers(self, table: FloatArray) -> Flags:
        flags = self._outliers.detect(table)
        self.counts.flagged["spike"] += flags.spikes
        self.counts.flagged["saturated"] += flags.saturated
        return flags

    def _with_window(self, table: FloatArray, flags: Flags) -> ImuInterval:
        assert self._attitude is not None  # no interval is cut before the first attitude
        # _cut() has already counted this interval.
        f, count = self._config.filter, self._index - 1
        update = count % f.intervals_per_update == 0
        due = count % round(f.output_rate * HEIGHT_SECONDS) == 0
        height = self._pressures.at(table[-1, 0]) if due else None
        self.counts.pressure_silence = self._pressures.silence
        field_B = self._fields.at(table[-1, 0])
        attitudes = self._attitude.advance(table[:, 0], table[:, 1:4], table[:, 4:])
        self._windows.add(table, attitudes, flags)
        window = self._windows.window() if update else None
        R_NB = self._attitude.R_NB
        anew = self._fields.calibrated(table[-1, 0])
        return ImuInterval(table, R_NB, update, window, field_B, height, None, flags, anew)
