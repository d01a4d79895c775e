"""Alternative hypothesis while displacements are gated: the filter's state without the outliers.

README.md, "Gates". Inflated displacements that keep pulling prevail in the end, right or wrong, and
a filter that has followed false ones takes the correct ones after them for outliers. Therefore,
from the first outlier on, a state without outliers is kept alongside the filter for a few seconds;
if later displacements fit that state and no longer the filter, it replaces the filter's state.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.state import changed

GATE = 0.95
"""Probability of the chi-square test beyond which a displacement does not fit the alternative."""

_FITS_TO_REPLACE = 2
"""Displacements that must fit only the alternative before it replaces the filter's state."""

_FITS_TO_DROP = 4
"""Consecutive displacements that fit both before the alternative is dropped: outliers were few."""

_MAX_SECONDS = 6.0
"""Maximum age of the alternative [s]: the IMU alone is not accurate for longer."""

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class AlternativeHypothesis:
    """State of the filter if it had rejected the displacements that failed the gate.

    Attributes:
        ekf: state of the filter under this hypothesis.
        start_time: time of the first outlier [s].
        exclusive_fits: number of displacements that fitted only the alternative since the last one
            that fitted only the filter.
        shared_fits: number of latest displacements in a row that fitted both.
    """

    ekf: EkfState
    start_time: float
    exclusive_fits: int = 0
    shared_fits: int = 0

    def updated(self, fits: bool, fits_filter: bool) -> AlternativeHypothesis:
        """Return the hypothesis after counting a displacement by what it fits."""
        if not fits:
            exclusive = self.exclusive_fits if not fits_filter else 0
            return changed(self, exclusive_fits=exclusive, shared_fits=0)
        return changed(
            self,
            exclusive_fits=self.exclusive_fits + (not fits_filter),
            shared_fits=self.shared_fits + 1 if fits_filter else 0,
        )

    @property
    def should_replace(self) -> bool:
        """Whether the alternative should replace the filter's state."""
        return self.exclusive_fits >= _FITS_TO_REPLACE

    @property
    def is_obsolete(self) -> bool:
        """Whether the alternative can be dropped."""
        return self.shared_fits >= _FITS_TO_DROP or self.ekf.time - self.start_time > _MAX_SECONDS


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

    def compare(self, fits: Callable[[], bool], fits_filter: bool) -> None:
        """Test the alternative with a displacement that the filter has applied; adopt or drop it.

        Args:
            fits: updates the filter's current state with the displacement if that fits, and returns
                whether it does.
            fits_filter: whether the displacement fitted the filter.
        """
        if self.alternative is None:
            return
        filter_state, self.ekf.state = self.ekf.state, self.alternative.ekf
        fitted = fits()
        compared = changed(self.alternative, ekf=self.ekf.state).updated(fitted, fits_filter)
        self.ekf.state = compared.ekf if compared.should_replace else filter_state
        self.alternative = None if compared.should_replace or compared.is_obsolete else compared
