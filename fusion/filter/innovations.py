"""Innovations of an estimator's updates and their statistics, in memory that need not grow."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from stario.fusion.filter.engine import UpdateResult
from stario.fusion.imu.intervals import IntakeCounts
from stario.fusion.state import Health, Innovations, NavState


class InnovationLog:
    """What became of the network's measurements, the fixes and the rests.

    Args:
        keep_rows: False for streams, whose memory must not grow.
    """

    def __init__(self, keep_rows: bool) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._keep_rows = keep_rows
        self.offered = self.gated = 0
        self.refused: dict[str, int] = {}
        self.fixes: dict[str, int] = {}
        self.rests: dict[str, int] = {}
        self._nis_sum, self._nis_count = 0.0, 0

    def add(self, time: float, result: UpdateResult) -> None:
        """Note what became of a network measurement at a time [s]."""
        self.offered += 1
        if result.residual is None or result.sigma is None:
            count(self.refused, result.reason)
            return
        gated = is_gated(result)
        self.gated += gated
        self._nis_sum += result.nis
        self._nis_count += 1
        if self._keep_rows:
            self._rows.append((time, *result.residual, *result.sigma, result.nis, float(gated)))

    def add_fix(self, result: UpdateResult) -> None:
        """Note what became of a fix."""
        if not result.accepted:
            count(self.fixes, result.reason)
            return
        count(self.fixes, "applied")
        if result.scale > 1.0:
            count(self.fixes, "gated")

    def add_rest(self, result: UpdateResult) -> None:
        """Note what became of a measurement at rest."""
        count(self.rests, "applied" if result.accepted else result.reason)

    def stacked(self) -> Innovations:
        """Every innovation kept."""
        table = np.array(self._rows).reshape(-1, 9)
        return Innovations(
            time=table[:, 0],
            residual_W=table[:, 1:4],
            sigma=table[:, 4:7],
            nis=table[:, 7],
            gated=table[:, 8] > 0.5,
        )

    def health(self, counts: IntakeCounts, state: NavState) -> Health:
        """The report so far: what the intake counted, what is noted here, the state's sigmas."""
        sigma = np.sqrt(np.diag(state.covariance))
        groups = {
            "tilt_rad": sigma[0:2],
            "yaw_rad": sigma[2:3],
            "velocity_m_s": sigma[3:6],
            "position_m": sigma[6:9],
            "gyro_bias_rad_s": sigma[9:12],
            "accel_bias_m_s2": sigma[12:15],
        }
        return replace(
            counts.health(),
            updates=self.offered,
            gated=self.gated,
            refused=dict(self.refused),
            mean_nis=self._nis_sum / self._nis_count if self._nis_count else math.nan,
            fixes=dict(self.fixes),
            rests=dict(self.rests),
            final_sigma={name: float(np.max(values)) for name, values in groups.items()},
        )

    def checkpoint(self) -> dict[str, Any]:
        """Everything that `rewind` needs; rows are not among it, for streams keep none."""
        return {
            "offered": self.offered,
            "gated": self.gated,
            "refused": dict(self.refused),
            "fixes": dict(self.fixes),
            "rests": dict(self.rests),
            "nis": [self._nis_sum, self._nis_count],
        }

    def rewind(self, checkpoint: dict[str, Any]) -> None:
        """Go back to a checkpoint."""
        self.offered, self.gated = checkpoint["offered"], checkpoint["gated"]
        self.refused = dict(checkpoint["refused"])
        self.fixes, self.rests = dict(checkpoint["fixes"]), dict(checkpoint["rests"])
        self._nis_sum, self._nis_count = checkpoint["nis"]


def is_gated(result: UpdateResult) -> bool:
    """Whether a measurement was taken for an outlier, left out or inflated."""
    return result.reason == "gated" or result.scale > 1.0


def count(counts: dict[str, int], reason: str) -> None:
    """One more of a reason."""
    counts[reason] = counts.get(reason, 0) + 1
