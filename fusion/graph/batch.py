"""Batch smoothing: optimise all keyframes of a track together and fill in the states between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from stario.fusion.filter.frame_transform import FrameTransform, Jump, MapFrameState, frame_rotation
from stario.fusion.filter.jacobians import POSITION
from stario.fusion.filter.record import Record
from stario.fusion.graph.builder import GraphBuilder
from stario.fusion.graph.factors import GyroBias, SamePlace
from stario.fusion.imu.barometer import CLIMB_DELAY, SILENT_SECONDS, UNKNOWN_RATE
from stario.fusion.imu.preintegration import Segment
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.lie import UNKNOWN_YAW
from stario.fusion.values.state import NavState
from stario.sequences.attitude.so3 import exp_so3, log_so3
from stario.sequences.sequence import BoolArray, FloatArray
from stario.sequences.windows import WINDOW_SECONDS

_UNKNOWN_POSITION = 1e4
"""Standard deviation of a position determined by fixes alone [m]."""

_RATE_SECONDS, _LEAST_HEIGHTS = 1.5, 3
"""Time before and after the middle of a window [s], and number of heights, for their slope."""

_LEAST_CLIMB = 0.8
"""Height [m] below which a climb may be none: its height yields to the pressure's, its length does
not."""

CLOSURE_SIGMA = 1.0
"""Standard deviation [m] per axis of a walk's end, relative to the start at which it ends."""

_TRUSTED_ROUNDS = 2
"""Rounds before outliers are down-weighted. Headings off by 86 degrees beside accurate positions,
which the filter follows, then turn the track by at most 6 degrees; with weights from the first
round on they turned it for good (three simulated walks)."""


def smooth(
    filtered: Sequence[NavState],
    prior: NavState,
    records: Sequence[Record],
    frame: MapFrameState,
    config: NavigatorConfig,
    gyro_bias: tuple[FloatArray, FloatArray] | None = None,
) -> list[NavState]:
    """Optimise a filtered track as a whole.

    Args:
        filtered: the filter's states in one frame: the start and one for each interval.
        prior: first state before any frame transform.
        records: the filter's, interval by interval.
        frame: the filter's map frame at the end.
        config: noise, filter and graph settings.
        gyro_bias: (3,) [rad/s] and covariance (3, 3) at the end, as estimated by the filter with
            the magnetic field, which the graph does not use; None without a field.

    Returns:
        The graph's states, one for each filtered one, with their marginal covariances.

    Raises:
        IndeterminateError: the graph does not determine a state.
    """
    origin = filtered[0].p_W  # near the track; see `EkfState`
    local = [state.shifted(-origin) for state in filtered]
    first = _inflated(local[0], prior, frame.transforms)
    builder = GraphBuilder(config, first)
    records = _without_rides(_with_climbs(records), frame.jumps)
    rejected_later = {time for record in records for time in record.rejected_later}
    for record, state in zip(records, local[1:], strict=True):
        # Neither is inflated as by the filter: the graph weights outliers by the whole track.
        # By the end the direction may be known that the filter had to wait for.
        fixes = [*(accepted.fix for accepted in record.fixes), *record.without_yaw]
        placed = [fix.shifted(-origin) for fix in fixes if frame.holds(fix)]
        valid = record.displacement is not None and record.interval.stop not in rejected_later
        builder.step(record, record.offered if valid else None, placed, state)
    builder.close(local[-1])
    graph = builder.graph
    if gyro_bias is not None:
        b_g, covariance = gyro_bias
        graph.add(GyroBias((graph.last,), covariance, b_g), gated=False)
    if config.place.closed:
        covariance = CLOSURE_SIGMA**2 * np.eye(3)
        graph.add(SamePlace((0, graph.last), covariance), gated=False)
    solved = graph.solve(trusted_rounds=_TRUSTED_ROUNDS)
    states = {state.time: state for state in _all_states(solved, builder.segments)}
    return [
        replace(states[f.time], in_gap=f.in_gap, map_frame=f.map_frame).shifted(origin)
        for f in filtered
    ]


def _with_climbs(records: Sequence[Record]) -> list[Record]:
    """Return the records with measurements that yield to the pressure's vertical speed.

    A climb is known from where it began, which the pressure shows later, and by its height; its
    speed is that about the middle of each window. In a silence nobody knows, nor before
    a late sensor's first pressure.
    """
    samples = [r.interval.height for r in records if r.interval.height is not None]
    if not samples:
        return list(records)
    time, height = np.array([(s.time, s.height) for s in samples]).T
    stop = np.array([r.interval.stop for r in records])
    climbs = np.array([r.climb_rate not in (None, 0.0, UNKNOWN_RATE) for r in records])
    for sample in samples:
        if sample.risen:
            climbs |= (stop > sample.time - CLIMB_DELAY) & (stop <= sample.time)
    ends = np.flatnonzero(np.diff(climbs, prepend=False, append=False))
    stairs = climbs.copy()
    for first, last in zip(ends[::2], ends[1::2] - 1, strict=True):
        before, after = np.interp(stop[[first, last]], time, height)
        stairs[first : last + 1] = abs(after - before) > _LEAST_CLIMB
    middle = stop - 0.5 * WINDOW_SECONDS
    found = []
    silent = _silent(np.concatenate([stop[:1], time, stop[-1:]]), stop)
    for record, climbing, known, at, unheard in zip(
        records, climbs, stairs, middle, silent, strict=True
    ):
        rate = UNKNOWN_RATE if unheard else record.climb_rate
        if rate is not None and climbing:
            rate = _rate(time, height, at) if known else UNKNOWN_RATE
        found.append(record.at_rate(rate))
    return found


