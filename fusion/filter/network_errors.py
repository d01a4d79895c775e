"""Models of the network's errors, and what the innovations tell about them.

The gains take the error of each displacement for white. In truth part of it decays within seconds,
and part lasts all along a track, which only covariances contain: README.md, "Correlated errors".
A rotation of all displacements is a Gauss-Markov state once fixes tell the direction; without them
it cannot be distinguished from the yaw, and is zero: "Fixes". The innovations adapt the level of
the errors and the noise that the accelerometer must have beside them, by stochastic approximation
(Robbins and Monro 1951): "Noise and the gyroscope's bias".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from stario.fusion.config import FilterConfig
from stario.fusion.filter.ekf_state import CONSIDERED_SECONDS, EkfState
from stario.fusion.filter.jacobians import CORE, plain_covariance
from stario.fusion.filter.kalman import UpdateResult, gauss_markov
from stario.fusion.imu.stateful import slope_variance
from stario.fusion.state import changed
from stario.sequences.sequence import FloatArray

WHITE, DRIFTING, LASTING = 0.35, 0.25, 0.15
"""Variances of the errors as fractions of the covariance that the network predicts: of those that
are independent, of those that decay within seconds, and of those along and across the displacement
that last. In unknown people's recordings the normalised errors have a variance of 0.5 to 1 and
autocorrelations of 0.2 to 0.4 after a second, 0.05 to 0.25 from five seconds to a minute."""

ACCEL_SHARE = 0.025
"""Actual variance of the accelerometer's noise as a fraction of that assumed for the gains, which
is so large because the network's errors are correlated."""

_SHORT = 0.5
"""Displacement [m] below which errors along and across it are in proportion to it: a slow one has
hardly a direction."""

GAIN, FIRST_GAIN = 0.05, 0.2
"""Step per displacement of a logarithm that is estimated from innovations: in the long run, and for
the first one."""

_MAX_EXCESS = 4.0
"""Largest excess of NIS over its expectation that counts for the level."""

MIN_LEVEL, MAX_LEVEL = 0.1, 5.0
"""Bounds of the level."""

TARGET_NIS = 0.3
"""Target for the median NIS per degree of freedom: the network's errors are correlated over
seconds, so consistent innovations are smaller than single errors."""

MAX_FACTOR = 15.0
"""Maximum noise factor: the accelerometer then rules out little more than jumps."""

_STEPS = 4
"""Number of noise factors per doubling, so that few different noise models are created."""

_SHARE_SECONDS = 20.0
"""Time over which the share of outliers is averaged [s]."""

TURN_SECONDS = 60.0
"""Correlation time of the network's turn [s]."""


class DisplacementErrors(NamedTuple):
    """Errors of one displacement.

    Attributes:
        white: (3, 3) covariance of those that are independent of other displacements' [m^2].
        considered: (3, 6) sensitivity to the considered ones, of unit variance [m].
    """

    white: FloatArray
    considered: FloatArray


@dataclass(frozen=True)
class InnovationStatistics:
    """What the innovations of the displacements so far tell.

    Attributes:
        outlier_share: fraction of outliers among recent ones, which are assumed common at first.
        log_accel_factor: natural logarithm of the factor on the accelerometer's noise density.
        log_error_level: that of `error_level`.
        gain: step of both logarithms for the next displacement.
    """

    outlier_share: float = 0.5
    log_accel_factor: float = 0.0
    log_error_level: float = 0.0
    gain: float = FIRST_GAIN

    @property
    def accel_factor(self) -> float:
        """Factor by which the accelerometer is noisier than configured, in steps."""
        return float(2.0 ** (round(_STEPS * self.log_accel_factor / math.log(2.0)) / _STEPS))

    @property
    def error_level(self) -> float:
        """Variance of the errors that change within seconds, relative to the predicted one."""
        return math.exp(self.log_error_level)

    def updated(self, result: UpdateResult, f: FilterConfig) -> InnovationStatistics:
        """Return the statistics after one displacement, which may have no innovation."""
        change = (result.gated - self.outlier_share) / (f.update_rate * _SHARE_SECONDS)
        counted = changed(self, outlier_share=self.outlier_share + change)
        if not (f.adaptive and math.isfinite(result.nis + result.gate_nis)):
            return counted
        ratio = (result.gate_nis / (3.0 * TARGET_NIS)) ** 2
        step = self.gain * (1.0 - 2.0 / (ratio + 1.0))
        factor = min(max(self.log_accel_factor + step, 0.0), math.log(MAX_FACTOR))
        level = self.log_error_level
        if f.correlated_errors:
            level += self.gain * min(result.nis / 3.0 - 1.0, _MAX_EXCESS)
            level = min(max(level, math.log(MIN_LEVEL)), math.log(MAX_LEVEL))
        # The gains are 1/5, 1/6, 1/7, ... down to `GAIN` (Robbins and Monro 1951).
        gain = max(1.0 / (1.0 / self.gain + 1.0), GAIN)
        return changed(counted, log_accel_factor=factor, log_error_level=level, gain=gain)


