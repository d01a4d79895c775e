"""Updates with the network's displacements; what outliers mean, and what innovations tell.

README.md, "Displacement measurement" and "Gates".
"""

from __future__ import annotations

from functools import partial

import numpy as np

from stario.fusion.config import FilterConfig
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.filter.hypotheses import AlternativeHypothesis, HypothesisPair
from stario.fusion.filter.network_errors import (
    InnovationStatistics,
    displacement_errors,
    propagated_turn,
)
from stario.fusion.imu.stateful import WindowDisplacement
from stario.fusion.lie import yaw_rotation
from stario.fusion.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.sequence import FloatArray

_RARE_SHARE, _RARE_POWER = 0.35, 4.0
"""While less than this share of recent displacements were outliers, they are attributed to the
network and inflated by this power of NIS / gate; a filter that gates more of them may itself be
wrong. This bridges about five seconds of false displacements."""

_OFFSET_GAIN = 0.5
"""Share of the latest outlier's residual in the alternative's offset, which may turn with the
device."""

_OFFSET_SCALE = 10.0
"""Factor on the covariance of a displacement less the offset, which comes from such residuals."""

_ALTERNATIVE_GATE = 0.95
"""Probability of the chi-square test beyond which a displacement does not fit the alternative."""


class DisplacementUpdates:
    """Displacement updates, and what is estimated from their innovations.

    Args:
        hypotheses: the filter and its alternative, which an outlier opens.
        config: settings of the filter.

    Attributes:
        statistics: what the innovations so far tell.
    """

    def __init__(self, hypotheses: HypothesisPair, config: FilterConfig) -> None:
        self._hypotheses, self._ekf, self._config = hypotheses, hypotheses.ekf, config
        self.statistics = InnovationStatistics()

    def update(
        self, slot: int, displacement: WindowDisplacement
    ) -> tuple[UpdateResult, tuple[float, ...]]:
        """Update with the displacement of the window that ends now.

        Return the outcome, and the times [s] of earlier displacements that were false after all.

        Args:
            slot: slot of the clone at the window's start.
            displacement: the displacement.
        """
        f, before = self._config, self._ekf.state
        self._hypotheses.apply_to_both(self._propagate_turn)
        rare = self.statistics.outlier_share < _RARE_SHARE
        result = self._apply(slot, displacement, f.gate, _RARE_POWER if rare else 1.0)
        self.statistics = self.statistics.updated(result, f)
        if self._hypotheses.alternative is None and rare and result.gated:
            assert result.residual is not None  # it has been compared with the gate
            first = AlternativeHypothesis(before, result.residual, (before.time,))
            self._hypotheses.alternative = first
        elif result.accepted:
            fits = self._fits_alternative(slot, displacement)
            return result, self._hypotheses.judge(fits, not result.gated)
        return result, ()

    def _fits_alternative(self, slot: int, displacement: WindowDisplacement) -> bool:
        """Update the alternative with a displacement: as it is if it fits, else less the offset.

        An alternative that is uncertain after some seconds would take any displacement for right,
        so one nearer to the offset than to zero does not fit.

        Return whether it fits.
        """
        alternative = self._hypotheses.alternative
        apply = partial(self._apply, slot, displacement)
        result = self._hypotheses.apply_to_alternative(partial(apply, _ALTERNATIVE_GATE, None))
        if result is None or alternative is None or result.residual is None:
            return True
        offset_W, residual = alternative.offset_W, result.residual
        nearer_offset = residual @ offset_W > 0.5 * offset_W @ offset_W
        if result.accepted and not nearer_offset:
            return True
        offset_W = offset_W + _OFFSET_GAIN * (residual - offset_W)
        outliers = (*alternative.outliers, alternative.ekf.time)
        self._hypotheses.alternative = changed(alternative, offset_W=offset_W, outliers=outliers)
        self._hypotheses.apply_to_alternative(partial(apply, None, None, offset_W))
        return False

    def _apply(
        self,
        slot: int,
        displacement: WindowDisplacement,
        gate: float | None,
        inflation: float | None,
        offset_W: FloatArray | None = None,
    ) -> UpdateResult:
        """Apply a displacement to the current state, in W and less an offset (3,) [m]."""
        f, (d_N, covariance_N, R_NB) = self._config, displacement
        R_WN = yaw_rotation(self._ekf.state.clone_pose(slot)[0] @ R_NB.T)
        # Values that are not finite are rejected and counted by the filter.
        with np.errstate(invalid="ignore"):
            d_W, covariance_W = R_WN @ d_N, R_WN @ covariance_N @ R_WN.T
            if offset_W is not None:
                d_W, covariance_W = d_W - offset_W, _OFFSET_SCALE * covariance_W
            errors = None
            if f.correlated_errors and np.isfinite(covariance_W).all():
                level, has_turn = self.statistics.error_level, self._ekf.state.has_turn
                errors = displacement_errors(d_W, covariance_W, level, has_turn, f)
            limit = None if gate is None else chi2_quantile(gate, 3)
            covariance_W = f.overlap_scale * covariance_W
            return self._ekf.update_displacement(slot, d_W, covariance_W, limit, inflation, errors)

    def _propagate_turn(self) -> None:
        f = self._config
        self._ekf.state = propagated_turn(
            self._ekf.state, 1.0 / f.update_rate, f.network_turn_sigma
        )
