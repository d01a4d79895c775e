"""Input and output of an estimator's step, counts of its updates, and its complete state.

States are immutable, so that keeping those of the last second costs references only: a late fix
returns to one of them and repeats the steps since then. README.md, "Fixes".
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from stario.fusion.filter.corrections import CORRECTIONS_LISTED, Correction
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.filter.estimates import Estimate
from stario.fusion.filter.frame_transform import MapFrameState
from stario.fusion.filter.gyro_bias import GyroBiasPrior
from stario.fusion.filter.hypotheses import AlternativeHypothesis
from stario.fusion.filter.magnetic import MagneticReference
from stario.fusion.filter.network_errors import InnovationStatistics
from stario.fusion.filter.zero_velocity import ZeroVelocity
from stario.fusion.fixes import Accepted, Fix
from stario.fusion.health import Health, SampleCounts
from stario.fusion.imu.intervals import SAME_TIME, ImuInterval
from stario.fusion.imu.preintegration import Segment
from stario.fusion.imu.stateful import WindowDisplacement
from stario.fusion.state import Innovations, NavState, changed
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS


class IntervalMeasurements(NamedTuple):
    """An IMU interval and the measurements applied in it."""

    interval: ImuInterval
    offered: WindowDisplacement | None
    """Predicted displacement of the window ending here; None if no window ends, or at rest."""
    outcome: UpdateResult | None
    """Outcome of the update with it; None without one."""
    revoked: tuple[float, ...]
    """Times of earlier displacements that were false after all [s] (README.md, "Gates")."""
    bearing: tuple[EkfState, EkfState] | None
    """Filter state before and after the update with a bearing; None if there was none, and for
    recordings, whose measurements all stay in memory."""
    zero_velocity: ZeroVelocity | None
    """Measurement at rest; None if the device moved or the measurement was rejected."""
    fixes: list[Accepted]
    """Fixes applied, in order."""
    segment: Segment | None
    """The preintegrated samples; None for a gap, and if fixes split them."""

    @property
    def displacement(self) -> WindowDisplacement | None:
        """The displacement with its inflated covariance; None if there is none or it is refused."""
        if self.offered is None or self.outcome is None or not self.outcome.accepted:
            return None
        covariance_N = self.outcome.scale * self.offered.covariance_N
        return self.offered._replace(covariance_N=covariance_N)


@dataclass(frozen=True)
class UpdateCounts:
    """Counts of updates by outcome; never modified in place.

    Attributes:
        offered: number of network measurements.
        gated: number of these that were outliers, rejected or inflated.
        refused: numbers of these that were invalid, by reason.
        fixes: numbers of fixes applied (of these gated), and refused by reason.
        zero_velocity: numbers of measurements at rest applied, and refused by reason.
        bearings: numbers of magnetic bearings, likewise; 1 under "north" if they determined it.
        nis_sum: sum of the NIS of all valid network measurements.
        nis_count: number of valid network measurements.
        corrections: the latest large corrections.
    """

    offered: int = 0
    gated: int = 0
    refused: Mapping[str, int] = field(default_factory=dict)
    fixes: Mapping[str, int] = field(default_factory=dict)
    zero_velocity: Mapping[str, int] = field(default_factory=dict)
    bearings: Mapping[str, int] = field(default_factory=dict)
    nis_sum: float = 0.0
    nis_count: int = 0
    corrections: tuple[Correction, ...] = ()

    def add_correction(self, found: Correction | None) -> UpdateCounts:
        """Return the counts with one more correction, if there is one."""
        if found is None:
            return self
        return changed(self, corrections=(*self.corrections, found)[-CORRECTIONS_LISTED:])

    def add_displacement(self, result: UpdateResult) -> UpdateCounts:
        """Return the counts with one more network measurement."""
        counts = changed(self, offered=self.offered + 1)
        if result.residual is None:
            return counts.add("refused", result.reason)
        return changed(
            counts,
            gated=self.gated + result.gated,
            nis_sum=self.nis_sum + result.nis,
            nis_count=self.nis_count + 1,
        )

    def add(self, kind: str, *outcomes: str) -> UpdateCounts:
        """Return the counts with one more of each outcome in the attribute named `kind`."""
        counts = dict(getattr(self, kind))
        for outcome in outcomes:
            counts[outcome] = counts.get(outcome, 0) + 1
        return changed(self, **{kind: counts})

    def health(self, counts: SampleCounts, state: NavState) -> Health:
        """Return the health report: outcomes of samples and updates, and the state's sigmas."""
        groups = {
            "tilt_rad": slice(0, 2),
            "yaw_rad": slice(2, 3),
            "velocity_m_s": slice(3, 6),
            "position_m": slice(6, 8),
            "height_m": slice(8, 9),
            "gyro_bias_rad_s": slice(9, 12),
            "accel_bias_m_s2": slice(12, 15),
        }
        # The largest in any direction, not along an axis: W's yaw is arbitrary.
        variance = {
            name: np.linalg.eigvalsh(state.covariance[part, part])[-1]
            for name, part in groups.items()
        }
        return changed(
            counts.health(),
            updates=self.offered,
            gated=self.gated,
            refused=dict(self.refused),
            mean_nis=self.nis_sum / self.nis_count if self.nis_count else math.nan,
            fixes=dict(self.fixes),
            zero_velocity=dict(self.zero_velocity),
            bearings=dict(self.bearings),
            corrections=list(self.corrections),
            final_sigma={name: math.sqrt(max(value, 0.0)) for name, value in variance.items()},
        )


