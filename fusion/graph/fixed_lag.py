"""The fixed-lag graph for streams: optimise the last seconds again at every keyframe.

Keyframes that leave the lag are marginalised. The filter runs alongside: it gates the measurements
for both (`GraphBuilder`) and provides the information of the magnetic field (`bearing`).
The graph restarts from the filter's state where it does not determine its own, or where a late fix
has changed the filter's gating. Between keyframes the state is that of the last one, propagated by
the IMU.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stario.fusion.filter import estimator
from stario.fusion.filter.ekf import initialised, propagate
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.estimates import nav_states
from stario.fusion.filter.estimator_state import EstimatorState
from stario.fusion.filter.frame_transform import with_undirected
from stario.fusion.filter.gained import Gained
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.jacobians import ASSUMED
from stario.fusion.filter.record import Record
from stario.fusion.graph.bearing import Bearing
from stario.fusion.graph.builder import GraphBuilder
from stario.fusion.graph.covariances import with_actual_covariances
from stario.fusion.graph.factors import GyroBias
from stario.fusion.graph.whitening import IndeterminateError
from stario.fusion.imu.intervals import ImuInterval, Start
from stario.fusion.imu.stateful import WindowDisplacement
from stario.fusion.values.config import FilterConfig, NavigatorConfig
from stario.fusion.values.fixes import Accepted, Fix
from stario.fusion.values.health import Health, SampleCounts
from stario.fusion.values.state import NavState, changed
from stario.sequences.sequence import FloatArray

_WIDER, _NARROWER = 1.2, 0.99
"""Ratios of variances beyond which the gyroscope bias's prior has changed: a wider one restarts the
graph, a narrower one is added as a measurement of the difference."""

_MAX_ROUNDS = 3
"""Maximum rounds of each optimisation; the next keyframe's continues from there."""


class GraphStart(NamedTuple):
    """What the filter's state was when the graph began.

    Attributes:
        origin_W: (3,) its position, which is the origin of the graph's [m]; see `EkfState`.
        map_frame: number of frame transforms.
        jumps: number of jumps of its track.
        bias_variance: variance of the gyroscope bias's prior, narrowed since as in the filter
            [rad^2/s^2].
    """

    origin_W: FloatArray
    map_frame: int
    jumps: int
    bias_variance: float


@dataclass(frozen=True, eq=False)
class FixedLagState:
    """Complete state between two intervals.

    Attributes:
        filter: state of the filter alongside.
        builder: the graph.
        ahead: newest state, propagated by the IMU from the last keyframe.
        start: what the graph began from.
        fallbacks: how often the graph fell back to the filter.
        reason: why it did so the last time.
    """

    filter: EstimatorState
    builder: GraphBuilder
    ahead: EkfState
    start: GraphStart
    fallbacks: int = 0
    reason: str = ""

    smoothed = None  # the filter alone has poses one window late

    @property
    def time(self) -> float:
        """Time of the newest state [s]."""
        return self.ahead.time

    def nav_state(self) -> NavState:
        """Return the newest state."""
        ahead = self.ahead.estimate(self.filter.in_gap, self.start.map_frame)
        state = nav_states([ahead])[0].shifted(self.start.origin_W)
        states = with_actual_covariances([state], [self.filter.estimate()])
        return with_undirected(states, self.filter.map_frame.undirected)[0]

    def health(self, counts: SampleCounts, f: FilterConfig) -> Health:
        """Return the filter's report with the graph's sigmas and the number of fallbacks."""
        health = self.filter.health(counts, f, self.nav_state())
        if self.fallbacks == 0:
            return health
        note = f"graph fell back to the filter {self.fallbacks} times, last because {self.reason}"
        return replace(health, notes=[*health.notes, note])

    @property
    def is_stale(self) -> bool:
        """Whether the filter has since changed the state from which the graph began."""
        start, frame = self.start, self.filter.map_frame
        wider = self.filter.bias_prior.variance > _WIDER * start.bias_variance
        moved = (len(frame.transforms), frame.jumps) != (start.map_frame, start.jumps)
        return wider or moved


def begin(config: NavigatorConfig, start: Start, prior: PriorPose | None = None) -> FixedLagState:
    """Return the first state; arguments as for `estimator.begin`."""
    return _begun(estimator.begin(config, start, prior, streaming=True), 0, config)


