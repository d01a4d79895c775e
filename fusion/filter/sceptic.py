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

_CONVINCING = 2
"""Displacements that fit the sceptic alone, until it is believed."""

_ALIKE = 4
"""That fit both: it was one outlier, or few, and nothing is left to decide."""

_SECONDS = 6.0
"""The IMU alone knows no more beyond."""

Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class Sceptic:
    """The filter had it left out the displacements that do not fit.

    Attributes:
        ekf: its state.
        began: time of the first outlier [s].
        right: displacements since that fitted it and not the filter.
        alike: in a row that fitted both.
    """

    ekf: EkfState
    began: float
    right: int = 0
    alike: int = 0

    def judged(self, fits: bool, fits_filter: bool) -> Sceptic:
        """With whether a displacement fits it, and whether it fits the filter."""
        if not fits:
            alone = self.right if not fits_filter else 0
            return changed(self, right=alone, alike=0)
        return changed(
            self, right=self.right + (not fits_filter), alike=self.alike + 1 if fits_filter else 0
        )

    @property
    def is_convincing(self) -> bool:
        """Whether it should take the filter's place."""
        return self.right >= _CONVINCING

    @property
    def is_over(self) -> bool:
        """Whether it is of no more use."""
        return self.alike >= _ALIKE or self.ekf.time - self.began > _SECONDS


class SecondOpinion:
    """A filter, and the sceptic beside it while there is one.

    Args:
        ekf: the filter; its state is put aside while the sceptic takes its turn.

    Attributes:
        ekf: the filter.
        sceptic: None while all displacements fit.
    """

    def __init__(self, ekf: StateCloningEkf) -> None:
        self.ekf = ekf
        self.sceptic: Sceptic | None = None

    def both(self, work: Callable[[], Made]) -> Made:
        """Do it to the filter, then to the sceptic; returns what came of the first."""
        made = work()
        if self.sceptic is not None:
            mine, self.ekf.state = self.ekf.state, self.sceptic.ekf
            work()
            self.sceptic, self.ekf.state = changed(self.sceptic, ekf=self.ekf.state), mine
        return made

    def ask(self, fits: Callable[[], bool], fits_filter: bool) -> None:
        """About a displacement that the filter has taken in.

        Args:
            fits: updates whatever state the filter holds with it, if it fits that one.
            fits_filter: whether it fitted the filter.
        """
        if self.sceptic is None:
            return
        mine, self.ekf.state = self.ekf.state, self.sceptic.ekf
        fitted = fits()
        asked = changed(self.sceptic, ekf=self.ekf.state).judged(fitted, fits_filter)
        self.ekf.state = asked.ekf if asked.is_convincing else mine
        self.sceptic = None if asked.is_convincing or asked.is_over else asked
