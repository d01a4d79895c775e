"""A second opinion while displacements are taken for outliers: the filter as it is without them.

README.md, "Gates". Inflated displacements that keep on pulling win in the end, right or wrong, and
a filter that has followed false ones takes the right ones behind them for outliers. So from the
first outlier on the filter without any is kept beside it, for some seconds at most; where the
displacements agree with that one again, and no longer with the filter, they take its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from stario.fusion.changed import changed
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.ekf_state import EkfState

GATE = 0.95
"""Probability of the chi-square test beyond which a displacement does not fit the sceptic."""

_FITS_TO_REPLACE = 2
"""Displacements that fit the sceptic alone, until it is believed."""

_FITS_TO_DROP = 4
"""That fit both: it was one outlier, or few, and nothing is left to decide."""

_MAX_SECONDS = 6.0
"""The IMU alone knows no more beyond."""

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class AlternativeHypothesis:
    """The filter had it left out the displacements that do not fit.

    Attributes:
        ekf: its state.
        began: time of the first outlier [s].
        right: displacements since that fitted it and not the filter.
        alike: in a row that fitted both.
    """

    ekf: EkfState
    began: float
    exclusive_fits: int = 0
    shared_fits: int = 0

    def updated(self, fits: bool, fits_filter: bool) -> AlternativeHypothesis:
        """With whether a displacement fits it, and whether it fits the filter."""
        if not fits:
            alone = self.exclusive_fits if not fits_filter else 0
            return changed(self, exclusive_fits=alone, shared_fits=0)
        return changed(
            self,
            exclusive_fits=self.exclusive_fits + (not fits_filter),
            shared_fits=self.shared_fits + 1 if fits_filter else 0,
        )

    @property
    def should_replace(self) -> bool:
        """Whether it should take the filter's place."""
        return self.exclusive_fits >= _FITS_TO_REPLACE

    @property
    def is_obsolete(self) -> bool:
        """Whether it is of no more use."""
        return self.shared_fits >= _FITS_TO_DROP or self.ekf.time - self.began > _MAX_SECONDS


class HypothesisPair:
    """A filter, and the sceptic beside it while there is one.

    Args:
        ekf: the filter; its state is put aside while the sceptic takes its turn.

    Attributes:
        ekf: the filter.
        sceptic: None while all displacements fit.
    """

    def __init__(self, ekf: StateCloningEkf) -> None:
        self.ekf = ekf
        self.alternative: AlternativeHypothesis | None = None

    def apply_to_both(self, work: Callable[[], Result]) -> Result:
        """Do it to the filter, then to the sceptic; returns what came of the first."""
        result = work()
        if self.alternative is not None:
            filter_state, self.ekf.state = self.ekf.state, self.alternative.ekf
            work()
            self.alternative, self.ekf.state = (
                changed(self.alternative, ekf=self.ekf.state),
                filter_state,
            )
        return result

    def compare(self, fits: Callable[[], bool], fits_filter: bool) -> None:
        """About a displacement that the filter has taken in.

        Args:
            fits: updates whatever state the filter holds with it, if it fits that one.
            fits_filter: whether it fitted the filter.
        """
        if self.alternative is None:
            return
        filter_state, self.ekf.state = self.ekf.state, self.alternative.ekf
        fitted = fits()
        compared = changed(self.alternative, ekf=self.ekf.state).updated(fitted, fits_filter)
        self.ekf.state = compared.ekf if compared.should_replace else filter_state
        self.alternative = None if compared.should_replace or compared.is_obsolete else compared
