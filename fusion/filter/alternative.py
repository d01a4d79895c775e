"""The alternative hypothesis that a displacement beyond its gate opens.

Under it, recent outliers share a steady error. README.md, "Gates".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.values.state import changed
from stario.sequences.sequence import FloatArray

_FITS_TO_DROP = 4
"""Consecutive displacements that fit both before the alternative is dropped: outliers were few."""

_MAX_SECONDS = 6.0
"""Maximum age of the alternative [s]: an error that lasts longer is not taken for false."""


@dataclass(frozen=True, eq=False)
class AlternativeHypothesis:
    """State of the filter if the displacements since an outlier contained one steady error.

    Less this error they still measure how the velocity changes. Without that, tilt and bias of the
    accelerometer would soon explain any displacement.

    Attributes:
        ekf: state of the filter under this hypothesis.
        offset_W: (3,) the steady error, from the residuals of the outliers [m].
        outliers: times of the displacements that do not fit as they are [s]; the first opened it.
        shared_fits: number of latest displacements in a row that fitted both.
    """

    ekf: EkfState
    offset_W: FloatArray
    outliers: tuple[float, ...]
    shared_fits: int = 0


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """A filter's state, and the alternative; None while all displacements fit."""

    ekf: EkfState
    alternative: AlternativeHypothesis | None = None

    def both(self, work: Callable[[EkfState], EkfState]) -> Hypotheses:
        """Return both after the same work."""
        after, other = work(self.ekf), self.alternative
        return Hypotheses(after, other and changed(other, ekf=work(other.ekf)))

    def judged(self, fits: bool, fits_filter: bool) -> tuple[Hypotheses, tuple[float, ...]]:
        """Adopt the alternative if only it fits a displacement; drop it once both fit several.

        Args:
            fits: whether it fitted the alternative as it is.
            fits_filter: whether it fitted the filter.

        Returns:
            Both, and the times of the displacements [s] that were false after all, since the
            alternative without them is adopted; empty otherwise.
        """
        other = self.alternative
        if other is None:
            return self, ()
        if fits and not fits_filter:
            return Hypotheses(other.ekf), other.outliers
        shared = other.shared_fits + 1 if fits else 0
        if shared >= _FITS_TO_DROP or other.ekf.time - other.outliers[0] > _MAX_SECONDS:
            return Hypotheses(self.ekf), ()
        return Hypotheses(self.ekf, changed(other, shared_fits=shared)), ()
