"""Outcomes of an estimator's measurements, and its innovations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stario.fusion.filter.engine import UpdateResult
from stario.fusion.imu.intervals import SampleCounts
from stario.fusion.state import Health, Innovations, NavState, changed


@dataclass(frozen=True)
class UpdateCounts:
    """Counts of updates by outcome; each `add_...` method returns a new value.

    Attributes:
        offered: number of network measurements.
        gated: number of these that were outliers, rejected or inflated.
        refused: numbers of these that were invalid, by reason.
        fixes: numbers of fixes applied (of these gated), and refused by reason.
        zero_velocity: numbers of measurements at rest applied, and refused by reason.
        bearings: numbers of magnetic bearings, likewise; 1 under "north" if they determined it.
        nis_sum: sum of the NIS of all valid network measurements.
        nis_count: number of valid network measurements.
    """

    offered: int = 0
    gated: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    fixes: Mapping[str, int] = field(default_factory=dict)
    zero_velocity: Mapping[str, int] = field(default_factory=dict)
    bearings: Mapping[str, int] = field(default_factory=dict)
    nis_sum: float = 0.0
    nis_count: int = 0

    def add_displacement(self, result: UpdateResult) -> UpdateCounts:
        """Return the counts with one more network measurement."""
        offered = self.offered + 1
        if result.residual is None:
            return changed(self, offered=offered, refused=incremented(self.refused, result.reason))
        return changed(
            self,
            offered=offered,
            gated=self.gated + is_gated(result),
            nis_sum=self.nis_sum + result.nis,
            nis_count=self.nis_count + 1,
        )

    def add_fix(self, result: UpdateResult) -> UpdateCounts:
        """Return the counts with one more fix."""
        fixes = incremented(self.fixes, "applied" if result.accepted else result.reason)
        if result.accepted and result.scale > 1.0:
            fixes = incremented(fixes, "gated")
        return changed(self, fixes=fixes)

    def add_zero_velocity(self, result: UpdateResult) -> UpdateCounts:
        """Return the counts with one more measurement at rest."""
        outcome = "applied" if result.accepted else result.reason
        return changed(self, zero_velocity=incremented(self.zero_velocity, outcome))

    def add_bearing(self, result: UpdateResult) -> UpdateCounts:
        """Return the counts with one more bearing of the magnetic field."""
        bearings = incremented(self.bearings, "applied" if result.accepted else result.reason)
        if result.accepted and result.scale > 1.0:
            bearings = incremented(bearings, "gated")
        return changed(self, bearings=bearings)

    def add_north(self) -> UpdateCounts:
        """Return the counts with north determined by the magnetic field."""
        return changed(self, bearings=incremented(self.bearings, "north"))

    def health(self, counts: SampleCounts, state: NavState) -> Health:
        """Return the health report: outcomes of samples and updates, and the state's sigmas."""
        sigma = np.sqrt(np.diag(state.covariance))
        groups = {
            "tilt_rad": sigma[0:2],
            "yaw_rad": sigma[2:3],
            "velocity_m_s": sigma[3:6],
            "position_m": sigma[6:8],
            "height_m": sigma[8:9],
            "gyro_bias_rad_s": sigma[9:12],
            "accel_bias_m_s2": sigma[12:15],
        }
        return changed(
            counts.health(),
            updates=self.offered,
            gated=self.gated,
            refused=dict(self.refused),
            mean_nis=self.nis_sum / self.nis_count if self.nis_count else math.nan,
            fixes=dict(self.fixes),
            zero_velocity=dict(self.zero_velocity),
            bearings=dict(self.bearings),
            final_sigma={name: float(np.max(values)) for name, values in groups.items()},
        )


def innovation_row(time: float, result: UpdateResult) -> tuple[float, ...] | None:
    """Return a row for `innovations_from_rows`; None for an invalid measurement."""
    if result.residual is None or result.sigma is None:
        return None
    return time, *result.residual, *result.sigma, result.nis, float(is_gated(result))


def innovations_from_rows(rows: list[tuple[float, ...]]) -> Innovations:
    """Return innovations from their rows."""
    table = np.array(rows).reshape(-1, 9)
    return Innovations(
        time=table[:, 0],
        residual_W=table[:, 1:4],
        sigma=table[:, 4:7],
        nis=table[:, 7],
        gated=table[:, 8] > 0.5,
    )


def is_gated(result: UpdateResult) -> bool:
    """Return whether a measurement counts as an outlier, rejected or inflated."""
    return result.reason == "gated" or result.scale > 1.0


def incremented(counts: Mapping[str, int], reason: str) -> dict[str, int]:
    """Return the counts with that of a reason incremented."""
    return {**counts, reason: counts.get(reason, 0) + 1}
