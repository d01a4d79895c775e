"""The two estimators, EKF and factor graph, of streams and of recordings.

A stream's is stepped interval by interval. A recording is filtered, and then smoothed as a whole by
the graph, which starts from the filter's states.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from time import perf_counter
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.estimates import Estimate, nav_states
from stario.fusion.filter.estimator import Estimator
from stario.fusion.filter.estimator_state import IntervalMeasurements, innovations_of
from stario.fusion.filter.frame_transform import frame_rotation, to_final_frame, with_undirected
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.jacobians import ASSUMED, GYRO_BIAS
from stario.fusion.fixes import Accepted, Fix, FixQueue
from stario.fusion.graph.batch import smooth
from stario.fusion.graph.covariances import with_actual_covariances
from stario.fusion.graph.fixed_lag import FixedLagEstimator
from stario.fusion.graph.whitening import IndeterminateError
from stario.fusion.health import Health, SampleCounts
from stario.fusion.imu.intervals import ImuInterval, Start
from stario.fusion.imu.stateful import WindowDisplacement
from stario.fusion.recording import PreprocessedRecording, Progress
from stario.fusion.state import NavState, SmoothedPose, Track, track_from_states
from stario.sequences.arrays import check_type
from stario.sequences.errors import InputError

BackendName = Literal["ekf", "graph"]
"""The EKF, or the factor graph: over the last seconds of a stream, over all of a recording."""


class StreamEstimator(Protocol):
    """An estimator that runs on a stream, interval by interval; see `filter.estimator`."""

    state: Any
    """Complete state, which can be assigned back."""

    def step(
        self,
        interval: ImuInterval,
        displacement: WindowDisplacement | None,
        fixes: Sequence[Fix] = (),
    ) -> object:
        """Move to the interval's end and apply the displacement of the window that ends there."""

    def late_fix(self, fix: Fix) -> list[Accepted] | None:
        """Apply a fix from the past; return all fixes applied since, None if it is too late."""

    def nav_state(self) -> NavState:
        """Return the newest state."""

    def health(self, counts: SampleCounts) -> Health:
        """Return the health report so far."""

    @property
    def time(self) -> float:
        """Time of the newest state [s]."""

    @property
    def smoothed(self) -> SmoothedPose | None:
        """Newest pose delayed by one window; None at first, and if there are none."""


class FilteredRecording(NamedTuple):
    """A recording after the filter."""

    estimator: Estimator
    """The filter after the last interval."""
    estimates: list[Estimate]
    """The initial state and one per interval."""
    measurements: list[IntervalMeasurements]
    """Measurements applied, one entry per interval."""


STREAM_ESTIMATORS: dict[
    BackendName, Callable[[NavigatorConfig, Start, PriorPose | None], StreamEstimator]
] = {"ekf": partial(Estimator, streaming=True), "graph": FixedLagEstimator}
"""By back end, what creates the estimator of a stream from configuration, start and prior."""


def _filtered_states(filtered: FilteredRecording) -> list[NavState]:
    """Return the filter's states in the final map frame."""
    frame = filtered.estimator.frame.state
    states = to_final_frame(nav_states(filtered.estimates), frame.transforms)
    return with_undirected(states, frame.undirected)


def _smoothed_states(
    filtered: FilteredRecording, config: NavigatorConfig
) -> tuple[list[NavState], str]:
    """Optimise the whole track at once; the filter's states if the graph is indeterminate.

    Returns:
        States in the final map frame, and a note for the health report if the graph failed.
    """
    estimator = filtered.estimator
    frame, states = estimator.frame.state, nav_states(filtered.estimates, ASSUMED)
    end, has_field = states[-1], estimator.ekf.state.field is not None
    bias = (end.b_g, end.covariance[GYRO_BIAS, GYRO_BIAS]) if has_field else None
    covariance = states[0].covariance.copy()
    # The filter's last prior.
    covariance[GYRO_BIAS, GYRO_BIAS] = estimator.bias.prior.variance * np.eye(3)
    first = replace(states[0], covariance=covariance)
    final = to_final_frame(states, frame.transforms)
    has_turn = estimator.ekf.state.has_turn
    try:
        solved = smooth(
            final, first, filtered.measurements, frame.transforms, config, bias, has_turn
        )
    except IndeterminateError as error:
        return _filtered_states(filtered), f"graph fell back to the filter's track: {error}"
    turns = [
        frame_rotation(after.R_WB @ before.R_WB.T)
        for before, after in zip(states, final, strict=True)
    ]
    solved = with_actual_covariances(solved, filtered.estimates, np.array(turns))
    return with_undirected(solved, frame.undirected), ""


def track_recording(
    backend: BackendName,
    recording: PreprocessedRecording,
    config: NavigatorConfig,
    prior: PriorPose | None,
    fixes: Iterable[Fix],
    progress: Progress,
) -> Track:
    """Filter a recording, and smooth it if the back end is the graph.

    Raises:
        InputError: it was preprocessed for another update rate, or an argument has the wrong type.
    """
    check_type("preprocessed", recording, PreprocessedRecording, "observe(sequence) returns one")
    if recording.update_rate != config.filter.update_rate:
        raise InputError(
            "preprocessed: update_rate",
            str(recording.update_rate),
            f"this navigator's {config.filter.update_rate}",
            "observe with the same update rate",
        )
    began = perf_counter()
    queue = FixQueue(fixes, most=math.inf)  # all fixes of a recording are known from the start
    run = _filtered(recording, config, prior, queue, progress)
    innovations = innovations_of(run.measurements)

    def track(states: list[NavState], note: str = "", filtered: Track | None = None) -> Track:
        health = queue.health(run.estimator.health(recording.front_end.counts, states[-1]))
        return track_from_states(
            states,
            innovations,
            replace(health, notes=[*health.notes, *([note] if note else [])]),
            filtered=filtered,
            seconds_network=recording.seconds_network,
            seconds_filter=recording.seconds_front_end + perf_counter() - began,
        )

    found = track(_filtered_states(run))
    if backend == "graph":
        found = track(*_smoothed_states(run, config), filtered=found)
    progress(1.0)
    return found


def _filtered(
    recording: PreprocessedRecording,
    config: NavigatorConfig,
    prior: PriorPose | None,
    queue: FixQueue,
    progress: Progress,
) -> FilteredRecording:
    queue.start(recording.start.time)
    estimator = Estimator(config, recording.start, prior)
    filtered = FilteredRecording(estimator, [estimator.estimate()], [])
    pairs = zip(recording.intervals, recording.measurements, strict=True)
    for k, (interval, displacement) in enumerate(pairs):
        applied = estimator.step(interval, displacement, queue.due(interval.stop))
        filtered.measurements.append(applied)
        filtered.estimates.append(estimator.estimate())
        if k % 500 == 0:
            progress(0.6 + 0.3 * k / len(recording.intervals))
    queue.refuse("after the end", len(queue.due(math.inf)))
    return filtered
