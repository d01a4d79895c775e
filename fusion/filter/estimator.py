"""The filter driven by successive IMU intervals: propagate, zero velocity, update, clone.

README.md, "One interval".
"""

from __future__ import annotations

from collections.abc import Sequence

from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.corrections import correction
from stario.fusion.filter.displacements import DisplacementUpdates
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.engine import UpdateResult
from stario.fusion.filter.estimates import Estimate, nav_states, smoothed_pose
from stario.fusion.filter.estimator_state import (
    EstimatorState,
    History,
    IntervalMeasurements,
    UpdateCounts,
    rewound,
    with_step,
)
from stario.fusion.filter.frame_transform import to_final_frame, with_undirected
from stario.fusion.filter.gyro_bias import AdaptiveBiasPrior
from stario.fusion.filter.hypotheses import HypothesisPair
from stario.fusion.filter.initial import PriorPose, initialise, reinitialise, tilt_sigma
from stario.fusion.filter.magnetic import MagneticUpdates, north_fix
from stario.fusion.filter.map_frame import MapFrame
from stario.fusion.filter.network_errors import ACCEL_SHARE
from stario.fusion.filter.zero_velocity import ZeroVelocity, ZeroVelocityUpdates
from stario.fusion.fixes import Accepted, Fix, by_time
from stario.fusion.health import Health, SampleCounts
from stario.fusion.imu.gap import INTERPOLATED
from stario.fusion.imu.intervals import ImuInterval, Start, split_at_fixes
from stario.fusion.imu.preintegration import Segment, segment_of
from stario.fusion.imu.stateful import WindowDisplacement
from stario.fusion.state import NavState, SmoothedPose, changed


