"""The fixed-lag graph for streams: optimise the last seconds again at every keyframe.

Keyframes that leave the lag are marginalised. The filter runs alongside: it gates the measurements
for both (`GraphBuilder`) and provides the information of the magnetic field (`bearing`).
The graph restarts from the filter's state where it does not determine its own, or where a late fix
has changed the filter's gating.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.estimates import nav_states
from stario.fusion.filter.estimator import Estimator
from stario.fusion.filter.estimator_state import EstimatorState
from stario.fusion.filter.frame_transform import with_undirected
from stario.fusion.filter.initial import PriorPose
from stario.fusion.filter.jacobians import ASSUMED
from stario.fusion.filter.network_errors import turn_estimate
from stario.fusion.fixes import Accepted, Fix
from stario.fusion.graph.bearing import Bearing, gained_information
from stario.fusion.graph.builder import GraphBuilder
from stario.fusion.graph.covariances import with_actual_covariances
from stario.fusion.graph.factors import GyroBias
from stario.fusion.graph.whitening import IndeterminateError
from stario.fusion.health import Health, SampleCounts
from stario.fusion.imu.intervals import ImuInterval, Start
from stario.fusion.imu.stateful import WindowDisplacement
from stario.fusion.state import NavState
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
    """Complete state of a `FixedLagEstimator` between two intervals.

    Attributes:
        estimator: state of the filter alongside.
        builder: the graph.
        ahead: newest state, propagated by the IMU from the last keyframe.
        start: what the graph began from.
        fallbacks: how often the graph fell back to the filter, and the latest reason.
    """

    estimator: EstimatorState
    builder: GraphBuilder
    ahead: EkfState
    start: GraphStart
    fallbacks: tuple[int, str]


def copied(builder: GraphBuilder) -> GraphBuilder:
    """Return a copy of a graph, which `step` changes in place, solved like the original."""
    copy = deepcopy(builder)
    if builder.graph.is_solved:
        copy.graph.solve(1)
    return copy


class FixedLagEstimator:
    """An `Estimator` whose states are those of a fixed-lag graph.

    Between keyframes the state is that of the last one, propagated by the IMU.

    Args:
        config: noise, filter and graph settings.
        start: time and levelled attitude of the first sample.
        prior: prior on the first pose; None starts levelled, at rest, at the origin.
    """

    smoothed = None  # the filter alone has poses one window late

    def __init__(
        self, config: NavigatorConfig, start: Start, prior: PriorPose | None = None
    ) -> None:
        self._config = config
        self._filter = Estimator(config, start, prior, streaming=True)
        self._fallbacks = (0, "")
        self._ahead = StateCloningEkf(slots=0, gravity=config.gravity)
        self._begin(0)

    def step(
        self,
        interval: ImuInterval,
        displacement: WindowDisplacement | None,
        fixes: Sequence[Fix] = (),
    ) -> None:
        """Propagate to the interval's end and apply its measurements; as `Estimator.step`."""
        applied = self._filter.step(interval, displacement, fixes)
        self._narrow_bias_prior()
        if self._stale or interval.gap or applied.revoked:
            self._begin(0 if interval.gap else self._builder.count + 1)
            return
        local_fixes = [self._in_graph_frame(accepted) for accepted in applied.fixes]
        new_keyframe = self._builder.step(
            applied.interval, applied.displacement, local_fixes, applied.zero_velocity
        )
        if applied.bearing is not None:
            self._add_bearing(*applied.bearing)
        if new_keyframe:
            self._solve()
        else:
            self._ahead.propagate(self._builder.segments[self._builder.graph.last][-1])

    def late_fix(self, fix: Fix) -> list[Accepted] | None:
        """Apply a fix at a time before now; as `Estimator.late_fix`."""
        gating_counts = self._filter.gating_counts
        accepted = self._filter.late_fix(fix)
        if accepted is None:
            return None
        if self._stale or self._filter.gating_counts != gating_counts:
            self._begin(self._builder.count)
            return accepted
        for applied in accepted:
            if applied.fix is fix:
                if self._builder.fix(self._in_graph_frame(applied)):
                    self._solve()
                else:  # from before the graph began: only the filter's state contains it
                    self._begin(self._builder.count)
        return accepted

    @property
    def state(self) -> FixedLagState:
        """Complete state, which can be assigned back; the graph in it is a copy."""
        return FixedLagState(
            self._filter.state,
            copied(self._builder),
            self._ahead.state,
            self._start,
            self._fallbacks,
        )

    @state.setter
    def state(self, s: FixedLagState) -> None:
        self._filter.state, self._ahead.state = s.estimator, s.ahead
        self._builder = copied(s.builder)  # `s` may be assigned again
        self._start, self._fallbacks = s.start, s.fallbacks

    @property
    def time(self) -> float:
        """Time of the newest state [s]."""
        return self._ahead.state.time

    def nav_state(self) -> NavState:
        """Return the newest state."""
        ahead = self._ahead.state.estimate(self._filter.in_gap, self._start.map_frame)
        state = nav_states([ahead])[0].shifted(self._start.origin_W)
        states = with_actual_covariances([state], [self._filter.estimate()])
        return with_undirected(states, self._filter.frame.state.undirected)[0]

    def health(self, counts: SampleCounts) -> Health:
        """Return the filter's report with the graph's sigmas and the number of fallbacks."""
        health = self._filter.health(counts, self.nav_state())
        count, reason = self._fallbacks
        if count == 0:
            return health
        note = f"graph fell back to the filter {count} times, last because {reason}"
        return replace(health, notes=[*health.notes, note])

    @property
    def _stale(self) -> bool:
        """Whether the filter has since changed the state from which the graph began."""
        start, frame = self._start, self._filter.frame.state
        wider = self._filter.bias.prior.variance > _WIDER * start.bias_variance
        turned = self._filter.ekf.state.has_turn and not self._builder.estimates_turn
        moved = (len(frame.transforms), frame.jumps) != (start.map_frame, start.jumps)
        return wider or turned or moved

    def _narrow_bias_prior(self) -> None:
        """Narrow the prior as the filter did: add its information as a measurement of zero."""
        old, variance = self._start.bias_variance, self._filter.bias.prior.variance
        if variance < _NARROWER * old:
            pseudo_variance = 1.0 / (1.0 / variance - 1.0 / old)
            graph = self._builder.graph
            graph.add(GyroBias(graph.last, np.zeros(3), pseudo_variance * np.eye(3)), gated=False)
            self._start = self._start._replace(bias_variance=variance)

    def _add_bearing(self, before: EkfState, after: EkfState) -> None:
        """Add what a magnetic bearing has just told the filter about attitude and bias."""
        gained = gained_information(before, after)
        if gained is None:
            return
        graph = self._builder.graph
        k = graph.last
        R, _, _ = self._builder.dead_reckoned(k)
        R_k = after.R_WB @ R.T @ graph.keyframe(k).R_WB
        weights, value, variance = gained
        term = Bearing(k, R_k, after.b_g, weights, value, np.array([[variance]]))
        graph.add(term, gated=False)

    def _in_graph_frame(self, accepted: Accepted) -> Fix:
        """Return a fix as inflated by the filter, relative to the graph's origin."""
        return accepted.inflated.shifted(-self._start.origin_W)

    def _begin(self, count: int) -> None:
        """Begin a new graph from the filter's state."""
        first = nav_states([self._filter.estimate()], ASSUMED)[0]
        jumps, variance = self._filter.frame.state.jumps, self._filter.bias.prior.variance
        self._start = GraphStart(first.p_W, first.map_frame, jumps, variance)
        first = first.shifted(-first.p_W)
        turn = turn_estimate(self._filter.ekf.state)
        self._builder = GraphBuilder(
            self._config, first, count, turn is not None, turn, streaming=True
        )
        self._ahead.initialise(first)

    def _solve(self) -> None:
        builder = self._builder
        graph = builder.graph
        try:
            graph.solve(_MAX_ROUNDS)
            newest = graph.state(graph.last)
            builder.marginalise_until(newest.time - self._config.graph.lag)
        except IndeterminateError as error:
            self._fallbacks = (self._fallbacks[0] + 1, str(error))
            self._begin(builder.count)
            return
        self._ahead.initialise(newest)
        for segment in builder.segments[graph.last]:
            self._ahead.propagate(segment)
