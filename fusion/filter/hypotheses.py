"""A filter and the alternative hypothesis that a displacement beyond its gate opens.

Under the alternative, recent outliers share a steady error. README.md, "Gates".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.state import changed
from stario.sequences.sequence import FloatArray

_FITS_TO_DROP = 4
"""Consecutive displacements that fit both before the alternative is dropped: outliers were few."""

_MAX_SECONDS = 6.0
"""Maximum age of the alternative [s]: an error that lasts longer is not taken for false."""

Result = TypeVar("Result")


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


class HypothesisPair:
    """A filter and its alternative hypothesis, if there is one.

    Args:
        ekf: the filter; its state is set aside while the alternative is updated.

    Attributes:
        ekf: the filter.
        alternative: the alternative hypothesis; None while all displacements fit.
    """

    def __init__(self, ekf: StateCloningEkf) -> None:
        self.ekf = ekf
        self.alternative: AlternativeHypothesis | None = None

    def apply_to_both(self, work: Callable[[], Result]) -> Result:
        """Apply `work` to the filter and then to the alternative; return the filter's result."""
        result = work()
        self.apply_to_alternative(work)
        return result

    def apply_to_alternative(self, work: Callable[[], Result]) -> Result | None:
        """Apply `work` to the alternative, if there is one; return its result."""
        if self.alternative is None:
            return None
        filter_state, self.ekf.state = self.ekf.state, self.alternative.ekf
        try:
            result = work()
            self.alternative = changed(self.alternative, ekf=self.ekf.state)
        finally:
            self.ekf.state = filter_state
        return result

    def judge(self, fits: bool, fits_filter: bool) -> tuple[float, ...]:
        """Adopt the alternative if only it fits a displacement; drop it once both fit several.

        Args:
            fits: whether it fitted the alternative as it is.
            fits_filter: whether it fitted the filter.

        Returns:
            Times of the displacements [s] that were false after all, since the alternative without
            them is adopted; empty otherwise.
        """
        alternative = self.alternative
        if alternative is None:
            return ()
        if fits and not fits_filter:
            self.ekf.state, self.alternative = alternative.ekf, None
            return alternative.outliers
        shared = alternative.shared_fits + 1 if fits else 0
        self.alternative = changed(alternative, shared_fits=shared)
        if shared >= _FITS_TO_DROP or alternative.ekf.time - alternative.outliers[0] > _MAX_SECONDS:
            self.alternative = None
        return ()
