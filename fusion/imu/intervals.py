"""What the front end hands on: intervals of samples, their start, and counts of the others."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from stario.fusion.changed import changed
from stario.fusion.imu.outliers import NO_FLAGS, Flags
from stario.fusion.state import Health
from stario.sequences.sequence import FloatArray


@dataclass(frozen=True, eq=False)
class Start:
    """Where the filter begins.

    Attributes:
        time: of the first sample [s].
        R_WB: (3, 3) as of `GravityStart`, so the next two.
        still: whether the device was at rest.
        force: mean size of the specific force [m/s^2].
        rate: of the samples, by their median step [Hz].
    """

    time: float
    R_WB: FloatArray
    still: bool
    force: float
    rate: float


@dataclass(frozen=True, eq=False)
class ImuInterval:
    """The stretch between two times of the grid.

    Attributes:
        time: (n + 1,) sample times, first and last are the grid's [s].
        gyro: (n + 1, 3) [rad/s] in B, interpolated at both ends.
        accel: (n + 1, 3) [m/s^2] in B, likewise.
        gap: True where no samples arrived for longer than is bridged; the samples then say nothing.
        anew: behind a long gap, the levelled attitude at its end, as at the very first sample.
        flags: whether samples of either sensor are saturated, missing, or were spikes.
        window_flagged: whether samples of the window's are.
        attitudes: (n + 1, 3, 3) levelled attitude R_NB at the samples.
        R_NB: (3, 3) levelled attitude at the end, gravity's correction applied.
        update: whether windows begin and end at this interval's end.
        window: (6, 200) the network's input that ends here, None where there is none.
        R_NB_window: (3, 3) levelled attitude at the window's start.
        heading: of the device in N, averaged over the window [rad].
        levelled_bias: size of the gyroscope's bias as far as gravity tells it [rad/s].
        levelled_bias_sigma: of it, per level axis [rad/s].
        field_B: (3,) magnetic field at its end [uT], None where none was measured.
        accel_factor: on the accelerometer's noise density, as the filter finds it.
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
        """What an estimator needs of it, without what only the network sees."""
        return changed(self, window=None, attitudes=_NO_ATTITUDES)

    @property
    def start(self) -> float:
        """Its first time [s]."""
        return float(self.time[0])

    @property
    def stop(self) -> float:
        """Its last time [s]."""
        return float(self.time[-1])


_NO_ATTITUDES = np.empty((0, 3, 3))

GAPS_LISTED = 100
"""How many gaps are kept one by one: an endless stream may have any number."""


LATE_SECONDS = 0.5
"""From so long a row of late samples on health says so [s]."""

UNFAMILIAR_SHARE = 0.3
"""From this share of unfamiliar windows on health says so; of training windows 0.05 are."""


@dataclass
class SampleCounts:
    """What became of the samples.

    Attributes:
        used: samples taken in.
        not_finite: dropped for a value that is not a number, infinite or absurdly large.
        frozen: dropped for repeating all values of those before, though not at rest.
        duplicate: dropped for repeating the newest time.
        out_of_order: dropped for a time before the newest.
        longest_late: for how long samples came out of order in a row, at most [s].
        future: dropped for a time ahead of those that followed.
        spike: used, but replaced for standing off its neighbours.
        saturated: used, but at the sensor's limit.
        field_dropped: magnetic fields dropped for a value or a time that is out of order.
        gap_count: stretches without samples that were not bridged.
        longest_gap: of them [s].
        gaps: (start, length) [s] of the newest `GAPS_LISTED` of them.
        windows: that the network was asked about.
        unfamiliar: of these outside what its weights were trained on.
        set_back: by how much a recording's clock was set back where its track ends [s].
    """

    used: int = 0
    not_finite: int = 0
    frozen: int = 0
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

    def add_gap(self, start: float, length: float) -> None:
        """Count a stretch without samples [s]."""
        self.gap_count += 1
        self.longest_gap = max(self.longest_gap, length)
        self.gaps = [*self.gaps, (start, length)][-GAPS_LISTED:]

    def health(self) -> Health:
        """The part of the report that tells of the samples."""
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
        elif self.longest_late > LATE_SECONDS:
            notes.append(
                f"samples came late for {self.longest_late:.1f} s in a row: twice, or from a clock "
                "that was set back; then as much time is missing, which no sigma knows"
            )
        if self.unfamiliar > UNFAMILIAR_SHARE * self.windows:
            share = self.unfamiliar / self.windows
            notes.append(
                f"{share:.0%} of the windows move unlike all that the weights were trained on: "
                "the network's sigma is widened there"
            )
        return notes
