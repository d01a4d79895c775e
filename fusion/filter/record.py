"""What an estimator's step did, interval by interval, and counts of its updates."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from copy import deepcopy
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stario.fusion.filter.corrections import CORRECTIONS_LISTED, Correction
from stario.fusion.filter.estimates import Estimate
from stario.fusion.filter.gained import Gained
from stario.fusion.filter.height import resting_in_lift, yielding
from stario.fusion.filter.kalman import UpdateResult
from stario.fusion.filter.zero_velocity import ZeroVelocity
from stario.fusion.imu.inference import WindowDisplacement
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.imu.preintegration import Segment
from stario.fusion.values.fixes import Accepted, Fix
from stario.fusion.values.health import Health
from stario.fusion.values.state import Innovations, NavState, changed


class Record(NamedTuple):
    """An IMU interval, the measurements applied in it, and the estimate at its end."""

    interval: ImuInterval
    accel_factor: float
    """Factor on the accelerometer's noise density."""
    segment: Segment | None
    """The preintegrated samples; None for a gap, and if fixes split them."""
    offered: WindowDisplacement | None
    """Predicted displacement of the window ending here; None if no window ends, or at rest."""
    outcome: UpdateResult | None
    """Outcome of the update with it; None without one."""
    rejected_later: tuple[float, ...]
    """Times of earlier displacements that were false after all [s] (README.md, "Gates")."""
    zero_velocity: ZeroVelocity | None
    """Measurement at rest; None if the device moved or the measurement was rejected."""
    bearing: Gained | None
    """What a magnetic bearing told about attitude and bias; None without one."""
    fixes: list[Accepted]
    """Fixes applied, in order."""
    without_yaw: list[Fix]
    """Fixes refused because the track's direction in the map was not known yet."""
    estimate: Estimate
    """The estimate at the end."""
    released: Estimate | None
    """The pose that has just left the window, corrected by all of it; None if none has."""
    climb_rate: float | None = None
    """Vertical speed by the pressure while one climbs [m/s], 0 on a floor; None without one."""

    def at_rate(self, rate: float | None) -> Record:
        """Return the record with measurements that yield to the pressure at a vertical speed."""
        if rate is None:
            return self
        offered, rest = self.offered, self.zero_velocity
        return self._replace(
            offered=offered and yielding(offered, rate),
            zero_velocity=rest and (resting_in_lift(rest) if rate else rest),
        )

    @property
    def displacement(self) -> WindowDisplacement | None:
        """The displacement with its inflated covariance; None if there is none or it is refused."""
        if self.offered is None or self.outcome is None or not self.outcome.accepted:
            return None
        covariance_N = self.outcome.scale * self.offered.covariance_N
        return self.offered._replace(covariance_N=covariance_N)


@dataclass(frozen=True)
class UpdateCounts:
    """Counts of updates by outcome; never modified in place.

    Attributes:
        offered: number of network measurements.
        gated: number of these that were outliers, rejected or inflated.
        refused: numbers of these that were invalid, by reason.
        fixes: numbers of fixes applied (of these gated), and refused by reason.
        zero_velocity: numbers of measurements at rest applied, and refused by reason.
        bearings: numbers of magnetic bearings, likewise; 1 under "north" if they determined it.
        pressures: numbers of heights by the pressure, likewise; "steps" counts the air's steps.
        nis_sum: sum of the NIS of all valid network measurements.
        nis_count: number of valid network measurements.
        corrections: the latest large corrections.
    """

    offered: int = 0
    gated: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    fixes: Mapping[str, int] = field(default_factory=dict)
    zero_velocity: Mapping[str, int] = field(default_factory=dict)
    bearings: Mapping[str, int] = field(default_factory=dict)
    pressures: Mapping[str, int] = field(default_factory=dict)
    nis_sum: float = 0.0
    nis_count: int = 0
    corrections: tuple[Correction, ...] = ()

    @property
    def gating(self) -> object:
        """Outcomes of displacement and zero-velocity updates, which a late fix may change."""
        return self.gated, self.refused, self.zero_velocity

    def add_correction(self, found: Correction | None) -> UpdateCounts:
        """Return the counts with one more correction, if there is one."""
        if found is None:
            return self
        return changed(self, corrections=(*self.corrections, found)[-CORRECTIONS_LISTED:])

    def add_displacement(self, result: UpdateResult) -> UpdateCounts:
        """Return the counts with one more network measurement."""
        counts = changed(self, offered=self.offered + 1)
        if result.residual is None:
            return counts.add("refused", result.reason)
        return changed(
            counts,
            gated=self.gated + result.gated,
            nis_sum=self.nis_sum + result.nis,
            nis_count=self.nis_count + 1,
        )

    def add(self, kind: str, *outcomes: str) -> UpdateCounts:
        """Return the counts with one more of each outcome in the attribute named `kind`."""
        counts = dict(getattr(self, kind))
        for outcome in outcomes:
            counts[outcome] = counts.get(outcome, 0) + 1
        return changed(self, **{kind: counts})

    def health(self, counts: Health, state: NavState) -> Health:
        """Return the health report: outcomes of samples and updates, and the state's sigmas."""
        groups = {
            "tilt_rad": slice(0, 2),
            "yaw_rad": slice(2, 3),
            "velocity_m_s": slice(3, 6),
            "position_m": slice(6, 8),
            "height_m": slice(8, 9),
            "gyro_bias_rad_s": slice(9, 12),
            "accel_bias_m_s2": slice(12, 15),
        }
        # The largest in any direction, not along an axis: W's yaw is arbitrary.
        variance = {
            name: np.linalg.eigvalsh(state.covariance[part, part])[-1]
            for name, part in groups.items()
        }
        return changed(
            deepcopy(counts),
            updates=self.offered,
            gated=self.gated,
            refused=dict(self.refused),
            mean_nis=self.nis_sum / self.nis_count if self.nis_count else math.nan,
            fixes=dict(self.fixes),
            zero_velocity=dict(self.zero_velocity),
            bearings=dict(self.bearings),
            pressures=dict(self.pressures),
            corrections=list(self.corrections),
            final_sigma={name: math.sqrt(max(value, 0.0)) for name, value in variance.items()},
        )


def innovations_of(records: Iterable[Record]) -> Innovations:
    """Return the innovations of all valid displacements."""
    rows = [
        (m.interval.stop, *m.outcome.residual, *m.outcome.sigma, m.outcome.nis, m.outcome.gated)
        for m in records
        if m.outcome is not None and m.outcome.residual is not None and m.outcome.sigma is not None
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 9)
    return Innovations(
        time=table[:, 0],
        residual_W=table[:, 1:4],
        sigma=table[:, 4:7],
        nis=table[:, 7],
        gated=table[:, 8] > 0.5,
    )
