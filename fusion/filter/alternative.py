"""The alternative hypothesis that a displacement beyond its gate opens.

Under it, the displacements since then share a steady error. README.md, "Gates".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.values.state import changed


@dataclass(frozen=True, eq=False)
class AlternativeHypothesis:
    """State of the filter if the displacements since an outlier contained one steady error.

    Less this error they still measure how the velocity changes. Without that, tilt and bias of the
    accelerometer would soon explain any displacement.

    Attributes:
        ekf: state of the filter under this hypothesis, with that error.
        false: times of the displacements that contain it [s]; the first opened the alternative.
    """

    ekf: EkfState
    false: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """A filter's state, and the alternative; None while all displacements fit."""

    ekf: EkfState
    alternative: AlternativeHypothesis | None = None

    def both(self, work: Callable[[EkfState], EkfState]) -> Hypotheses:
        """Return both after the same work."""
        after, other = work(self.ekf), self.alternative
        return Hypotheses(after, other and changed(other, ekf=work(other.ekf)))
