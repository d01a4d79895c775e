"""Whitened terms of the graph, with outliers down-weighted, as linear factors of gtsam."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from stario.fusion.graph.factors import Displacement, Term
from stario.sequences.sequence import FloatArray

_OUTLIER_POWER, _DISPLACEMENT_POWER = 0.5, 0.75
"""Powers of limit / squared norm that weight outliers: a half inflates them to the limit, as the
filter does. False displacements come in a row and count less: five seconds of them, off by 1 m,
cost 0.08 to 0.24 m in the three walks on which this was chosen, and 0.5 to 0.6 m with a half."""


class IndeterminateError(Exception):
    """The graph cannot be solved; the message names the cause, such as a state and its time."""


@dataclass(frozen=True, eq=False)
class Whitened:
    """A term, its covariance's whitener (m, m), and the squared norm that makes it an outlier."""

    term: Term
    whitener: FloatArray
    limit: float

    @classmethod
    def of(cls, term: Term, limit: float) -> Whitened:
        """Whiten a term, an outlier if the squared norm of its white residual exceeds the limit."""
        return cls(term, np.linalg.inv(np.linalg.cholesky(term.covariance)), limit)

    @property
    def first(self) -> int:
        """Number of its first keyframe."""
        return self.term.keyframes[0]

    def weighted(self, values: Any) -> tuple[FloatArray, list[tuple[int, FloatArray]], float]:
        """Return residual, Jacobian blocks and weight at gtsam `Values`."""
        residual, blocks = self.term.linearise(values)
        white = self.whitener @ residual
        squared = float(white @ white)
        if not math.isfinite(squared):
            kind = type(self.term).__name__.lower()
            raise IndeterminateError(f"a {kind} is not finite")
        if squared <= self.limit:
            return residual, blocks, 1.0
        power = _DISPLACEMENT_POWER if isinstance(self.term, Displacement) else _OUTLIER_POWER
        return residual, blocks, (self.limit / squared) ** power

    def factor(self, values: Any, trusted: bool = False) -> Any:
        """Return the factor, linearised and, unless `trusted`, weighted at gtsam `Values`."""
        residual, blocks, weight = self.weighted(values)
        if trusted:
            weight = 1.0
        scaled = weight * self.whitener
        return linear_factor([(key, scaled @ H) for key, H in blocks], scaled @ residual)


def linear_factor(blocks: list[tuple[int, FloatArray]], b: FloatArray) -> Any:
    """Return a `JacobianFactor` of white rows, by the only constructor that takes many keys."""
    unit = gtsam.noiseModel.Unit.Create(len(b))
    return gtsam.JacobianFactor(gtsam.GaussianConditional(blocks, 1, b, unit))
