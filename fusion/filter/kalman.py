"""The linear update of an error state with two covariances, and their propagation.

There are two of them: P, as assumed for the gains, and the covariance of the error that these gains
leave (Gelb 1974, ch. 7: covariance analysis of a filter whose model is not the truth). They differ
only by errors that updates consider without estimating them, whose rows of P are zero, and by white
noise that is smaller than assumed. README.md, "Correlated errors" and "Gates".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.jacobians import ACTUAL, ASSUMED, CORE, Block, symmetric
from stario.fusion.state import changed
from stario.sequences.sequence import FloatArray

_JOSEPH_RATIO = 1e9
"""Ratio of innovation to measurement variance above which differences of P lose their digits."""


class UpdateResult(NamedTuple):
    """Outcome of one measurement.

    Attributes:
        reason: why the measurement was rejected; empty if it was accepted.
        nis: normalised innovation squared under the covariance of the error, before any
            inflation; its expectation is m. NaN if it could not be computed.
        scale: factor by which the measurement covariance was inflated (1: not gated).
        residual: (m,) measured minus predicted; None if the measurement was invalid.
        sigma: (m,) standard deviations of the residual under the covariance of the error; None
            likewise.
        gate_nis: the same NIS under the covariance that determined the gain (`gains_from`), which
            is what gates.
    """

    reason: str = ""
    nis: float = math.nan
    scale: float = 1.0
    residual: FloatArray | None = None
    sigma: FloatArray | None = None
    gate_nis: float = math.nan

    @property
    def accepted(self) -> bool:
        """Whether the state was updated; a rejected measurement leaves it unchanged."""
        return not self.reason

    @property
    def gated(self) -> bool:
        """Whether it counts as an outlier, rejected or inflated."""
        return self.reason == "gated" or self.scale > 1.0

    @property
    def outcomes(self) -> tuple[str, ...]:
        """What reports count: "applied", if inflated also "gated"; otherwise the reason."""
        if not self.accepted:
            return (self.reason,)
        return ("applied", "gated") if self.gated else ("applied",)


class Linear(NamedTuple):
    """A measurement that is linear in the error: residual = H error + noise."""

    residual: FloatArray
    """(m,) measured minus predicted."""
    blocks: Sequence[Block]
    """H, as blocks (first column, (m, width)); columns in no block are zero."""
    covariance: FloatArray
    """(m, m) R, as assumed for the gains."""
    noise: FloatArray | None = None
    """(m, m) R as it is, if that is another: R then also stands for considered errors."""


def predict(covariances: FloatArray, transition: FloatArray, noise: FloatArray) -> FloatArray:
    """Return covariances (2, n, n) after a transition (15, 15) with noises (2, 15, 15)."""
    P = covariances.copy()
    P[:, :CORE] = transition @ P[:, :CORE]
    P[:, CORE:, :CORE] = P[:, :CORE, CORE:].transpose(0, 2, 1)
    P[:, :CORE, :CORE] = symmetric(P[:, :CORE, :CORE] @ transition.T + noise)
    return P


def update(
    s: EkfState,
    measured: Linear,
    gate: float | None = None,
    inflation: float | None = 1.0,
    gains_from: int = ASSUMED,
) -> tuple[EkfState, UpdateResult]:
    """Update a state with a measurement.

    Args:
        s: the state.
        measured: the measurement.
        gate: NIS above which it counts as an outlier; None for no gate.
        inflation: an outlier's covariance is multiplied by this power of NIS / gate, so that a run
            of outliers can still correct a wrong filter; None rejects outliers.
        gains_from: which covariance determines the gains: `ASSUMED` or `ACTUAL`.

    Returns:
        The state and the outcome. Values that are not finite and covariances that are not positive
        definite are rejected with a reason; the state is then the one given.
    """
    residual, blocks, covariance, noise = measured
    if reason := fault_of(residual, covariance):
        return s, UpdateResult(reason)
    P = s.covariances
    HP = _sum([H @ P[:, first : first + H.shape[1]] for first, H in blocks])
    HPH = _sum([HP[:, :, first : first + H.shape[1]] @ H.T for first, H in blocks])
    R = np.array((covariance, covariance if noise is None else noise))
    S = HPH + R
    nis, sigma = _square(_whitener(S[ACTUAL]) @ residual), np.sqrt(S[ACTUAL].diagonal())
    whitener = _whitener(S[gains_from])
    gate_nis = _square(whitener @ residual)
    scale = 1.0
    if gate is not None and gate_nis > gate:
        if inflation is None:
            return s, UpdateResult("gated", nis, 1.0, residual, sigma, gate_nis)
        scale = (gate_nis / gate) ** inflation
        R = R * scale
        S = HPH + R
        whitener = _whitener(S[gains_from])
    if not math.isfinite(gate_nis):
        return s, UpdateResult("innovation covariance not invertible")
    K = (whitener.T @ whitener @ HP[gains_from]).T
    K[s.considered_rows] = 0.0
    moved = s.plus((K @ residual[:, None])[:, 0])
    after = changed(moved, covariances=_with_gain(P, K, blocks, R, HP, S))
    return after, UpdateResult("", nis, scale, residual, sigma, gate_nis)


def _with_gain(
    P: FloatArray,
    K: FloatArray,
    blocks: Sequence[Block],
    R: FloatArray,
    HP: FloatArray,
    S: FloatArray,
) -> FloatArray:
    """Return both covariances after the update with the gain K, whatever determined it."""
    if not (S.diagonal(0, 1, 2) > _JOSEPH_RATIO * R.diagonal(0, 1, 2)).any():
        return with_gain(P, K, HP, S)
    # Joseph's form is slower, but without cancellation.
    A = np.eye(P.shape[1])
    for first, H in blocks:
        A[:, first : first + H.shape[1]] -= K @ H
    return symmetric(A @ P @ A.T + K @ R @ K.T)


def fault_of(value: FloatArray, covariance: FloatArray) -> str:
    """Return why a measurement cannot be used; empty if it can."""
    if not math.isfinite(np.vdot(value, value) + np.vdot(covariance, covariance)):
        return "value that is not finite"
    return "covariance not positive definite" if dpotrf(covariance, lower=1)[1] else ""


def with_gain(P: FloatArray, K: FloatArray, HP: FloatArray, S: FloatArray) -> FloatArray:
    """Return covariances (..., n, n) after an update with any gain, S being H P H^T + R.

    (I - K H) P (I - K H)^T + K R K^T = P - K H P - (K H P)^T + K S K^T
    """
    half = K @ (HP - 0.5 * S @ K.T)
    return np.asarray(P - half - half.swapaxes(-1, -2))


def gauss_markov(
    covariances: FloatArray, rows: slice, kept: FloatArray, sigma: float
) -> FloatArray:
    """Return covariances (..., n, n) after errors have taken a Gauss-Markov step.

    Args:
        covariances: before the step.
        rows: the k rows of the errors, which vary about zero, independently of each other.
        kept: (k,) correlation of each error with its value before the step.
        sigma: stationary standard deviation of the errors.
    """
    P = covariances.copy()
    P[..., rows, :] *= kept[:, None]
    P[..., :, rows] *= kept
    P[..., rows, rows] += np.diag((1.0 - kept * kept) * sigma**2)
    return P


def _square(white: FloatArray) -> float:
    return float(white @ white)


def _sum(terms: list[FloatArray]) -> FloatArray:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


def _whitener(covariance: FloatArray) -> FloatArray:
    """Return the inverse of the lower Cholesky factor; NaN if there is none."""
    factor, failed = dpotrf(covariance, lower=1)
    if failed:
        return np.full_like(covariance, math.nan)
    inverse: FloatArray = dtrtri(factor, lower=1)[0]
    return inverse
