"""Updates with the network's displacements, including false ones, and what their innovations tell.

README.md, "Gates" (the alternative hypothesis: recent outliers share a steady error),
"Noise and the gyroscope's bias" (the accelerometer's factor, by stochastic approximation: Robbins
and Monro 1951) and "Fixes" (the network's turn, a Gauss-Markov state once fixes tell the direction;
without them it cannot be distinguished from the yaw, and is zero).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from stario.fusion.config import FilterConfig
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.ekf_state import EkfState, gauss_markov
from stario.fusion.filter.engine import GateMode, UpdateResult
from stario.fusion.filter.hypotheses import AlternativeHypothesis, HypothesisPair
from stario.fusion.filter.jacobians import CORE, plain_covariance
from stario.fusion.filter.network_errors import (
    FIRST_GAIN,
    ErrorLevel,
    displacement_errors,
    next_gain,
)
from stario.fusion.lie import yaw_rotation
from stario.fusion.state import changed
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.sequence import FloatArray

_RARE_SHARE, _RARE_POWER, _SHARE_SECONDS = 0.35, 4.0, 20.0
"""While less than this share of the last seconds' displacements were outliers, they are attributed
to the network and inflated by this power of NIS / gate; a filter that gates more of them may itself
be wrong. This bridges about five seconds of false displacements."""

_OFFSET_GAIN = 0.5
"""Share of the latest outlier's residual in the alternative's offset, which may turn with the
device."""

_OFFSET_SCALE = 10.0
"""Factor on the covariance of a displacement less the offset, which comes from such residuals."""

_ALTERNATIVE_GATE = 0.95
"""Probability of the chi-square test beyond which a displacement does not fit the alternative."""

TARGET_NIS = 0.3
"""Target for the median NIS per degree of freedom: the network's errors are correlated over
seconds, so consistent innovations are smaller than single errors."""

MAX_FACTOR = 15.0
"""Maximum noise factor: the accelerometer then rules out little more than jumps."""

_STEPS = 4
"""Number of noise factors per doubling, so that few different noise models are created."""

TURN_SECONDS = 60.0
"""Correlation time of the network's turn [s]."""


@dataclass(frozen=True)
class AccelNoiseScale:
    """Factor by which the accelerometer is noisier than configured.

    Attributes:
        log_factor: natural logarithm of the factor on its noise density.
        gain: step size for the next displacement.
    """

    log_factor: float = 0.0
    gain: float = FIRST_GAIN

    @property
    def factor(self) -> float:
        """Factor on the noise density, in steps."""
        return float(2.0 ** (round(_STEPS * self.log_factor / math.log(2.0)) / _STEPS))

    def updated(self, result: UpdateResult) -> AccelNoiseScale:
        """Return the scale after one displacement; unchanged if it has no innovation."""
        if not math.isfinite(result.gate_nis):
            return self
        ratio = (result.gate_nis / (TARGET_NIS * result.dof)) ** 2
        excess = 1.0 - 2.0 / (ratio + 1.0)
        log_factor = self.log_factor + self.gain * excess
        log_factor = min(max(log_factor, 0.0), math.log(MAX_FACTOR))
        return AccelNoiseScale(log_factor, next_gain(self.gain))