def step(
    s: FixedLagState,
    interval: ImuInterval,
    displacement: WindowDisplacement | None,
    fixes: Sequence[Fix],
    config: NavigatorConfig,
) -> tuple[FixedLagState, Record]:
    """Propagate to the interval's end and apply its measurements; as `estimator.step`."""
    after, record = estimator.step(s.filter, interval, displacement, fixes, config)
    builder = s.builder.copied()
    s = _with_prior_narrowed(changed(s, filter=after, builder=builder))
    if s.is_stale or interval.gap or record.revoked:
        return _restarted(s, 0 if interval.gap else builder.count + 1, config), record
    yielded = record.at_rate(record.climb_rate)
    local_fixes = [_in_graph_frame(accepted, s) for accepted in record.fixes]
    new_keyframe = builder.step(yielded, yielded.displacement, local_fixes)
    if record.bearing is not None:
        _add_bearing(builder, record.bearing)
    if new_keyframe:
        return _solved(s, config), record
    segment = builder.segments[builder.graph.last][-1]
    return changed(s, ahead=propagate(s.ahead, segment)), record


def late_fix(
    s: FixedLagState, fix: Fix, config: NavigatorConfig
) -> tuple[FixedLagState, list[Accepted]] | None:
    """Apply a fix at a time before now; as `estimator.late_fix`."""
    found = estimator.late_fix(s.filter, fix, config)
    if found is None:
        return None
    gated_before = s.filter.counts.gating
    s = changed(s, filter=found[0], builder=s.builder.copied())
    if s.is_stale or s.filter.counts.gating != gated_before:
        return _restarted(s, s.builder.count, config), found[1]
    for applied in found[1]:
        if applied.fix is fix:
            if s.builder.fix(_in_graph_frame(applied, s)):
                s = _solved(s, config)
            else:  # from before the graph began: only the filter's state contains it
                s = _restarted(s, s.builder.count, config)
    return s, found[1]


def _with_prior_narrowed(s: FixedLagState) -> FixedLagState:
    """Narrow the bias's prior as the filter did: add its information as a measurement of zero."""
    old, variance = s.start.bias_variance, s.filter.bias_prior.variance
    if variance >= _NARROWER * old:
        return s
    pseudo_variance = 1.0 / (1.0 / variance - 1.0 / old)
    graph = s.builder.graph
    graph.add(GyroBias(graph.last, np.zeros(3), pseudo_variance * np.eye(3)), gated=False)
    return changed(s, start=s.start._replace(bias_variance=variance))


def _add_bearing(builder: GraphBuilder, gained: Gained) -> None:
    """Add what a magnetic bearing has just told the filter about attitude and bias."""
    k = builder.graph.last
    R, _, _ = builder.dead_reckoned(k)
    R_k = gained.R_WB @ R.T @ builder.graph.keyframe(k).R_WB
    covariance = np.array([[gained.variance]])
    term = Bearing(k, R_k, gained.b_g, gained.weights, gained.value, covariance)
    builder.graph.add(term, gated=False)


def _in_graph_frame(accepted: Accepted, s: FixedLagState) -> Fix:
    """Return a fix as inflated by the filter, relative to the graph's origin."""
    return accepted.inflated.shifted(-s.start.origin_W)


def _begun(s: EstimatorState, count: int, config: NavigatorConfig) -> FixedLagState:
    """Begin a graph from the filter's state."""
    first = nav_states([s.estimate()], ASSUMED)[0]
    start = GraphStart(first.p_W, first.map_frame, s.map_frame.jumps, s.bias_prior.variance)
    first = first.shifted(-first.p_W)
    builder = GraphBuilder(config, first, count, streaming=True)
    return FixedLagState(s, builder, initialised(first, 0), start)


def _restarted(s: FixedLagState, count: int, config: NavigatorConfig) -> FixedLagState:
    """Begin a new graph from the filter's state."""
    return changed(_begun(s.filter, count, config), fallbacks=s.fallbacks, reason=s.reason)


def _solved(s: FixedLagState, config: NavigatorConfig) -> FixedLagState:
    builder = s.builder
    graph = builder.graph
    try:
        graph.solve(_MAX_ROUNDS)
        newest = graph.state(graph.last)
        builder.marginalise_until(newest.time - config.graph.lag)
    except IndeterminateError as error:
        failed = changed(s, fallbacks=s.fallbacks + 1, reason=str(error))
        return _restarted(failed, builder.count, config)
    ahead = initialised(newest, 0)
    for segment in builder.segments[graph.last]:
        ahead = propagate(ahead, segment)
    return changed(s, ahead=ahead)
