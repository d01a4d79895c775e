"""The complete state of an estimator, and the steps of the last second that a late fix repeats.

States are immutable, so that keeping those of the last second costs references only.
README.md, "Fixes".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from stario.fusion.filter.alternative import AlternativeHypothesis, Hypotheses
from stario.fusion.filter.corrections import correction
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.estimates import Estimate, nav_states, smoothed_pose
from stario.fusion.filter.frame_transform import MapFrameState, to_final_frame, with_unknown_yaws
from stario.fusion.filter.gyro_bias import GyroBiasPrior
from stario.fusion.filter.innovations import InnovationStatistics
from stario.fusion.filter.magnetic import MagneticReference, north_contradiction
from stario.fusion.filter.record import UpdateCounts
from stario.fusion.filter.vehicle import RideEvidence
from stario.fusion.filter.zero_velocity import Stillness
from stario.fusion.imu.inference import WindowDisplacement
from stario.fusion.imu.intervals import SAME_TIME, ImuInterval
from stario.fusion.values.config import FilterConfig
from stario.fusion.values.fixes import Fix
from stario.fusion.values.health import Health
from stario.fusion.values.state import NavState, SmoothedPose, changed
from stario.sequences.windows import WINDOW_SECONDS


@dataclass(frozen=True, eq=False)
class Step:
    """Inputs of a step and the state before it, from which a late fix can repeat it."""

    before: EstimatorState
    interval: ImuInterval
    displacement: WindowDisplacement | None
    fixes: Sequence[Fix]


History = tuple[Step, ...]
"""Steps of the last second, in order."""


@dataclass(frozen=True, eq=False)
class EstimatorState:
    """Complete state of an estimator between two intervals; never modified in place.

    Attributes:
        begun: time of the first state [s].
        ekf: pose, biases, clones and their covariance.
        map_frame: what is known about the map frame, with all transforms so far.
        bias_prior: prior of the gyroscope's bias, as currently applied in the filter.
        history: steps of the last second of a stream; None for a recording.
        stillness: whether the device has been at rest.
        magnetic: usual size, dip and spread of the magnetic field.
        statistics: what the innovations of displacements tell.
        alternative: the alternative hypothesis; None while all displacements fit.
        counts: updates by outcome.
        ride: whether the device rides in a vehicle, and when it did.
        climb_rate: vertical speed by the pressure while it climbs [m/s]; 0 on a floor.
        in_gap: whether the last interval had no samples.
        released: newest pose that left the window, corrected by the whole window; None at first.
    """

    begun: float
    ekf: EkfState
    map_frame: MapFrameState
    bias_prior: GyroBiasPrior
    history: History | None
    stillness: Stillness = field(default_factory=Stillness)
    magnetic: MagneticReference = field(default_factory=MagneticReference)
    statistics: InnovationStatistics = field(default_factory=InnovationStatistics)
    alternative: AlternativeHypothesis | None = None
    counts: UpdateCounts = field(default_factory=UpdateCounts)
    ride: RideEvidence = field(default_factory=RideEvidence)
    climb_rate: float = 0.0
    in_gap: bool = False
    released: Estimate | None = None

    @property
    def hypotheses(self) -> Hypotheses:
        """The filter and its alternative."""
        return Hypotheses(self.ekf, self.alternative)

    def with_hypotheses(self, after: Hypotheses) -> EstimatorState:
        """Return the state with another filter and alternative."""
        return changed(self, ekf=after.ekf, alternative=after.alternative)

    def both(self, work: Callable[[EkfState], EkfState]) -> EstimatorState:
        """Return the state after the same work on the filter and its alternative."""
        return self.with_hypotheses(self.hypotheses.both(work))

    def counted(self, kind: str, *outcomes: str) -> EstimatorState:
        """Return the state with outcomes of a kind of update counted."""
        return changed(self, counts=self.counts.add(kind, *outcomes))

    def with_correction(self, before: EkfState, cause: str) -> EstimatorState:
        """Return the state with a large correction since another one recorded.

        The first window's is none: until then nothing is known about the speed.
        """
        if self.ekf is before or self.counts.offered <= 1:
            return self
        return changed(self, counts=self.counts.add_correction(correction(before, self.ekf, cause)))

    # --- results ---------------------------------------------------------------------------------

    @property
    def time(self) -> float:
        """Time of the newest state [s]."""
        return self.ekf.time

    def estimate(self) -> Estimate:
        """Return the estimate of the filter's newest state."""
        return self.with_way(self.ekf.estimate(self.in_gap, len(self.map_frame.transforms)))

    def with_way(self, estimate: Estimate) -> Estimate:
        """Return an estimate that knows of the unknown way of rides since the last position."""
        return changed(estimate, way_variance=self.way_variance(estimate.time))

    def way_variance(self, time: float) -> float:
        """Return the variance per axis [m^2] of the way in rides from the last position to then."""
        return self.ride.way_variance(time, self.map_frame.agreed[0])

    def nav_state(self) -> NavState:
        """Return the newest state with plain errors and, if the map has one, its unknown yaw."""
        return with_unknown_yaws(nav_states([self.estimate()]), self.map_frame.unknown_yaws)[0]

    @property
    def smoothed(self) -> SmoothedPose | None:
        """`released` as a `SmoothedPose` in the current map frame; None at first."""
        if self.released is None:
            return None
        poses = to_final_frame(nav_states([self.released]), self.map_frame.transforms)
        return smoothed_pose(with_unknown_yaws(poses, self.map_frame.unknown_yaws)[0])

    def health(self, counts: Health, f: FilterConfig, state: NavState | None = None) -> Health:
        """Return the health report so far, with the sigmas of `state` if given."""
        health = self.counts.health(counts, state or self.nav_state())
        health.accel_noise_factor = self.statistics.accel_factor
        health.network_error_level = self.statistics.error_level
        health.rides = list(self.ride.rides)
        health.jumps = [(*jump,) for jump in self.map_frame.jumps]
        if f.declination is None:
            return health
        if not self.map_frame.yaw_known:
            health.notes.append("north could not be determined: the track starts with yaw zero")
        else:
            apart = north_contradiction(self.ekf, self.magnetic, f.declination)
            health.north_contradiction = apart
        return health


def with_step(
    s: EstimatorState,
    interval: ImuInterval,
    displacement: WindowDisplacement | None,
    fixes: Sequence[Fix],
) -> EstimatorState:
    """Return the state with the step that is about to begin, without those too old for a fix.

    Args:
        s: the state before the step.
        interval: interval of the step.
        displacement: displacement given with it; None if there is none.
        fixes: fixes given with it.
    """
    if s.history is None:
        return s
    step = Step(changed(s, history=()), interval, displacement, tuple(fixes))
    oldest = interval.stop - WINDOW_SECONDS - SAME_TIME
    kept = (each for each in s.history if each.interval.stop >= oldest)
    return changed(s, history=(*kept, step))


def rewound(s: EstimatorState, time: float) -> tuple[EstimatorState, History] | None:
    """Return the state before the step that contains a time, and the steps to be repeated.

    Args:
        s: the newest state, with its history.
        time: time of a late fix [s].

    Returns:
        None if the time is more than a window ago, or before the stream began.
    """
    steps = s.history
    oldest = s.time - WINDOW_SECONDS - SAME_TIME
    if time < oldest or not steps or time < steps[0].interval.start:
        return None
    k = int(np.searchsorted([step.interval.stop for step in steps[:-1]], time))
    return changed(steps[k].before, history=steps[:k]), steps[k:]