class DisplacementUpdates:
    """Displacement updates, and what is estimated from their innovations.

    Args:
        ekf: the filter.
        config: settings of the filter.

    Attributes:
        hypotheses: the filter, and the alternative to it.
        outlier_share: fraction of outliers among recent displacements.
        accel_noise: estimated scale of the accelerometer's noise.
        error_level: estimated level of the network's errors.
    """

    def __init__(self, ekf: StateCloningEkf, config: FilterConfig) -> None:
        self._ekf, self._config = ekf, config
        self.hypotheses = HypothesisPair(ekf)
        self.outlier_share = 0.5  # outliers are assumed common at first
        self.accel_noise = AccelNoiseScale()
        self.error_level = ErrorLevel()

    def update(
        self, slot: int, R_NB: FloatArray, d_N: FloatArray, covariance_N: FloatArray
    ) -> tuple[UpdateResult, tuple[float, ...]]:
        """Update with the displacement of the window that ends now.

        Return the outcome, and the times [s] of earlier displacements that were false after all.

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
        gain = 1.0 / (f.update_rate * _SHARE_SECONDS)
        self.outlier_share += gain * (result.gated - self.outlier_share)
        if f.adaptive:
            self.accel_noise = self.accel_noise.updated(result)
            if f.correlated_errors:
                self.error_level = self.error_level.updated(result)
        if self.hypotheses.alternative is None and rare and result.gated:
            assert result.residual is not None  # it has been compared with the gate
            first = AlternativeHypothesis(before, before.time, result.residual, (before.time,))
            self.hypotheses.alternative = first
        elif result.accepted:
            return result, self.hypotheses.compare(partial(_tested, update), not result.gated)
        return result, ()

    def _update(
        self,
        slot: int,
        R_NB: FloatArray,
        d_N: FloatArray,
        covariance_N: FloatArray,
        gate: float | None,
        gate_mode: GateMode = "inflate",
        power: float = 1.0,
        offset_W: FloatArray | None = None,
    ) -> UpdateResult:
        """Update the filter's current state, with the displacement less an offset (3,) [m]."""
        f = self._config
        self._ekf.state = propagated_turn(
            self._ekf.state, 1.0 / f.update_rate, f.network_turn_sigma
        )
        R_WN = yaw_rotation(self._ekf.state.clone_pose(slot)[0] @ R_NB.T)
        # Values that are not finite are rejected and counted by the filter.
        with np.errstate(invalid="ignore"):
            d_W, covariance_W = R_WN @ d_N, R_WN @ covariance_N @ R_WN.T
            if offset_W is not None:
                d_W, covariance_W = d_W - offset_W, _OFFSET_SCALE * covariance_W
            errors = None
            if f.correlated_errors and np.isfinite(covariance_W).all():
                level, has_turn = self.error_level.level, self._ekf.state.has_turn
                errors = displacement_errors(d_W, covariance_W, level, has_turn, f)
            limit = None if gate is None else chi2_quantile(gate, 3)
            return self._ekf.update_displacement(
                *(slot, None, d_W, f.overlap_scale * covariance_W),
                *(limit, gate_mode, power, errors),
            )


def _tested(
    update: Callable[..., UpdateResult], alternative: AlternativeHypothesis
) -> AlternativeHypothesis:
    """Update an alternative with a displacement: as it is if it fits, otherwise less the offset.

    Args:
        update: updates the filter's current state, which is the alternative's.
        alternative: the alternative.

    Returns:
        The alternative, with one more outlier if the displacement did not fit.
    """
    result = update(_ALTERNATIVE_GATE, "reject")
    if result.accepted or result.residual is None:
        return alternative
    offset_W = alternative.offset_W
    offset_W = offset_W + _OFFSET_GAIN * (result.residual - offset_W)
    update(None, offset_W=offset_W)
    outliers = (*alternative.outliers, alternative.ekf.time)
    return changed(alternative, offset_W=offset_W, outliers=outliers)


class TurnEstimate(NamedTuple):
    """A filter's estimate of the network's turn, for a graph that starts from its state."""

    turn: float
    """The turn [rad]."""
    covariance: FloatArray
    """(16,) covariance with the plain errors of the state (order of `NavState.covariance`), then
    the turn's variance."""


def turn_estimate(s: EkfState) -> TurnEstimate | None:
    """Return a filter's estimate of the network's turn; None while it is not estimated."""
    if not s.has_turn:
        return None
    rows = [*range(CORE), s.turn_row]
    P = plain_covariance(s.P[rows][:, rows], s.X[0, :, 3:].T)
    return TurnEstimate(s.network_turn, P[CORE])


def with_turn(s: EkfState, sigma: float) -> EkfState:
    """Return the state with the network's turn estimated from now on, with prior sigma [rad]."""
    if s.has_turn or sigma == 0.0:
        return s
    P = s.covariances.copy()
    P[:, s.turn_row, s.turn_row] = sigma**2
    return changed(s, covariances=P)


def propagated_turn(s: EkfState, seconds: float, sigma: float) -> EkfState:
    """Return the state with the network's turn propagated over a time [s], if it has one."""
    if not s.has_turn:
        return s
    correlation = math.exp(-seconds / TURN_SECONDS)
    P = gauss_markov(s.covariances, s.turn_row, correlation, sigma)
    return changed(s, covariances=P, network_turn=correlation * s.network_turn)
