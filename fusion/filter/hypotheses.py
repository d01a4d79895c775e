"""The filter and its alternative hypothesis, under which recent outliers share a steady error.

README.md, "Gates".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.state import changed
from stario.sequences.sequence import FloatArray

_FITS_TO_REPLACE = 2
"""Displacements that must fit only the alternative before it replaces the filter's state."""

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
        start_time: time of the first outlier [s].
        offset_W: (3,) the steady error, from the residuals of the outliers [m].
        outliers: times of the displacements that do not fit as they are [s].
        exclusive_fits: number of displacements that fitted only the alternative since the last one
            that fitted only the filter.
        shared_fits: number of latest displacements in a row that fitted both.
    """

    ekf: EkfState
    start_time: float
    offset_W: FloatArray
    outliers: tuple[float, ...] = ()
    exclusive_fits: int = 0
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
        if self.alternative is not None:
            filter_state, self.ekf.state = self.ekf.state, self.alternative.ekf
            work()
            self.alternative = changed(self.alternative, ekf=self.ekf.state)
            self.ekf.state = filter_state
        return result

    def compare(
        self, test: Callable[[AlternativeHypothesis], AlternativeHypothesis], fits_filter: bool
    ) -> tuple[float, ...]:
        """Test the alternative with a displacement that the filter has applied; adopt or drop it.

        Args:
            test: updates the filter's current state, which is that of the alternative, with the
                displacement, and returns the alternative with one more outlier if it does not fit.
            fits_filter: whether the displacement fitted the filter.

        Returns:
            Times of the displacements [s] that were false after all, since the alternative without
            them is adopted; empty otherwise.
        """
        alternative = self.alternative
        if alternative is None:
            return ()
        filter_state, self.ekf.state = self.ekf.state, alternative.ekf
        tested = test(alternative)
        fitted = len(tested.outliers) == len(alternative.outliers)
        exclusive = alternative.exclusive_fits + (fitted and not fits_filter)
        if fits_filter and not fitted:
            exclusive = 0
        shared = alternative.shared_fits + 1 if fits_filter and fitted else 0
        self.alternative = None
        if exclusive >= _FITS_TO_REPLACE:
            return tested.outliers
        ekf, self.ekf.state = self.ekf.state, filter_state
        if shared < _FITS_TO_DROP and ekf.time - alternative.start_time <= _MAX_SECONDS:
            fits = {"exclusive_fits": exclusive, "shared_fits": shared}
            self.alternative = changed(tested, ekf=ekf, **fits)
        return ()