def _without_rides(records: Sequence[Record], jumps: Sequence[Jump]) -> list[Record]:
    """Return the records without what was relative to something that moved (`Jump`)."""

    def carried(stop: float) -> bool:
        """Return whether the second that ends then overlaps such a time."""
        return any(j.carried and j.since < stop < j.until + WINDOW_SECONDS for j in jumps)

    return [
        record._replace(offered=None, zero_velocity=None)
        if carried(record.interval.stop)
        else record
        for record in records
    ]


def _silent(time: FloatArray, stop: FloatArray) -> BoolArray:
    """Return which windows that stop then (N,) overlap with a silence between times (M,) [s]."""
    found = np.zeros(len(stop), dtype=np.bool_)
    for k in np.flatnonzero(np.diff(time) > SILENT_SECONDS):
        found |= (stop > time[k]) & (stop < time[k + 1] + WINDOW_SECONDS)
    return found


def _rate(time: FloatArray, height: FloatArray, at: float) -> float:
    """Return the slope of heights (N,) about a time [m/s]; unknown where there are too few."""
    rows = slice(*np.searchsorted(time, (at - _RATE_SECONDS, at + _RATE_SECONDS)))
    t, h = time[rows] - at, height[rows]
    if len(t) < _LEAST_HEIGHTS:
        return UNKNOWN_RATE
    t = t - t.mean()
    return float(t @ h / (t @ t))


def _inflated(first: NavState, prior: NavState, transforms: Sequence[FrameTransform]) -> NavState:
    """Return the prior in the last frame, without the position and yaw determined by fixes.

    These fixes are measurements of the graph as well.
    """
    transforms = [transform for transform in transforms if transform.since <= first.time]
    if not transforms:
        return replace(first, covariance=prior.covariance)
    to_last = frame_rotation(first.R_WB @ prior.R_WB.T)
    covariance = to_last @ prior.covariance @ to_last.T
    for transform in transforms:
        if transform.is_shift:
            placed = np.diag(transform.position_covariance) > 0.0  # by a height, too, or without
            covariance[POSITION, POSITION] += np.diag(_UNKNOWN_POSITION**2 * placed)
    if not all(transform.is_shift for transform in transforms):
        covariance[2, 2] += UNKNOWN_YAW**2
    return replace(first, covariance=covariance)


def _all_states(
    solved: dict[int, NavState], segments: dict[int, tuple[Segment, ...]]
) -> list[NavState]:
    """Return solved keyframes and the states where the segments between them end."""
    first, *others = solved.values()
    states = [first]
    for pieces, end in zip(segments.values(), others, strict=False):
        if len(pieces) > 1:
            states += _interpolated_states(states[-1], end, pieces)
        states.append(end)
    return states


def _interpolated_states(
    start: NavState, end: NavState, segments: Sequence[Segment]
) -> list[NavState]:
    """Return the states between two keyframes: dead-reckoned, then corrected to meet the second.

    The error at the end is attributed to white noise throughout. The attitude correction grows with
    time, the position correction along the cubic that starts at zero and ends with both (Hermite).
    """
    R, v, p = start.R_WB, start.v_W, start.p_W
    rows = []
    for segment in segments:
        R, v, p = segment.predict(R, v, p, start.b_g, start.b_a)
        rows.append((segment.stop, R, v, p))
    duration = end.time - start.time
    turn, dv, dp = log_so3(end.R_WB @ R.T), end.v_W - v, end.p_W - p
    states = []
    for time, R, v, p in rows[:-1]:
        s = (time - start.time) / duration
        dp_s = s * s * (3.0 - 2.0 * s) * dp + duration * s * s * (s - 1.0) * dv
        dv_s = 6.0 * s * (1.0 - s) / duration * dp + s * (3.0 * s - 2.0) * dv
        states.append(
            NavState(
                time,
                exp_so3(s * turn) @ R,
                v + dv_s,
                p + dp_s,
                _interpolate(start.b_g, end.b_g, s),
                _interpolate(start.b_a, end.b_a, s),
                _interpolate(start.covariance, end.covariance, s),
            )
        )
    return states


def _interpolate(a: FloatArray, b: FloatArray, s: float) -> FloatArray:
    return np.asarray((1.0 - s) * a + s * b)
