"""What became of an estimator's measurements, and its innovations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from stario.fusion.changed import changed
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.imu.intervals import SampleCounts
from stario.fusion.state import Health, Innovations, NavState


@dataclass(frozen=True)
class UpdateCounts:
    """Updates by what became of them; every one of `add_...` gives a new value.

    Attributes:
        offered: network measurements.
        gated: of these, outliers: left out or inflated.
        refused: network measurements left out, by reason.
        fixes: applied (of these gated), and left out by reason.
        zero_velocity: likewise, of measurements at rest.
        bearings: likewise, of the magnetic field's, and whether it told north.
        nis_sum: of the network measurements that could be judged.
        nis_count: how many these are.
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
        """One more measurement of the network's."""
        offered = self.offered + 1
        if result.residual is None:
            return changed(self, offered=offered, refused=counted(self.refused, result.reason))
        return changed(
            self,
            offered=offered,
            gated=self.gated + is_gated(result),
            nis_sum=self.nis_sum + result.nis,
            nis_count=self.nis_count + 1,
        )

    def add_fix(self, result: UpdateResult) -> UpdateCounts:
        """One more fix."""
        fixes = counted(self.fixes, "applied" if result.accepted else result.reason)
        if result.accepted and result.scale > 1.0:
            fixes = counted(fixes, "gated")
        return changed(self, fixes=fixes)

    def add_zero_velocity(self, result: UpdateResult) -> UpdateCounts:
        """One more measurement at rest."""
        what = "applied" if result.accepted else result.reason
        return changed(self, zero_velocity=counted(self.zero_velocity, what))

    def add_bearing(self, result: UpdateResult) -> UpdateCounts:
        """One more bearing of the magnetic field."""
        bearings = counted(self.bearings, "applied" if result.accepted else result.reason)
        if result.accepted and result.scale > 1.0:
            bearings = counted(bearings, "gated")
        return changed(self, bearings=bearings)

    def add_north(self) -> UpdateCounts:
        """The magnetic field told where north is."""
        return changed(self, bearings=counted(self.bearings, "north"))

    def health(self, counts: SampleCounts, state: NavState) -> Health:
        """The report: what became of the samples, of the updates, and the state's sigmas."""
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
    """A row for `stacked`; None of a measurement that made no sense."""
    if result.residual is None or result.sigma is None:
        return None
    return time, *result.residual, *result.sigma, result.nis, float(is_gated(result))


def stacked(rows: list[tuple[float, ...]]) -> Innovations:
    """Innovations from their rows."""
    table = np.array(rows).reshape(-1, 9)
    return Innovations(
        time=table[:, 0],
        residual_W=table[:, 1:4],
        sigma=table[:, 4:7],
        nis=table[:, 7],
        gated=table[:, 8] > 0.5,
    )


def is_gated(result: UpdateResult) -> bool:
    """Whether a measurement counts as an outlier, left out or inflated."""
    return result.reason == "gated" or result.scale > 1.0


def counted(counts: Mapping[str, int], reason: str) -> dict[str, int]:
    """The counts with one more of a reason."""
    return {**counts, reason: counts.get(reason, 0) + 1}
