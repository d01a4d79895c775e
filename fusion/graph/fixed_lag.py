"""The fixed-lag graph for streams: optimise the last seconds again at every keyframe.

Keyframes that leave the lag are marginalised. The filter runs before it: it gates the measurements
for both (`GraphBuilder`) and provides the information of the magnetic field (`factors.Bearing`).
The graph restarts from the filter's state where it does not determine its own, or where a late fix
has changed the filter's gating. Between keyframes the state is that of the last one, propagated by
the IMU.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stario.fusion.filter.ekf import initialised, propagate
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.estimates import nav_states
from stario.fusion.filter.estimator_state import EstimatorState
from stario.fusion.filter.frame_transform import with_undirected
from stario.fusion.filter.gained import Gained
from stario.fusion.filter.jacobians import ASSUMED
from stario.fusion.filter.record import Record
from stario.fusion.graph.builder import GraphBuilder
from stario.fusion.graph.covariances import with_actual_covariances
from stario.fusion.graph.factors import Bearing, GyroBias
from stario.fusion.graph.term import IndeterminateError
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import Accepted, Fix
from stario.fusion.values.state import NavState, changed
from stario.sequences.sequence import FloatArray

_WIDER, _NARROWER = 1.2, 0.99
"""Ratios of variances beyond which the gyroscope bias's prior has changed: a wider one restarts the
graph, a narrower one is added as a measurement of the difference."""

_MAX_ROUNDS = 3
"""Maximum rounds of each optimisation; the next keyframe's continues from there."""


@dataclass(frozen=True, eq=False)
class FixedLagState:
    """The graph between two intervals, and what the filter's state was when it began.

    Attributes:
        builder: the graph.
        ahead: newest state, propagated by the IMU from the last keyframe.
        origin_W: (3,) the filter's position, which is the origin of the graph's [m]; see
            `EkfState`.
        map_frame: number of frame transforms.
        jumps: number of jumps of its track.
        bias_variance: variance of the gyroscope bias's prior, narrowed since as in the filter
            [rad^2/s^2].
        fallbacks: how often the graph fell back to the filter.
        reason: why it did so the last time.
    """

    builder: GraphBuilder
    ahead: EkfState
    origin_W: FloatArray
    map_frame: int
    jumps: int
    bias_variance: float
    fallbacks: int = 0
    reason: str = ""

    def nav_state(self, filtered: EstimatorState) -> NavState:
        """Return the newest state, given the filter's."""
        ahead = self.ahead.estimate(filtered.in_gap, self.map_frame)
        state = nav_states([ahead])[0].shifted(self.origin_W)
        states = with_actual_covariances([state], [filtered.estimate()])
        return with_undirected(states, filtered.map_frame.undirected)[0]

    @property
    def notes(self) -> list[str]:
        """Remarks for the health report."""
        if self.fallbacks == 0:
            return []
        times = f"graph fell back to the filter {self.fallbacks} times"
        return [f"{times}, last because {self.reason}"]

    def is_stale(self, filtered: EstimatorState) -> bool:
        """Return whether the filter has since changed the state from which the graph began."""
        frame = filtered.map_frame
        moved = (len(frame.transforms), frame.jumps) != (self.map_frame, self.jumps)
        return moved or filtered.bias_prior.variance > _WIDER * self.bias_variance


def begin(filtered: EstimatorState, config: NavigatorConfig, count: int = 0) -> FixedLagState:
    """Begin a graph from the filter's state, `count` intervals since the start or a gap."""
    first = nav_states([filtered.estimate()], ASSUMED)[0]
    local = first.shifted(-first.p_W)
    return FixedLagState(
        builder=GraphBuilder(config, local, count, streaming=True),
        ahead=initialised(local, 0),
        origin_W=first.p_W,
        map_frame=first.map_frame,
        jumps=filtered.map_frame.jumps,
        bias_variance=filtered.bias_prior.variance,
    )


