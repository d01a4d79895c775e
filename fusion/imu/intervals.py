"""Output of the front end: IMU intervals, split at fixes, the start from gravity, sample counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stario.fusion.fixes import Fix
from stario.fusion.imu.frozen import Stopped
from stario.fusion.state import Health, changed
from stario.sequences.sequence import FloatArray


@dataclass(frozen=True, eq=False)
class Start:
    """Start of the filter, estimated from the first second of samples.

    Attributes:
        time: time of the first sample [s].
        R_WB: (3, 3) levelled attitude; this and the next two are those of `GravityStart`.
        still: whether the device was at rest.
        force: magnitude of the mean specific force [m/s^2].
        rate: sampling rate, from the median step [Hz].
    """

    time: float
    R_WB: FloatArray
    still: bool
    force: float
    rate: float


class Flags(NamedTuple):
    """Faults in a stretch of samples.

    Attributes:
        gyro: whether a sample of the gyroscope is saturated or was a spike.
        accel: the same for the accelerometer.
        spikes: number of samples replaced.
        saturated: number of samples at the limit.
        missing: whether samples are missing and were interpolated from those around them.
    """

    gyro: bool = False
    accel: bool = False
    spikes: int = 0
    saturated: int = 0
    missing: bool = False


NO_FLAGS = Flags()
"""No faults."""


@dataclass(frozen=True, eq=False)
class ImuInterval:
    """IMU samples between two times of the grid.

    Attributes:
        time: (n + 1,) sample times [s]; the first and the last are on the grid.
        gyro: (n + 1, 3) [rad/s] in B, interpolated at both ends.
        accel: (n + 1, 3) [m/s^2] in B, likewise.
        gap: whether this is a gap too long to be bridged; its samples then carry no information.
        restart: new start after a long gap, estimated as at the first sample; None elsewhere.
        flags: whether samples of either sensor are saturated, missing, or were spikes.
        window_flagged: whether any of the window's samples are.
        attitudes: (n + 1, 3, 3) levelled attitude R_NB at the samples.
        R_NB: (3, 3) levelled attitude at the end, after its correction by gravity.
        update: whether windows begin and end at this interval's end.
        window: (6, 200) network input that ends here; None if there is none.
        R_NB_window: (3, 3) levelled attitude at the window's start.
        heading: heading of the device in N, averaged over the window [rad].
        levelled_bias: magnitude of the gyroscope's bias as estimated from gravity [rad/s].
        levelled_bias_sigma: its standard deviation per level axis [rad/s].
        field_B: (3,) magnetic field at its end [uT]; None if none was measured.
        accel_factor: factor on the accelerometer's noise density, estimated by the filter.
    """

    time: FloatArray
    gyro: FloatArray
    accel: FloatArray
    gap: bool
    attitudes: FloatArray
    R_NB: FloatArray
    update: bool = False
    window: NDArray[np.float32] | None = None
    R_NB_window: FloatArray | None = None
    heading: float = 0.0
    levelled_bias: float = 0.0
    levelled_bias_sigma: float = 0.0
    field_B: FloatArray | None = None
    accel_factor: float = 1.0
    restart: Start | None = None
    flags: Flags = NO_FLAGS
    window_flagged: bool = False

    def without_window(self) -> ImuInterval:
        """Return a copy without the window and attitudes, which an estimator does not need."""
        return changed(self, window=None, attitudes=_NO_ATTITUDES)

    @property
    def start(self) -> float:
        """Time of the first sample [s]."""
        return float(self.time[0])

    @property
    def stop(self) -> float:
        """Time of the last sample [s]."""
        return float(self.time[-1])


_NO_ATTITUDES = np.empty((0, 3, 3))

_SAME_TIME = 1e-6
"""A fix within this time of an interval's start or end [s] counts as at it."""


def split_at_fixes(
    interval: ImuInterval, fixes: Sequence[Fix]
) -> list[tuple[ImuInterval | None, list[Fix]]]:
    """Split an interval at the times of its fixes; return each piece with the fixes at its end.

    Fixes at the start of the interval come first, with None as their piece.

    Args:
        interval: the interval.
        fixes: fixes with start <= time <= stop, in order.
    """
    pieces: list[tuple[ImuInterval | None, list[Fix]]] = []
    rest = interval
    for fix in fixes:
        if fix.time <= rest.start + _SAME_TIME:
            if not pieces:
                pieces.append((None, []))
        elif fix.time < rest.stop - _SAME_TIME:
            before, rest = split_at(rest, fix.time)
            pieces.append((before, []))
        else:
            break
        pieces[-1][1].append(fix)
    count = sum(len(due) for _, due in pieces)
    return [*pieces, (rest, list(fixes[count:]))]


