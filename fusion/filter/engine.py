"""Structured algebra on filterpy's `ExtendedKalmanFilter` for an error state.

filterpy multiplies full-size matrices. Here only the blocks that a step touches are computed
(core rows against the clones, a symmetric update of the measurement's rank), with the same result;
`speed.DenseEkf` runs filterpy's own algebra for comparison. `P` is replaced, never modified in
place, so a reference to an earlier one can be restored. README.md, "Gates".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.linalg.blas import dgemm
from scipy.linalg.lapack import dpotrf, dtrtri

from stario.fusion.filter.jacobians import CORE, Block
from stario.sequences.sequence import FloatArray

GateMode = Literal["inflate", "reject"]

_JOSEPH_RATIO = 1e9
"""Ratio of state to measurement variance above which P - W^T W would lose its digits."""


class UpdateResult(NamedTuple):
    """Outcome of one measurement.

    Attributes:
        nis: normalised innovation squared under the given covariance, before any inflation;
            NaN if it could not be computed.
        dof: dimension of the measurement, the expectation of `nis`.
        accepted: False if the state was left unchanged.
        scale: factor by which the measurement covariance was inflated (1: not gated).
        reason: why the measurement was rejected; empty if it was accepted.
        residual: (m,) measured minus predicted; None if the measurement was invalid.
        sigma: (m,) standard deviations of the residual under the given covariance; None likewise.
    """

    nis: float
    dof: int
    accepted: bool
    scale: float = 1.0
    reason: str = ""
    residual: FloatArray | None = None
    sigma: FloatArray | None = None

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
    """Covariance of an error state whose mean is zero between steps.

    filterpy's `P`, `R`, `y`, `z`, `S`, `SI`, `K`, `log_likelihood`, `mahalanobis`, `x_post`,
    `P_prior` and `P_post` describe the last step; `x` is the error's mean. Its `predict` and
    `update` use dense algebra and are not meant to be called from outside.

    Args:
        dim: size of the error state; the first `CORE` rows belong to the current state.
        considered: row of the error that no update estimates (Schmidt 1966): its gain is zero.
    """

    def __init__(self, dim: int, considered: int) -> None:
        super().__init__(dim_x=dim, dim_z=3)
        self._considered = considered
        self.P = np.zeros((dim, dim))
        self.Q = np.zeros((dim, dim))

    def update_linear(
        self,
        residual: FloatArray,
        blocks: Sequence[Block],
        covariance: FloatArray,
        gate: float | None = None,
        gate_mode: GateMode = "inflate",
        power: float = 1.0,
    ) -> UpdateResult:
        """Update with a measurement that is linear in the error.

        Args:
            residual: (m,) measured minus predicted.
            blocks: Jacobian of the residual with respect to the error (true minus estimate), as
                blocks (first column, (m, width)); columns in no block are zero.
            covariance: (m, m) covariance of the measurement.
            gate: NIS above which the measurement counts as an outlier; None for no gate.
            gate_mode: "inflate" multiplies an outlier's covariance by a power of NIS / gate, so
                that a run of outliers can still correct a wrong filter; "reject" drops it.
            power: exponent of NIS / gate in that factor.

        Returns:
            The outcome. Values that are not finite and covariances that are not positive definite
            are rejected with a reason; the state is then unchanged.
        """
        m = len(residual)
        if not math.isfinite(residual @ residual + np.vdot(covariance, covariance)):
            return UpdateResult(math.nan, m, False, reason="value that is not finite")
        if dpotrf(covariance, lower=1)[1] != 0:
            return UpdateResult(math.nan, m, False, reason="covariance not positive definite")
        HP = _sum([H @ self.P[first : first + H.shape[1]] for first, H in blocks])
        HPH = _sum([HP[:, first : first + H.shape[1]] @ H.T for first, H in blocks])
        whitener = _whitener(HPH + covariance)
        white = whitener @ residual
        nis = float(white @ white)
        sigma = np.sqrt((HPH + covariance).diagonal())
        scale = 1.0
        if gate is not None and nis > gate:
            if gate_mode == "reject":
                return UpdateResult(nis, m, False, 1.0, "gated", residual, sigma)
            scale = (nis / gate) ** power
            covariance = covariance * scale
            whitener = _whitener(HPH + covariance)
        if not math.isfinite(nis):
            return UpdateResult(math.nan, m, False, reason="innovation covariance not invertible")
        self._inject(self._correct(residual, blocks, covariance, HP, HPH, whitener))
        return UpdateResult(nis, m, True, scale, "", residual, sigma)

    def _inject(self, P: FloatArray) -> None:
        """Move the error's mean `x` into the state and set it to zero; P is its new covariance."""
        raise NotImplementedError

    @property
    def P_post(self) -> FloatArray:
        """Covariance after the last step."""
        return self.P

    @P_post.setter
    def P_post(self, value: FloatArray) -> None:  # filterpy assigns it
        pass

    # --- structured algebra ----------------------------------------------------------------------

    def _propagated(self, P: FloatArray, transition: FloatArray, noise: FloatArray) -> FloatArray:
        P = P.copy()
        P[:CORE] = transition @ P[:CORE]
        P[CORE:, :CORE] = P[:CORE, CORE:].T
        core = P[:CORE, :CORE] @ transition.T + noise
        P[:CORE, :CORE] = 0.5 * (core + core.T)
        return P

    def _correct(
        self,
        residual: FloatArray,
        blocks: Sequence[Block],
        covariance: FloatArray,
        HP: FloatArray,
        HPH: FloatArray,
        whitener: FloatArray,
    ) -> FloatArray:
        """Return P - K S K^T, computed as P - W^T W with W = L^-1 H P, which is symmetric."""
        W = whitener @ HP
        self.R, self.S = covariance, HPH + covariance
        self.SI = whitener.T @ whitener
        self.K = (whitener.T @ W).T
        self.K[self._considered] = 0.0
        self.y = self.z = residual[:, None]
        self.x = self.K @ self.y
        self.x_post, self.P_prior = self.x, self.P
        self._log_likelihood = self._likelihood = self._mahalanobis = None
        if (HPH.diagonal() > _JOSEPH_RATIO * covariance.diagonal()).any():
            return self._correct_as_joseph(blocks)
        # P is symmetric: its transpose is the same matrix in BLAS order.
        P: FloatArray = dgemm(-1.0, W.T, W.T, beta=1.0, c=self.P.T, trans_b=1).T
        return self._considering(P, self.P)

    def _considering(self, P: FloatArray, before: FloatArray) -> FloatArray:
        """Return a new covariance after an update, with the considered error's variance as before.

        Its covariances with other errors depend on their gains alone, as in any update.
        """
        P[self._considered, self._considered] = before[self._considered, self._considered]
        return P

    def _correct_as_joseph(self, blocks: Sequence[Block]) -> FloatArray:
        """Return (I - K H) P (I - K H)^T + K R K^T: slower, but without cancellation."""
        A = np.eye(len(self.P))
        for first, H in blocks:
            A[:, first : first + H.shape[1]] -= self.K @ H
        P = A @ self.P @ A.T + self.K @ self.R @ self.K.T
        return np.asarray(0.5 * (P + P.T))


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
