"""The track of a recording: filtered, and then smoothed as a whole by the graph.

The graph starts from the filter's states.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from time import perf_counter
from typing import Literal, NamedTuple

import numpy as np

from stario.fusion.filter import estimator
from stario.fusion.filter.ekf_state import LOST_YAW
from stario.fusion.filter.estimates import Estimate, nav_states, with_unknown_way
from stario.fusion.filter.estimator_state import EstimatorState
from stario.fusion.filter.frame_transform import frame_rotation, to_final_frame, with_unknown_yaws
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.jacobians import GAIN, GYRO_BIAS
from stario.fusion.filter.map_frame import YAW_UNKNOWN
from stario.fusion.filter.record import Record, innovations_of
from stario.fusion.graph.batch import CLOSURE_SIGMA, smooth
from stario.fusion.graph.covariances import with_reported_covariances
from stario.fusion.graph.term import IndeterminateError
from stario.fusion.place import known_fixes
from stario.fusion.recording import PreprocessedRecording, Progress
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import Fix, FixQueue, fix_list
from stario.fusion.values.floors import FloorChange, floor_changes
from stario.fusion.values.health import Health
from stario.fusion.values.state import NavState, Track, track_from_states
from stario.sequences.arrays import check_type
from stario.sequences.errors import InputError

BackendName = Literal["ekf", "graph"]
"""The EKF, or the factor graph: over the last seconds of a stream, over all of a recording."""

_CONTRADICTED = 3.0
"""Distance of the end of a closed walk from its start, in sigmas, beyond which to doubt it."""


class _Filtered(NamedTuple):
    """A recording after the filter: states from the start on, and what it did in each interval."""

    estimates: list[Estimate]
    records: list[Record]
    last: EstimatorState

    def states(self) -> list[NavState]:
        """Return the filter's states in the final map frame."""
        frame = self.last.map_frame
        states = to_final_frame(nav_states(self.estimates), frame.transforms)
        return with_unknown_yaws(states, frame.unknown_yaws)


def _smoothed_states(
    filtered: _Filtered, config: NavigatorConfig
) -> tuple[list[NavState], list[str]]:
    """Optimise the whole track at once; the filter's states if the graph is indeterminate.

    Returns:
        States in the final map frame, and notes for the health report if the graph failed.
    """
    last, states = filtered.last, nav_states(filtered.estimates, GAIN)
    frame, end, covariance = last.map_frame, states[-1], states[0].covariance.copy()
    # Without bearings the filter knows of the bias what the graph knows itself.
    told = last.counts.bearings.get("applied", 0) > 0
    bias = (end.b_g, end.covariance[GYRO_BIAS, GYRO_BIAS]) if told else None
    # The filter's last prior.
    covariance[GYRO_BIAS, GYRO_BIAS] = last.bias_prior.variance * np.eye(3)
    first = replace(states[0], covariance=covariance)
    final = to_final_frame(states, frame.transforms)
    try:
        solved = smooth(final, first, filtered.records, frame, config, bias)
        _check_heading(solved[-1], states[-1])
    except IndeterminateError as error:
        return filtered.states(), [f"graph fell back to the filter's track: {error}"]
    turns = [
        frame_rotation(after.R_WB @ before.R_WB.T)
        for before, after in zip(states, final, strict=True)
    ]
    solved = with_reported_covariances(solved, filtered.estimates, np.array(turns))
    solved = [with_unknown_way(s, last.way_variance(s.time)) for s in solved]
    return with_unknown_yaws(solved, frame.unknown_yaws), []


def _check_heading(solved: NavState, filtered: NavState) -> None:
    """Check that the graph's heading is known if the filter's is, with the magnetic field.

    Raises:
        IndeterminateError: it is lost.
    """
    if solved.covariance[2, 2] > LOST_YAW**2 > filtered.covariance[2, 2]:
        sigma = math.degrees(math.sqrt(filtered.covariance[2, 2]))
        raise IndeterminateError(f"it lost the heading, which the filter knows to {sigma:.0f} deg")


def _doubts_of_closure(filtered: Sequence[NavState]) -> list[str]:
    """Tell if a walk taken for closed ended further from its start than its sigma allows."""
    first, last = filtered[0], filtered[-1]
    apart, variance = (last.p_W - first.p_W)[:2], np.trace(last.position_covariance[:2, :2])
    distance, sigma = float(np.linalg.norm(apart)), math.sqrt(variance + 2.0 * CLOSURE_SIGMA**2)
    if distance < _CONTRADICTED * sigma:
        return []
    return [
        f"by its steps the walk ended {distance:.1f} m from its start (sigma {sigma:.1f} m); leave "
        "out `closed` if it did not end there"
    ]


def _floors(states: Sequence[NavState]) -> list[FloorChange]:
    time, height, speed = np.array(
        [(s.time, s.p_W[2], math.hypot(s.v_W[0], s.v_W[1])) for s in states]
    ).T
    return floor_changes(time, height, speed)[0]


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
    if backend == "ekf" and config.place.closed:
        remedy = "leave out the back end"
        raise InputError("closed", "the EKF", "the graph, which knows the end", remedy)
    began = perf_counter()
    fixes, origin = known_fixes(recording, config.place, fix_list(fixes))
    queue = FixQueue(fixes, most=math.inf)  # all fixes of a recording are known from the start
    run = _filtered(recording, config, prior, queue, progress)
    innovations = innovations_of(run.records)

    def track(states: list[NavState], filter_track: Track | None = None) -> Track:
        health = queue.health(run.last.health(recording.counts, config.filter, states[-1]))
        if health.pressures:
            health.floors = _floors(states)
        return replace(
            track_from_states(states),
            innovations=innovations,
            health=health,
            filtered=filter_track,
            georeference=origin,
            seconds_network=recording.seconds_network,
            seconds_filter=recording.seconds_front_end + perf_counter() - began,
        )

    filtered = run.states()
    found = track(filtered)
    if backend == "graph":
        states, notes = _smoothed_states(run, config)
        found = track(states, found)
        assert found.health is not None
        found.health.notes += notes
        if not notes:
            _count_later_fixes(found.health, run)
        if config.place.closed:
            found.health.notes += _doubts_of_closure(filtered)
    progress(1.0)
    return found


def _count_later_fixes(health: Health, run: _Filtered) -> None:
    """Count positions as applied that the graph has used although the filter could not yet."""
    frame, fixes = run.last.map_frame, health.fixes
    if used := sum(frame.holds(fix) for record in run.records for fix in record.without_yaw):
        fixes["applied"] = fixes.get("applied", 0) + used
        fixes[YAW_UNKNOWN] -= used
        health.fixes = {name: n for name, n in fixes.items() if n}


def _filtered(
    recording: PreprocessedRecording,
    config: NavigatorConfig,
    prior: PriorPose | None,
    queue: FixQueue,
    progress: Progress,
) -> _Filtered:
    queue.start(recording.start.time)
    state = estimator.begin(config, recording.start, prior)
    estimates, records = [state.estimate()], []
    pairs = zip(recording.intervals, recording.measurements, strict=True)
    for k, (interval, displacement) in enumerate(pairs):
        due = queue.due(interval.stop)
        state, record = estimator.step(state, interval, displacement, due, config)
        records.append(record)
        estimates.append(record.estimate)
        if k % 500 == 0:
            progress(0.6 + 0.3 * k / len(recording.intervals))
    queue.refuse("after the end", len(queue.due(math.inf)))
    return _Filtered(estimates, records, state)