def step(
    s: FixedLagState, filtered: EstimatorState, record: Record, config: NavigatorConfig
) -> FixedLagState:
    """Follow the filter through an interval.

    Args:
        s: the graph at its start.
        filtered: the filter's state at its end.
        record: what the filter did in it.
        config: noise, filter and graph settings.
    """
    builder = s.builder.copied()
    s = _with_prior_narrowed(changed(s, builder=builder), filtered.bias_prior.variance)
    if s.is_stale(filtered) or record.interval.gap or record.revoked:
        count = 0 if record.interval.gap else builder.count + 1
        return _restarted(s, filtered, count, config)
    yielded = record.at_rate(record.climb_rate)
    local_fixes = [_in_graph_frame(accepted, s) for accepted in record.fixes]
    new_keyframe = builder.step(yielded, yielded.displacement, local_fixes)
    if record.bearing is not None:
        _add_bearing(builder, record.bearing)
    if new_keyframe:
        return _solved(s, filtered, config)
    segment = builder.segments[builder.graph.last][-1]
    return changed(s, ahead=propagate(s.ahead, segment))


def late_fix(
    s: FixedLagState,
    before: EstimatorState,
    filtered: EstimatorState,
    fix: Fix,
    accepted: list[Accepted],
    config: NavigatorConfig,
) -> FixedLagState:
    """Follow the filter through a fix at a time before now.

    Args:
        s: the graph.
        before: the filter's state before the fix was known.
        filtered: its state with the fix.
        fix: the fix.
        accepted: the fixes applied by the filter since the time of this one.
        config: noise, filter and graph settings.
    """
    s = changed(s, builder=s.builder.copied())
    if s.is_stale(filtered) or filtered.counts.gating != before.counts.gating:
        return _restarted(s, filtered, s.builder.count, config)
    applied = next((each for each in accepted if each.fix is fix), None)
    if applied is None:
        return s
    if s.builder.fix(_in_graph_frame(applied, s)):
        return _solved(s, filtered, config)
    # From before the graph began: only the filter's state contains it.
    return _restarted(s, filtered, s.builder.count, config)


def _with_prior_narrowed(s: FixedLagState, variance: float) -> FixedLagState:
    """Narrow the bias's prior as the filter did: add its information as a measurement of zero."""
    if variance >= _NARROWER * s.bias_variance:
        return s
    pseudo_variance = 1.0 / (1.0 / variance - 1.0 / s.bias_variance)
    graph = s.builder.graph
    graph.add(GyroBias((graph.last,), pseudo_variance * np.eye(3), np.zeros(3)), gated=False)
    return changed(s, bias_variance=variance)


def _add_bearing(builder: GraphBuilder, gained: Gained) -> None:
    """Add what a magnetic bearing has just told the filter about attitude and bias."""
    k = builder.graph.last
    R, _, _ = builder.dead_reckoned(k)
    R_k = gained.R_WB @ R.T @ builder.graph.states[k].R_WB
    covariance = np.array([[gained.variance]])
    term = Bearing((k,), covariance, R_k, gained.b_g, gained.weights, gained.value)
    builder.graph.add(term, gated=False)


def _in_graph_frame(accepted: Accepted, s: FixedLagState) -> Fix:
    """Return a fix as inflated by the filter, relative to the graph's origin."""
    return accepted.inflated.shifted(-s.origin_W)


def _restarted(
    s: FixedLagState, filtered: EstimatorState, count: int, config: NavigatorConfig
) -> FixedLagState:
    """Begin a new graph from the filter's state."""
    return changed(begin(filtered, config, count), fallbacks=s.fallbacks, reason=s.reason)


def _solved(s: FixedLagState, filtered: EstimatorState, config: NavigatorConfig) -> FixedLagState:
    builder, last = s.builder, s.builder.graph.last
    try:
        newest = builder.graph.solve(_MAX_ROUNDS)[last]
        builder.marginalise_until(newest.time - config.graph.lag)
    except IndeterminateError as error:
        failed = changed(s, fallbacks=s.fallbacks + 1, reason=str(error))
        return _restarted(failed, filtered, builder.count, config)
    ahead = initialised(newest, 0)
    for segment in builder.segments[last]:
        ahead = propagate(ahead, segment)
    return changed(s, ahead=ahead)