def innovations_of(measurements: Iterable[IntervalMeasurements]) -> Innovations:
    """Return the innovations of all valid displacements."""
    rows = [
        (m.interval.stop, *m.outcome.residual, *m.outcome.sigma, m.outcome.nis, m.outcome.gated)
        for m in measurements
        if m.outcome is not None and m.outcome.residual is not None and m.outcome.sigma is not None
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 9)
    return Innovations(
        time=table[:, 0],
        residual_W=table[:, 1:4],
        sigma=table[:, 4:7],
        nis=table[:, 7],
        gated=table[:, 8] > 0.5,
    )


@dataclass(frozen=True, eq=False)
class Step:
    """Inputs of a step and the state before it, from which a late fix can repeat it."""

    before: EstimatorState
    interval: ImuInterval
    displacement: WindowDisplacement | None
    fixes: Sequence[Fix]


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """Complete state of an estimator between two intervals; never modified in place.

    Attributes:
        ekf: pose, biases, clones and their covariance.
        map_frame: what is known about the map frame.
        stillness: sums over the last second (`StillnessDetector`).
        rested: number of intervals of uninterrupted stillness so far.
        magnetic: usual size, dip and spread of the magnetic field.
        statistics: what the innovations of displacements tell.
        bias_prior: prior of the gyroscope's bias, as currently applied in the filter.
        alternative: the alternative hypothesis; None while all displacements fit.
        counts: updates by outcome.
        released: newest pose that left the window, corrected by the whole window.
        history: steps of the last second of a stream; empty for a recording.
    """

    ekf: EkfState
    map_frame: MapFrameState
    stillness: tuple[FloatArray | None, ...]
    rested: int
    magnetic: MagneticReference
    statistics: InnovationStatistics
    bias_prior: GyroBiasPrior
    alternative: AlternativeHypothesis | None
    counts: UpdateCounts
    released: Estimate | None
    history: History = ()


History = tuple[Step, ...]
"""Steps of the last second, in order."""


def with_step(
    state: EstimatorState,
    interval: ImuInterval,
    displacement: WindowDisplacement | None,
    fixes: Sequence[Fix],
) -> History:
    """Return the history with the step that is about to begin, without those too old for a fix.

    Args:
        state: the state before the step, with the history so far.
        interval: interval of the step.
        displacement: displacement given with it; None if there is none.
        fixes: fixes given with it.
    """
    step = Step(changed(state, history=()), interval, displacement, tuple(fixes))
    oldest = interval.stop - WINDOW_SECONDS - SAME_TIME
    return (*(s for s in state.history if s.interval.stop >= oldest), step)


def rewound(state: EstimatorState, time: float) -> tuple[EstimatorState, History] | None:
    """Return the state before the step that contains a time, and the steps to be repeated.

    Args:
        state: the newest state, with its history.
        time: time of a late fix [s].

    Returns:
        None if the time is more than a window ago, or before the stream began.
    """
    steps = state.history
    oldest = state.ekf.time - WINDOW_SECONDS - SAME_TIME
    if time < oldest or not steps or time < steps[0].interval.start:
        return None
    k = int(np.searchsorted([step.interval.stop for step in steps[:-1]], time))
    return changed(steps[k].before, history=steps[:k]), steps[k:]