def displacement_errors(
    d_W: FloatArray, covariance: FloatArray, level: float, turn_is_estimated: bool, f: FilterConfig
) -> DisplacementErrors:
    """Return the errors of a displacement.

    Args:
        d_W: (3,) displacement [m].
        covariance: (3, 3) its covariance as inferred, in the same axes [m^2].
        level: factor on the variance of the errors that change within seconds.
        turn_is_estimated: whether a state contains the error across the displacement already.
        f: settings of the filter.
    """
    predicted = 2.0 * f.covariance_scale * covariance
    climb = 2.0 * f.covariance_scale * slope_variance(d_W)
    predicted[2, 2] = max(predicted[2, 2] - climb, 1e-9)
    H = np.zeros((3, len(CONSIDERED_SECONDS)))
    # The symmetric root of the horizontal part: the errors do not depend on the axes. Roots of
    # negative numbers belong to an invalid covariance, which the update refuses.
    (a, b, _), (_, c, _), (_, _, height) = (level * DRIFTING * predicted).tolist()
    det = math.sqrt(max(a * c - b * b, 0.0))
    root = math.sqrt(max(a + c + 2.0 * det, 0.0))
    if root > 0.0:
        H[0, 0], H[1, 1], H[0, 1] = (a + det) / root, (c + det) / root, b / root
        H[1, 0], H[2, 2] = H[0, 1], math.sqrt(height)
    x, y, _ = d_W.tolist()
    length = math.hypot(x, y)
    if length > 0.0:
        (a, b, _), (_, c, _), _ = predicted.tolist()
        share = math.sqrt(LASTING) / (length * max(length, _SHORT))
        along = share * math.sqrt(max(a * x * x + 2.0 * b * x * y + c * y * y, 0.0))
        H[0, 3], H[1, 3] = along * x, along * y
        if not turn_is_estimated:
            across = share * math.sqrt(max(a * y * y - 2.0 * b * x * y + c * x * x, 0.0))
            H[0, 4], H[1, 4] = -across * y, across * x
    H[2, -1] = math.sqrt(climb)
    overlap = f.overlap_scale / (2.0 * f.covariance_scale)  # a window's errors repeat in the next
    return DisplacementErrors(level * WHITE * overlap * predicted, H)


def with_considered_propagated(s: EkfState) -> EkfState:
    """Return the state with its considered errors propagated from their own time to the state's.

    Each takes a Gauss-Markov step of unit variance. Only displacements ask for them.
    """
    kept = np.exp((s.considered_time - s.time) / CONSIDERED_SECONDS)
    actual = gauss_markov(s.P_actual, s.considered_rows, kept, 1.0)
    return changed(s, covariances=np.array((s.P, actual)), considered_time=s.time)


class TurnEstimate(NamedTuple):
    """A filter's estimate of the network's turn, for a graph that starts from its state."""

    turn: float
    """The turn [rad]."""
    covariance: FloatArray
    """(16, 16) of the plain errors of the state (order of `NavState.covariance`) and the turn."""


def turn_estimate(s: EkfState) -> TurnEstimate | None:
    """Return a filter's estimate of the network's turn; None while it is not estimated."""
    if not s.has_turn:
        return None
    rows = [*range(CORE), s.turn_row]
    P = plain_covariance(s.P[rows][:, rows], s.X[0, :, 3:].T)
    return TurnEstimate(s.network_turn, P)


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
    rows = slice(s.turn_row, s.turn_row + 1)
    P = gauss_markov(s.covariances, rows, np.array([correlation]), sigma)
    return changed(s, covariances=P, network_turn=correlation * s.network_turn)
