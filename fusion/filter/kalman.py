"""filterpy's prediction and update of an error state, with gates and a second covariance.

filterpy predicts and updates the covariance P that the gains assume. Beside it is the covariance of
the error that these gains leave (Gelb 1974, ch. 7: covariance analysis of a filter whose model is
not the truth). They differ only by errors that updates consider without estimating them, whose rows
of P are zero, and by white noise that is smaller than assumed. README.md, "Correlated errors".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from filterpy.kalman import predict as filterpy_predict
from scipy.linalg import eigh
from scipy.linalg.lapack import dposv, dpotrf
from scipy.optimize import brentq

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.jacobians import CORE, GAIN, REPORTED, Block, symmetric
from stario.fusion.values.state import changed
from stario.sequences.sequence import FloatArray

TO_GATE = math.inf
"""Power that inflates an outlier until it is none. NIS / gate does not suffice for a measurement
that is more certain than the state: from far off it would move the rest of the state, too, by many
of its sigmas."""


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
        log_likelihood: logarithm of the residual's density under the covariance of the error.
    """

    reason: str = ""
    nis: float = math.nan
    scale: float = 1.0
    residual: FloatArray | None = None
    sigma: FloatArray | None = None
    gate_nis: float = math.nan
    log_likelihood: float = math.nan

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

    def jacobian(self, n: int) -> FloatArray:
        """Return H (m, n)."""
        H = np.zeros((len(self.residual), n))
        for first, block in self.blocks:
            H[:, first : first + block.shape[1]] = block
        return H


def predict(covariances: FloatArray, transition: FloatArray, noise: FloatArray) -> FloatArray:
    """Return covariances (2, n, n) after a transition (15, 15) with noises (2, 15, 15)."""
    n = covariances.shape[1]
    zero, F, Q = np.zeros(n), np.eye(n), np.zeros((2, n, n))
    F[:CORE, :CORE], Q[:, :CORE, :CORE] = transition, noise
    pairs = zip(covariances, Q, strict=True)
    return symmetric(np.array([filterpy_predict(zero, P, F, q)[1] for P, q in pairs]))


def update(
    s: EkfState,
    measured: Linear,
    gate: float | None = None,
    gains_from: int = GAIN,
    power: float | None = 1.0,
) -> tuple[EkfState, UpdateResult]:
    """Update a state with a measurement.

    Args:
        s: the state.
        measured: the measurement.
        gate: NIS above which it counts as an outlier; None for no gate.
        gains_from: which covariance determines the gains: `GAIN` or `REPORTED`.
        power: an outlier's covariance is multiplied by this power of NIS / gate, so that a run of
            outliers can still correct a wrong filter; `TO_GATE` until its NIS is the gate's; None
            rejects outliers.

    Returns:
        The state and the outcome. Values that are not finite and covariances that are not positive
        definite are rejected with a reason; the state is then the one given.
    """
    residual, _, covariance, noise = measured
    if reason := _fault_of(residual, covariance):
        return s, UpdateResult(reason)
    H = measured.jacobian(s.covariances.shape[1])
    R = np.array((covariance, covariance if noise is None else noise))
    S = H @ s.covariances @ H.T + R
    nis, log_likelihood = _nis(residual, S[REPORTED])
    gate_nis, _ = _nis(residual, S[gains_from])
    if not math.isfinite(gate_nis):
        return s, UpdateResult("innovation covariance not invertible")
    sigma, scale = np.sqrt(S[REPORTED].diagonal()), 1.0
    if gate is not None and gate_nis > gate:
        if power is None:
            return s, UpdateResult("gated", nis, 1.0, residual, sigma, gate_nis, log_likelihood)
        if power == TO_GATE:
            scale = _to_gate(residual, S[gains_from], R[gains_from], gate)
        else:
            scale = (gate_nis / gate) ** power
    after = corrected(s, residual, H, scale * R, gains_from)
    return after, UpdateResult("", nis, scale, residual, sigma, gate_nis, log_likelihood)


def corrected(
    s: EkfState, residual: FloatArray, H: FloatArray, R: FloatArray, gains_from: int = GAIN
) -> EkfState:
    """Return the state after a measurement with H (m, n) and R (2, m, m), whatever they are.

    Errors that are only considered have no gain (Schmidt 1966).
    """
    filter_ = ExtendedKalmanFilter(H.shape[1], len(H))
    filter_.P = s.covariances[gains_from]
    filter_.update(residual[:, None], lambda x: H, lambda x: H @ x, R[gains_from])
    K = filter_.K
    K[s.considered_rows] = 0.0
    A = np.eye(len(K)) - K @ H
    P = s.covariances.copy()
    P[GAIN] = filter_.P
    for which in (REPORTED,) if gains_from == GAIN else (GAIN, REPORTED):
        # With any gain, Joseph's form gives the covariance of the error that it leaves.
        P[which] = A @ s.covariances[which] @ A.T + K @ R[which] @ K.T
    return changed(s.plus(K @ residual), covariances=symmetric(P))


def gauss_markov(
    covariances: FloatArray, rows: slice, kept: FloatArray, sigma: float | FloatArray
) -> FloatArray:
    """Return covariances (..., n, n) after errors have taken a Gauss-Markov step.

    Args:
        covariances: before the step.
        rows: the k rows of the errors, which vary about zero, independently of each other.
        kept: (k,) correlation of each error with its value before the step.
        sigma: stationary standard deviation of the errors, or of each (k,).
    """
    P = covariances.copy()
    P[..., rows, :] *= kept[:, None]
    P[..., :, rows] *= kept
    P[..., rows, rows] += np.diag((1.0 - kept * kept) * sigma**2)
    return P


def _fault_of(value: FloatArray, covariance: FloatArray) -> str:
    """Return why a measurement cannot be used; empty if it can."""
    if not math.isfinite(np.vdot(value, value) + np.vdot(covariance, covariance)):
        return "value that is not finite"
    return "covariance not positive definite" if dpotrf(covariance, lower=1)[1] else ""


def _to_gate(residual: FloatArray, S: FloatArray, R: FloatArray, gate: float) -> float:
    """Return the factor on R, a part of S, with which the NIS of an outlier is the gate's."""
    variances, axes = eigh(S - R, R)
    variances, squared = np.maximum(variances, 0.0), np.square(axes.T @ residual)

    def excess(scale: float) -> float:
        return float((squared / (variances + scale)).sum() - gate)

    # Without S - R it would be the upper limit's half.
    return float(brentq(excess, 0.5, 2.0 * squared.sum() / gate))


def _nis(residual: FloatArray, S: FloatArray) -> tuple[float, float]:
    """Return the normalised innovation squared and the log-likelihood, NaN if S is not definite."""
    root, solved, failed = dposv(S, residual)
    if failed:
        return math.nan, math.nan
    nis = float(residual @ solved.ravel())
    log_det = 2.0 * float(np.log(root.diagonal()).sum())
    return nis, -0.5 * (nis + log_det + len(residual) * math.log(2.0 * math.pi))
