"""Structured algebra on filterpy's `ExtendedKalmanFilter` for an error state.

filterpy multiplies full-size matrices. Here only the blocks that a step touches are computed
(core rows against the clones, a symmetric update of the measurement's rank), with the same result;
`evaluation.checks.speed.DenseEkf` runs filterpy's own algebra for comparison. `P` is replaced,
never modified in place, so a reference to an earlier one can be restored. README.md, "Correlated
errors" and "Gates".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.linalg.lapack import dpotrf, dtrtri

from stario.fusion.filter.jacobians import ACTUAL, ASSUMED, CORE, Block, symmetric
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


class ErrorStateEngine(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy is untyped
    """Covariances of an error state whose mean is zero between steps.

    There are two of them: `P`, as assumed for the gains, and the covariance of the error that these
    gains leave (Gelb 1974, ch. 7: covariance analysis of a filter whose model is not the truth).
    They differ only by errors that updates consider without estimating them, whose rows of `P` are
    zero, and by white noise that is smaller than assumed. README.md, "Correlated errors".

    filterpy's `P`, `R`, `y`, `z`, `S`, `SI`, `K`, `log_likelihood`, `mahalanobis`, `x_post`,
    `P_prior` and `P_post` describe the last step; `x` is the error's mean. Its `predict` and
    `update` use dense algebra and are not meant to be called from outside.

    Args:
        dim: size of the error state; the first `CORE` rows belong to the current state.
        considered: rows of the error that no update estimates (Schmidt 1966): their gain is zero.

    Attributes:
        covariances: (2, n, n) both; replaced, never modified in place.
    """

    covariances: FloatArray

    def __init__(self, dim: int, considered: slice) -> None:
        self._considered = considered
        super().__init__(dim_x=dim, dim_z=3)
        self.Q = np.zeros((dim, dim))

    @property
    def P(self) -> FloatArray:
        """Covariance (n, n) of the error as assumed for the gains."""
        P: FloatArray = self.covariances[ASSUMED]
        return P

    @P.setter
    def P(self, value: FloatArray) -> None:
        self.covariances = np.stack([value, value])

    def update_linear(
        self,
        residual: FloatArray,
        blocks: Sequence[Block],
        covariance: FloatArray,
        gate: float | None = None,
        inflation: float | None = 1.0,
        noise: FloatArray | None = None,
        gains_from: int = ASSUMED,
    ) -> UpdateResult:
        """Update with a measurement that is linear in the error.

        Args:
            residual: (m,) measured minus predicted.
            blocks: Jacobian of the residual with respect to the error (true minus estimate), as
                blocks (first column, (m, width)); columns in no block are zero.
            covariance: (m, m) covariance of the measurement.
            gate: NIS above which the measurement counts as an outlier; None for no gate.
            inflation: an outlier's covariance is multiplied by this power of NIS / gate, so that a
                run of outliers can still correct a wrong filter; None rejects outliers.
            noise: (m, m) covariance of the measurement's white noise if it is not `covariance`,
                which then also stands for considered errors.
            gains_from: which covariance determines the gains: `ASSUMED` or `ACTUAL`.

        Returns:
            The outcome. Values that are not finite and covariances that are not positive definite
            are rejected with a reason; the state is then unchanged.
        """
        if reason := fault_of(residual, covariance):
            return UpdateResult(reason)
        HP = _sum([H @ self.covariances[:, first : first + H.shape[1]] for first, H in blocks])
        HPH = _sum([HP[:, :, first : first + H.shape[1]] @ H.T for first, H in blocks])
        R = np.array((covariance, covariance if noise is None else noise))
        S = HPH + R
        nis, sigma = _square(_whitener(S[ACTUAL]) @ residual), np.sqrt(S[ACTUAL].diagonal())
        whitener = _whitener(S[gains_from])
        gate_nis = _square(whitener @ residual)
        scale = 1.0
        if gate is not None and gate_nis > gate:
            if inflation is None:
                return UpdateResult("gated", nis, 1.0, residual, sigma, gate_nis)
            scale = (gate_nis / gate) ** inflation
            R = R * scale
            S = HPH + R
            whitener = _whitener(S[gains_from])
        if not math.isfinite(gate_nis):
            return UpdateResult("innovation covariance not invertible")
        self.R, self.S = R[gains_from], S[gains_from]
        self._set_gain(residual, HP[gains_from], whitener)
        self.inject(self._with_gain(blocks, R, HP, S))
        return UpdateResult("", nis, scale, residual, sigma, gate_nis)

    def inject(self, covariances: FloatArray) -> None:
        """Move the error's mean `x` into the state and set it to zero, with new covariances."""
        raise NotImplementedError

    @property
    def P_post(self) -> FloatArray:
        """Covariance after the last step."""
        return self.P

    @P_post.setter
    def P_post(self, value: FloatArray) -> None:  # filterpy assigns it
        pass

    # --- structured algebra ----------------------------------------------------------------------

    def _propagated(
        self, covariances: FloatArray, transition: FloatArray, noise: FloatArray
    ) -> FloatArray:
        P = covariances.copy()
        P[:, :CORE] = transition @ P[:, :CORE]
        P[:, CORE:, :CORE] = P[:, :CORE, CORE:].transpose(0, 2, 1)
        P[:, :CORE, :CORE] = symmetric(P[:, :CORE, :CORE] @ transition.T + noise)
        return P

    def _set_gain(self, residual: FloatArray, HP: FloatArray, whitener: FloatArray) -> None:
        """Set the gain and filterpy's attributes of the step."""
        self.SI = whitener.T @ whitener
        self.K = (self.SI @ HP).T
        self.K[self._considered] = 0.0
        self.y = self.z = residual[:, None]
        self.x = self.K @ self.y
        self.x_post, self.P_prior = self.x, self.P
        self._log_likelihood = self._likelihood = self._mahalanobis = None

    def _with_gain(
        self, blocks: Sequence[Block], R: FloatArray, HP: FloatArray, S: FloatArray
    ) -> FloatArray:
        """Return both covariances after the update with the gain K, whatever determined it."""
        P, K = self.covariances, self.K
        if not (S.diagonal(0, 1, 2) > _JOSEPH_RATIO * R.diagonal(0, 1, 2)).any():
            return with_gain(P, K, HP, S)
        # Joseph's form is slower, but without cancellation.
        A = np.eye(P.shape[1])
        for first, H in blocks:
            A[:, first : first + H.shape[1]] -= K @ H
        P = A @ P @ A.T + K @ R @ K.T
        return symmetric(P)


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
