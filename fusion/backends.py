"""The two back ends behind one interface: the EKF, and the factor graph initialised from it.

For a stream, a back end creates an estimator that is stepped interval by interval; for a recording,
it turns the filter's output into the states of the track.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, Literal, Protocol

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.ekf_state import Estimate, nav_states, smoothed_poses
from stario.fusion.filter.estimator import Estimator
from stario.fusion.filter.estimator_state import Displacement, IntervalMeasurements
from stario.fusion.filter.frame_transform import smoothed_track, to_final_frame, with_undirected
from stario.fusion.filter.initial import PriorPose
from stario.fusion.fixes import Accepted, Fix, FixQueue
from stario.fusion.graph.batch import smooth
from stario.fusion.graph.fixed_lag import FixedLagEstimator
from stario.fusion.imu.intervals import ImuInterval, SampleCounts, Start
from stario.fusion.recording import PreprocessedRecording, Progress
from stario.fusion.state import Health, NavState, SmoothedPose, Track, track_from_states
from stario.sequences.sequence import Trajectory

BackendName = Literal["ekf", "graph"]
"""The EKF, or the factor graph: fixed-lag for streams, the whole track for recordings."""


class StreamEstimator(Protocol):
    """Interface of an estimator that runs on a stream."""

    @property
    def time(self) -> float:
        """Time of the newest state [s]."""

    @property
    def smoothed(self) -> SmoothedPose | None:
        """The newest pose, delayed by one window; None if there is none."""

    state: Any
    """The complete state, for snapshots; assigning one restores it."""

    def step(
        self, interval: ImuInterval, displacement: Displacement | None, fixes: Sequence[Fix] = ()
    ) -> object:
        """Propagate to the end of the interval and apply its measurements."""

    def late_fix(self, fix: Fix) -> list[Accepted] | None:
        """Apply a fix from the past; return None if it is too old."""

    def nav_state(self) -> NavState:
        """Return the newest state."""

    def health(self, counts: SampleCounts) -> Health:
        """Return the health report so far."""


@dataclass(frozen=True, eq=False)
class FilteredRecording:
    """A recording after the filter.

    Attributes:
        estimator: the filter after the last interval.
        estimates: the initial state and one per interval.
        measurements: measurements applied, one entry per interval.
        clones: poses released from the window, corrected by all its measurements.
    """

    estimator: Estimator
    estimates: list[Estimate]
    measurements: list[IntervalMeasurements]
    clones: list[Estimate]


@dataclass(frozen=True, eq=False)
class Solution:
    """States of a recording in its final map frame, poses delayed by one window, and notes."""

    states: list[NavState]
    smoothed: Trajectory | None
    notes: list[str]


class Backend(Protocol):
    """Interface of a back end."""

    def stream(
        self, config: NavigatorConfig, start: Start, prior: PriorPose | None
    ) -> StreamEstimator:
        """Create an estimator for a stream with this start."""

    def solve(self, filtered: FilteredRecording, config: NavigatorConfig) -> Solution:
        """Return the states of a filtered recording."""


class EkfBackend:
    """The state-cloning EKF."""

    def stream(
        self, config: NavigatorConfig, start: Start, prior: PriorPose | None
    ) -> StreamEstimator:
        """Create an estimator that keeps the last second, since fixes may come late."""
        return Estimator(config, start, prior, streaming=True)

    def solve(self, filtered: FilteredRecording, config: NavigatorConfig) -> Solution:
        """Return the filter's states."""
        frame = filtered.estimator.map_frame_state
        states = to_final_frame(nav_states(filtered.estimates), frame.transforms)
        smoothed = smoothed_track(
            smoothed_poses(filtered.clones), (*frame.transforms, *frame.undirected)
        )
        return Solution(with_undirected(states, frame.undirected), smoothed, [])


class GraphBackend:
    """The factor graph: more accurate, and slower."""

    def stream(
        self, config: NavigatorConfig, start: Start, prior: PriorPose | None
    ) -> StreamEstimator:
        """Create a fixed-lag graph."""
        return FixedLagEstimator(config, start, prior)

    def solve(self, filtered: FilteredRecording, config: NavigatorConfig) -> Solution:
        """Optimise the whole track at once; the filter's states if the graph is indeterminate."""
        estimator = filtered.estimator
        frame, states = estimator.map_frame_state, nav_states(filtered.estimates)
        end, has_field = states[-1], estimator.ekf.state.field is not None
        bias = (end.b_g, end.covariance[9:12, 9:12]) if has_field else None
        filtered_states = to_final_frame(states, frame.transforms)
        first = _with_bias_prior(states[0], estimator.bias_prior.variance)
        sigma = config.filter.network_turn_sigma if estimator.ekf.state.has_turn else 0.0
        smoothed = smooth(
            filtered_states, first, filtered.measurements, frame.transforms, config, bias, sigma
        )
        solved = filtered_states if smoothed.fell_back else smoothed.states
        return Solution(with_undirected(solved, frame.undirected), None, [smoothed.note])


def _with_bias_prior(first: NavState, variance: float) -> NavState:
    """Return the first state with the gyroscope bias prior that the filter ended with."""
    covariance = first.covariance.copy()
    covariance[9:12, 9:12] = variance * np.eye(3)
    return replace(first, covariance=covariance)


BACKENDS: dict[str, Backend] = {"ekf": EkfBackend(), "graph": GraphBackend()}


def track_recording(
    backend: Backend,
    recording: PreprocessedRecording,
    config: NavigatorConfig,
    prior: PriorPose | None,
    fixes: Iterable[Fix],
    progress: Progress,
) -> Track:
    """Filter a recording, then solve it with the back end."""
    began = perf_counter()
    queue = FixQueue(fixes, most=math.inf)  # all fixes of a recording are known from the start
    filtered = _filtered(recording, config, prior, queue, progress)
    solution = backend.solve(filtered, config)
    counts, estimator = recording.front_end.counts, filtered.estimator
    health = queue.health(estimator.health(counts, solution.states[-1]))
    return track_from_states(
        solution.states,
        estimator.innovations(),
        replace(health, notes=[*health.notes, *solution.notes]),
        smoothed=solution.smoothed,
        seconds_network=recording.seconds_network,
        seconds_filter=recording.seconds_front_end + perf_counter() - began,
    )


def _filtered(
    recording: PreprocessedRecording,
    config: NavigatorConfig,
    prior: PriorPose | None,
    queue: FixQueue,
    progress: Progress,
) -> FilteredRecording:
    start = recording.front_end.start
    assert start is not None  # recordings without one are refused
    queue.start(start.time)
    estimator = Estimator(config, start, prior)
    filtered = FilteredRecording(estimator, [estimator.estimate()], [], [])
    pairs = zip(recording.intervals, recording.measurements, strict=True)
    for k, (interval, displacement) in enumerate(pairs):
        applied = estimator.step(interval, displacement, queue.due(interval.stop))
        filtered.measurements.append(applied)
        filtered.estimates.append(estimator.estimate())
        clone = estimator.released
        if clone is not None and clone not in filtered.clones[-1:]:
            filtered.clones.append(clone)
        if k % 500 == 0:
            progress(0.6 + 0.4 * k / len(recording.intervals))
    progress(1.0)
    queue.refuse("after the end", len(queue.due(math.inf)))
    return filtered