class Estimator:
    """The state-cloning EKF driven by IMU intervals.

    Args:
        config: noise and filter settings.
        start: time and levelled attitude of the first sample.
        prior: prior on the first pose; None starts levelled, at rest, at the origin.
        streaming: True for streams: the steps of the last second are kept, since fixes may arrive
            late, and bearings are returned.

    Attributes:
        ekf: the filter.
        frame: the map frame, with all transforms so far.
        bias: the adaptive prior of the gyroscope's bias.
        released: newest pose that left the window, corrected by the whole window; None at first.
        in_gap: whether the last interval had no samples.
    """

    def __init__(
        self,
        config: NavigatorConfig,
        start: Start,
        prior: PriorPose | None = None,
        streaming: bool = False,
    ) -> None:
        f = config.filter
        self._config, self._streaming = config, streaming
        self.ekf = StateCloningEkf(f.window_updates, config.gravity)
        self.frame = MapFrame(self.ekf, prior, f)
        self._hypotheses = HypothesisPair(self.ekf)
        self._displacements = DisplacementUpdates(self._hypotheses, f)
        self.bias = AdaptiveBiasPrior(self._hypotheses, config, start.time)
        self._rest = ZeroVelocityUpdates(self._hypotheses, f)
        self._magnetic = MagneticUpdates(self._hypotheses)
        self._counts = UpdateCounts()
        self.in_gap = False
        self._history: History = ()
        self.released: Estimate | None = None
        initialise(self.ekf, start, prior, config)
        self.bias.begin()
        self._clone()

    # --- one interval ----------------------------------------------------------------------------

    def step(
        self,
        interval: ImuInterval,
        displacement: WindowDisplacement | None,
        fixes: Sequence[Fix] = (),
    ) -> IntervalMeasurements:
        """Move to the interval's end and apply the displacement of the window that ends there.

        Args:
            interval: the interval that follows the previous one.
            displacement: predicted displacement; None if no window ends or none is available.
            fixes: fixes up to the interval's end that were not given before, in order of time.
        """
        factor = self._displacements.statistics.accel_factor
        if factor != interval.accel_factor:
            interval = changed(interval, accel_factor=factor)
        if self._streaming:
            self._history = with_step(self.state, interval, displacement, fixes)
        if interval.gap or fixes:
            self._hypotheses.alternative = None
        segment, accepted = self._propagate(interval, fixes)
        before = self.ekf.state
        zupt = self._update_zero_velocity(interval)
        before = self._note_correction(before, "rest")
        # Zero velocity is more accurate than a network trained on walks, off by 1 cm/s at rest.
        offered = displacement if zupt is None else None
        outcome, revoked = self._update_displacement(offered)
        before = self._note_correction(before, "network")
        bearing = self._update_bearing(interval)
        self._note_correction(before, "magnetic field")
        accepted += self._update_north()
        before = self.ekf.state
        self.bias.update(interval)
        self._note_correction(before, "gyroscope's bias")
        if interval.update or interval.gap:
            self._clone()
        return IntervalMeasurements(
            interval, offered, outcome, revoked, bearing, zupt, accepted, segment
        )

    def late_fix(self, fix: Fix) -> list[Accepted] | None:
        """Apply a fix from the past; return None if it is more than a window late.

        The state becomes what it would be had the fix arrived in time: the filter returns to the
        state before it and repeats the steps since then with the fix in its place.

        Returns:
            All fixes applied since then, in order.
        """
        found = rewound(self.state, fix.time)
        if found is None:
            return None
        self.state, steps = found
        accepted = []
        for n, step in enumerate(steps):
            fixes = sorted((*step.fixes, fix), key=by_time) if n == 0 else step.fixes
            accepted += self.step(step.interval, step.displacement, fixes).fixes
        return accepted

    def _propagate(
        self, interval: ImuInterval, fixes: Sequence[Fix]
    ) -> tuple[Segment | None, list[Accepted]]:
        """Propagate through the fixes and, after a gap, level the attitude.

        Return the segment (None for a gap, and if fixes split it) and the fixes applied.
        """
        self.in_gap = interval.gap
        if interval.gap:
            for slot in self.ekf.state.clone_slots:  # no displacement spans a gap
                self.ekf.release(slot)
            if interval.duration > INTERPOLATED:
                # Nothing links them to the track after it, which they would seem to place.
                self._counts = self._counts.add("fixes", *["in a long gap"] * len(fixes))
                fixes = ()
        if interval.lost:
            reinitialise(self.ekf, interval, self._config)
            self.frame.lose_yaw()
            return None, []
        segment: Segment | None = None
        accepted = []
        pieces = split_at_fixes(interval, fixes)
        for piece, due in pieces:
            if piece is not None:
                segment = self._propagate_piece(piece, interval)
            accepted += [applied for fix in due if (applied := self._update_fix(fix)) is not None]
        if interval.levelled is not None:
            sigma = tilt_sigma(interval.levelled, self._config)
            self.ekf.update_tilt(interval.levelled.up_B, sigma)
        return (segment if len(pieces) == 1 else None), accepted

    def _propagate_piece(self, piece: ImuInterval, interval: ImuInterval) -> Segment | None:
        """Propagate through a piece of an interval; return its segment, None in a gap."""
        if interval.gap:
            self.ekf.propagate_in_gap(piece, interval, self._config)
            self.frame.lose_yaw()
            return None
        # The noise of faulty samples is what it may be.
        correlated = self._config.filter.correlated_errors
        accel_share = ACCEL_SHARE if correlated and not any(interval.flags) else 1.0

        def propagate() -> Segment:
            s = self.ekf.state
            segment = segment_of([piece], s.b_g, s.b_a, self._config)
            self.ekf.propagate(segment, accel_share)
            return segment

        return self._hypotheses.apply_to_both(propagate)

    def _update_fix(self, fix: Fix) -> Accepted | None:
        result = self.frame.update(fix)
        self._counts = self._counts.add("fixes", *result.outcomes)
        return Accepted(fix, result.scale) if result.accepted else None

    def _update_zero_velocity(self, interval: ImuInterval) -> ZeroVelocity | None:
        tested = self._rest.update(interval)
        if tested is None:
            return None
        result, measured = tested
        self._counts = self._counts.add("zero_velocity", *result.outcomes)
        return measured if result.accepted else None

    def _update_displacement(
        self, displacement: WindowDisplacement | None
    ) -> tuple[UpdateResult | None, tuple[float, ...]]:
        """Update with a displacement from the oldest clone.

        Return the outcome, and the times of earlier displacements that were false [s].
        """
        if displacement is None:
            return None, ()
        oldest = self.ekf.state.clone_slots[0]
        result, revoked = self._displacements.update(oldest, displacement)
        self._counts = self._counts.add_displacement(result)
        return result, revoked

    def _update_north(self) -> list[Accepted]:
        """Apply the yaw from magnetic north once, if a declination is set and yaw is unknown."""
        declination = self._config.filter.declination
        if declination is None or self.frame.state.oriented:
            return []
        fix = north_fix(self.ekf.state, self._magnetic.reference, declination)
        if fix is None:
            return []
        result = self.frame.update(fix)
        if not result.accepted:
            return []
        self._counts = self._counts.add("bearings", "north")
        self._hypotheses.alternative = None  # it is in the old frame
        return [Accepted(fix, result.scale)]

    def _update_bearing(self, interval: ImuInterval) -> tuple[EkfState, EkfState] | None:
        """Update with the magnetic field; for streams return the state before and after."""
        before = self.ekf.state
        result = self._magnetic.update(interval)
        if result is None:
            return None
        self._counts = self._counts.add("bearings", *result.outcomes)
        return (before, self.ekf.state) if self._streaming else None

    def _note_correction(self, before: EkfState, cause: str) -> EkfState:
        """Record a large correction since a state, and return the state now.

        The first window's is none: until then nothing is known about the speed.
        """
        after = self.ekf.state
        if self._counts.offered > 1:
            self._counts = self._counts.add_correction(correction(before, after, cause))
        return after

    def _clone(self) -> None:
        slots, oldest = self.ekf.state.clone_slots, None
        if len(slots) == self.ekf.slots:
            oldest = slots[0]
            self.released = self.ekf.state.clone_estimate(oldest, len(self.frame.state.transforms))
        self._hypotheses.apply_to_both(lambda: self._clone_instead_of(oldest))

    def _clone_instead_of(self, oldest: int | None) -> None:
        self.ekf.clone(instead_of=oldest)
        self.ekf.state = self.ekf.state.with_lost_yaw_forgotten()

    # --- state and results -----------------------------------------------------------------------

    @property
    def state(self) -> EstimatorState:
        """All that varies; assign an earlier one to restore it."""
        return EstimatorState(
            self.ekf.state,
            self.frame.state,
            self._rest.detector.window,
            self._rest.detector.rested,
            self._magnetic.reference,
            self._displacements.statistics,
            self.bias.prior,
            self._hypotheses.alternative,
            self._counts,
            self.released,
            self._history,
        )

    @state.setter
    def state(self, s: EstimatorState) -> None:
        self.ekf.state, self.frame.state = s.ekf, s.map_frame
        self._rest.detector.window, self._rest.detector.rested = s.stillness, s.rested
        self._magnetic.reference, self.bias.prior = s.magnetic, s.bias_prior
        self._counts = s.counts
        self._displacements.statistics = s.statistics
        self._hypotheses.alternative = s.alternative
        self.released, self._history = s.released, s.history

    @property
    def time(self) -> float:
        """Time of the newest state [s]."""
        return self.ekf.state.time

    @property
    def gating_counts(self) -> object:
        """Outcomes of displacement and zero-velocity updates; a late fix may change them."""
        return self._counts.gated, self._counts.refused, self._counts.zero_velocity

    @property
    def smoothed(self) -> SmoothedPose | None:
        """`released` as a `SmoothedPose` in the current map frame; None at first."""
        if self.released is None:
            return None
        frame = self.frame.state
        poses = to_final_frame(nav_states([self.released]), frame.transforms)
        return smoothed_pose(with_undirected(poses, frame.undirected)[0])

    def estimate(self) -> Estimate:
        """Return the estimate of the filter's newest state."""
        return self.ekf.state.estimate(self.in_gap, len(self.frame.state.transforms))

    def nav_state(self) -> NavState:
        """Return the newest state with plain errors and, if the map has one, its unknown yaw."""
        return with_undirected(nav_states([self.estimate()]), self.frame.state.undirected)[0]

    def health(self, counts: SampleCounts, state: NavState | None = None) -> Health:
        """Return the health report so far, with the sigmas of `state` if given."""
        health = self._counts.health(counts, state or self.nav_state())
        health.accel_noise_factor = self._displacements.statistics.accel_factor
        health.network_error_level = self._displacements.statistics.error_level
        if self._config.filter.declination is not None and not self.frame.state.oriented:
            health.notes.append("north could not be determined: the track starts with yaw zero")
        return health