def split_at(interval: ImuInterval, time: float) -> tuple[ImuInterval, ImuInterval]:
    """Split an interval at a time [s] inside it; the second part keeps window and update."""
    k = int(np.searchsorted(interval.time, time))
    weight = (time - interval.time[k - 1]) / (interval.time[k] - interval.time[k - 1])
    first: dict[str, Any] = {"time": np.append(interval.time[:k], time)}
    second: dict[str, Any] = {"time": np.append(time, interval.time[k:])}
    if second["time"][1] - time < 1e-9:
        second["time"] = np.append(time, interval.time[k + 1 :])
    for name in ("gyro", "accel"):
        values = getattr(interval, name)
        boundary = (1.0 - weight) * values[k - 1] + weight * values[k]
        first[name] = np.vstack([values[:k], boundary])
        second[name] = np.vstack([boundary, values[len(values) - len(second["time"]) + 1 :]])
    return changed(interval, **first, update=False, window=None, R_NB_window=None), changed(
        interval, **second
    )


GAPS_LISTED = 100
"""Maximum number of gaps listed one by one; an endless stream may have any number."""

LATE_NOTE_SECONDS = 0.5
"""Duration of consecutive late samples beyond which the health report notes them [s]."""

FIELD_DROPS_NOTED = 50
"""Number of dropped magnetic fields beyond which the health report notes them."""

UNFAMILIAR_SHARE = 0.3
"""Share of unfamiliar windows beyond which health notes them; 0.05 of training windows are."""


@dataclass
class SampleCounts:
    """Counts of the samples used, dropped and flagged, of gaps and of windows.

    Attributes:
        used: samples used.
        not_finite: dropped: a value is NaN, infinite or absurdly large.
        frozen: dropped: the values of both sensors, or of one alone, repeat those before, though
            the device is not at rest.
        frozen_gyro: those of them in which the gyroscope alone had stopped.
        frozen_accel: those of them in which the accelerometer alone had stopped.
        duplicate: dropped: the time repeats the newest.
        out_of_order: dropped: the time is before the newest.
        longest_late: longest duration of consecutive samples out of order [s].
        future: dropped: the time is ahead of later samples.
        spike: used, but replaced because they differ too much from their neighbours.
        saturated: used, but at the sensor's limit.
        field_dropped: magnetic fields dropped: a value or a time is wrong, or the sensor stopped.
        gap_count: stretches without samples longer than `MAX_IMU_GAP`.
        longest_gap: length of the longest [s].
        gaps: (start, length) [s] of the newest `GAPS_LISTED`.
        windows: windows given to the network.
        unfamiliar: those of them outside what its weights were trained on.
        set_back: amount by which a recording's clock was set back where its track ends [s].
    """

    used: int = 0
    not_finite: int = 0
    frozen: int = 0
    frozen_gyro: int = 0
    frozen_accel: int = 0
    duplicate: int = 0
    out_of_order: int = 0
    longest_late: float = 0.0
    future: int = 0
    spike: int = 0
    saturated: int = 0
    field_dropped: int = 0
    gap_count: int = 0
    longest_gap: float = 0.0
    gaps: list[tuple[float, float]] = field(default_factory=list)
    windows: int = 0
    unfamiliar: int = 0
    set_back: float = 0.0

    def add_frozen(self, stopped: Stopped) -> None:
        """Count a sample in which sensors had stopped."""
        self.frozen += 1
        self.frozen_gyro += stopped == "gyroscope"
        self.frozen_accel += stopped == "accelerometer"

    def add_gap(self, start: float, length: float) -> None:
        """Count a stretch without samples [s]."""
        self.gap_count += 1
        self.longest_gap = max(self.longest_gap, length)
        self.gaps = [*self.gaps, (start, length)][-GAPS_LISTED:]

    def health(self) -> Health:
        """Return the part of the health report that concerns the samples."""
        names = ("used", "not_finite", "frozen", "duplicate", "out_of_order", "future")
        return Health(
            samples={name: getattr(self, name) for name in names},
            flagged={"spike": self.spike, "saturated": self.saturated},
            gap_count=self.gap_count,
            longest_gap=self.longest_gap,
            gaps=list(self.gaps),
            notes=self._notes(),
        )

    def _notes(self) -> list[str]:
        notes = []
        if self.set_back:
            notes.append(
                f"the recording's clock was set back by {self.set_back:.3g} s: the track ends there"
            )
        elif self.longest_late > LATE_NOTE_SECONDS:
            notes.append(
                f"samples arrived late for {self.longest_late:.1f} s in a row: logged twice, or "
                "from a clock that was set back; if so, that time is missing and no sigma covers it"
            )
        for count, sensor, other in (
            (self.frozen_gyro, "gyroscope", "accelerometer"),
            (self.frozen_accel, "accelerometer", "gyroscope"),
        ):
            if count:
                notes.append(
                    f"the {sensor} stopped: it repeats its value in {count} samples in which the "
                    f"{other} shows motion; they were dropped"
                )
        if self.field_dropped > FIELD_DROPS_NOTED:
            notes.append(
                f"{self.field_dropped} magnetic fields were dropped: the sensor repeated its last "
                "value, or their times or values are wrong"
            )
        if self.unfamiliar > UNFAMILIAR_SHARE * self.windows:
            share = self.unfamiliar / self.windows
            notes.append(
                f"{share:.0%} of the windows move unlike anything the weights were trained on: "
                "the network's sigma is widened there"
            )
        return notes
