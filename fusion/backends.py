"""The back ends behind one interface: the filter, and the factor graph that starts from it.

For a stream a back end makes an estimator that is stepped from interval to interval; for a
recording it turns what the filter made of it into the track's states.
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
from stario.fusion.filter.frame_transform import in_last_frame, smoothed_track
from stario.fusion.filter.initial import PriorPose
from stario.fusion.fixes import Accepted, Fix, FixQueue
from stario.fusion.graph.batch import smooth
from stario.fusion.graph.fixed_lag import FixedLagEstimator
from stario.fusion.imu.intervals import ImuInterval, SampleCounts, Start
from stario.fusion.recording import PreprocessedRecording, Progress
from stario.fusion.state import Health, NavState, SmoothedPose, Track, track_from_states
from stario.sequences.sequence import Trajectory

BackendName = Literal["ekf", "graph"]
"""The filter; or the factor graph, fixed-lag for streams and of the whole for recordings."""


class StreamEstimator(Protocol):
    """What a stream needs of an estimator."""

    @property
    def time(self) -> float:
        """Of the newest state [s]."""

    @property
    def smoothed(self) -> SmoothedPose | None:
        """The newest pose one window late, None where there is none."""

    state: Any
    """All that varies, for a snapshot; one from a snapshot may be put back."""

    def step(
        self, interval: ImuInterval, displacement: Displacement | None, fixes: Sequence[Fix] = ()
    ) -> object:
        """Move to the interval's end and take in what was measured."""

    def late_fix(self, fix: Fix) -> list[Accepted] | None:
        """Take in a fix at a time before now; None where it is too late."""

    def nav_state(self) -> NavState:
        """The newest state."""

    def health(self, counts: SampleCounts) -> Health:
        """The report so far."""


@dataclass(frozen=True, eq=False)
class FilteredRecording:
    """What the filter made of a recording.

    Attributes:
        estimator: behind the last interval.
        estimates: the start and one for each interval.
        measurements: what it took in, one for each interval.
        clones: poses that left the window, corrected by all of it.
    """

    estimator: Estimator
    estimates: list[Estimate]
    measurements: list[IntervalMeasurements]
    clones: list[Estimate]


@dataclass(frozen=True, eq=False)
class Solution:
    """States of a recording in the frame it ends in, the poses one window late, and notes."""

    states: list[NavState]
    smoothed: Trajectory | None
    notes: list[str]


class Backend(Protocol):
    """What a navigator needs of a back end."""

    def stream(
        self, config: NavigatorConfig, start: Start, prior: PriorPose | None
    ) -> StreamEstimator:
        """An estimator for a stream that starts so."""

    def solve(self, filtered: FilteredRecording, config: NavigatorConfig) -> Solution:
        """The states of a recording."""


class EkfBackend:
    """The state-cloning EKF."""

    def stream(
        self, config: NavigatorConfig, start: Start, prior: PriorPose | None
    ) -> StreamEstimator:
        """An estimator that keeps the last second, since fixes may come late."""
        return Estimator(config, start, prior, streaming=True)

    def solve(self, filtered: FilteredRecording, config: NavigatorConfig) -> Solution:
        """The filter's states."""
        transforms = filtered.estimator.map_frame_state.transforms
        states = in_last_frame(nav_states(filtered.estimates), transforms)
        smoothed = smoothed_track(smoothed_poses(filtered.clones), transforms)
        return Solution(states, smoothed, [])


class GraphBackend:
    """The factor graph, more accurate and slower."""

    def stream(
        self, config: NavigatorConfig, start: Start, prior: PriorPose | None
    ) -> StreamEstimator:
        """The fixed-lag graph."""
        return FixedLagEstimator(config, start, prior)

    def solve(self, filtered: FilteredRecording, config: NavigatorConfig) -> Solution:
        """The whole optimised at once; the filter's states where that is not determined."""
        estimator = filtered.estimator
        transforms, states = estimator.map_frame_state.transforms, nav_states(filtered.estimates)
        end, seen = states[-1], estimator.ekf.state.field is not None
        bias = (end.b_g, end.covariance[9:12, 9:12]) if seen else None
        own = in_last_frame(states, transforms)
        first = _with_bias_prior(states[0], estimator.bias_prior.variance)
        sigma = config.filter.network_turn_sigma if estimator.ekf.state.has_turn else 0.0
        whole = smooth(own, first, filtered.measurements, transforms, config, bias, sigma)
        return Solution(own if whole.fell_back else whole.states, None, [whole.note])


def _with_bias_prior(first: NavState, variance: float) -> NavState:
    """The first state with the gyroscope bias's prior as it proved right later."""
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
    """The track of a recording: filtered, then solved by the back end."""
    began = perf_counter()
    queue = FixQueue(fixes, most=math.inf)  # a recording's are all there at once
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
        taken = estimator.step(interval, displacement, queue.due(interval.stop))
        filtered.measurements.append(taken)
        filtered.estimates.append(estimator.estimate())
        clone = estimator.released
        if clone is not None and clone not in filtered.clones[-1:]:
            filtered.clones.append(clone)
        if k % 500 == 0:
            progress(0.6 + 0.4 * k / len(recording.intervals))
    progress(1.0)
    queue.refuse("after the end", len(queue.due(math.inf)))
    return filtered
