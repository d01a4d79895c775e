"""Updates with the network's displacements, including false ones. README.md, "Gates"."""

from __future__ import annotations

from functools import partial

import numpy as np

from stario.fusion.config import FilterConfig
from stario.fusion.filter.accel_noise import AccelNoiseScale
from stario.fusion.filter.alternative import GATE as ALTERNATIVE_GATE
from stario.fusion.filter.alternative import AlternativeHypothesis, HypothesisPair
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.engine import GateMode, UpdateResult
from stario.fusion.filter.innovations import is_gated
from stario.fusion.filter.network_turn import propagated_turn
from stario.fusion.lie import yaw_rotation
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.sequence import FloatArray

_RARE_SHARE, _RARE_POWER, _SHARE_SECONDS = 0.35, 4.0, 20.0
"""While less than this share of the last seconds' displacements were outliers, they are attributed
to the network and inflated by this power of NIS / gate; a filter that gates more of them may itself
be wrong. This bridges about five seconds of false displacements."""


class DisplacementUpdates:
    """Displacement updates, and what is estimated from their innovations.

    Args:
        ekf: the filter.
        config: settings of the filter.

    Attributes:
        hypotheses: the filter, and the alternative without the outliers of the last seconds.
        outlier_share: fraction of outliers among recent displacements.
        accel_noise: estimated scale of the accelerometer's noise.
    """

    def __init__(self, ekf: StateCloningEkf, config: FilterConfig) -> None:
        self._ekf, self._config = ekf, config
        self.hypotheses = HypothesisPair(ekf)
        self.outlier_share = 0.5  # outliers are assumed common at first
        self.accel_noise = AccelNoiseScale()

    def update(
        self, slot: int, R_NB: FloatArray, d_N: FloatArray, covariance_N: FloatArray
    ) -> UpdateResult:
        """Update with the displacement of the window that ends now.

        Args:
            slot: slot of the clone at the window's start.
            R_NB: (3, 3) levelled attitude there, with which the window was prepared.
            d_N: (3,) displacement [m].
            covariance_N: (3, 3) covariance of the displacement [m^2].
        """
        f, before = self._config, self._ekf.state
        rare = self.outlier_share < _RARE_SHARE
        update = partial(self._update, slot, R_NB, d_N, covariance_N)
        result = update(f.gate, power=_RARE_POWER if rare else 1.0)
        gated = is_gated(result)
        gain = 1.0 / (f.update_rate * _SHARE_SECONDS)
        self.outlier_share += gain * (gated - self.outlier_share)
        if f.adaptive:
            self.accel_noise = self.accel_noise.updated(result)
        if self.hypotheses.alternative is None and rare and gated:
            self.hypotheses.alternative = AlternativeHypothesis(before, before.time)
        elif result.accepted:
            self.hypotheses.compare(lambda: update(ALTERNATIVE_GATE, "reject").accepted, not gated)
        return result

    def _update(
        self,
        slot: int,
        R_NB: FloatArray,
        d_N: FloatArray,
        covariance_N: FloatArray,
        gate: float,
        gate_mode: GateMode = "inflate",
        power: float = 1.0,
    ) -> UpdateResult:
        """Update the filter's current state."""
        f = self._config
        self._ekf.state = propagated_turn(
            self._ekf.state, 1.0 / f.update_rate, f.network_turn_sigma
        )
        R_WN = yaw_rotation(self._ekf.state.clone_pose(slot)[0] @ R_NB.T)
        # Values that are not finite are rejected and counted by the filter.
        with np.errstate(invalid="ignore"):
            covariance_W = R_WN @ (covariance_N * f.overlap_scale) @ R_WN.T
            return self._ekf.update_displacement(
                slot, None, R_WN @ d_N, covariance_W, chi2_quantile(gate, 3), gate_mode, power
            )
