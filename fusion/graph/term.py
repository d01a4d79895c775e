"""A measurement of keyframes: whitened, down-weighted as an outlier, a linear factor of gtsam."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import gtsam
import numpy as np

from stario.sequences.sequence import FloatArray

Linearised = tuple[FloatArray, list[tuple[int, FloatArray]]]
"""Residual (m,) of a term and the Jacobian blocks (key, (m, width)) of its prediction."""


class IndeterminateError(Exception):
    """The graph cannot be solved; the message names the cause, such as a state and its time."""


@dataclass(frozen=True, eq=False)
class Term:
    """A measurement of one or more keyframes.

    Attributes:
        keyframes: numbers of the measured keyframes, in order.
        covariance: (m, m), in the axes of the residual.
    """

    keyframes: tuple[int, ...]
    covariance: FloatArray

    outlier_power: ClassVar[float] = 0.5
    """Power of limit / squared norm that weights an outlier: a half inflates it to the limit, as
    the filter does."""

    def linearise(self, values: Any) -> Linearised:
        """Linearise at gtsam `Values`."""
        raise NotImplementedError


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

    def factor(self, values: Any, trusted: bool = False) -> Any:
        """Return the factor, linearised and, unless `trusted`, weighted at gtsam `Values`."""
        residual, blocks = self.term.linearise(values)
        white = self.whitener @ residual
        squared = float(white @ white)
        if not math.isfinite(squared):
            raise IndeterminateError(f"a {type(self.term).__name__.lower()} is not finite")
        scaled = self.whitener
        if squared > self.limit and not trusted:
            scaled = (self.limit / squared) ** self.term.outlier_power * scaled
        return linear_factor([(key, scaled @ H) for key, H in blocks], scaled @ residual)


def linear_factor(blocks: list[tuple[int, FloatArray]], b: FloatArray) -> Any:
    """Return a `JacobianFactor` of white rows, by the only constructor that takes many keys."""
    unit = gtsam.noiseModel.Unit.Create(len(b))
    return gtsam.JacobianFactor(gtsam.GaussianConditional(blocks, 1, b, unit))
