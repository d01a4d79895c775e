"""The fixed-lag graph for streams: optimise the last seconds again at every keyframe.

Keyframes that leave the lag are marginalised. The filter runs before it: it gates the measurements
for both (`GraphBuilder`) and provides the information of the magnetic field (`factors.Bearing`).
The graph restarts from the filter's state where it does not determine its own, or where a late fix
has changed the filter's gating. Between keyframes the state is that of the last one, propagated by
the IMU.
"""

from __future__ import annotations

import numpy as np

from stario.fusion.filter.ekf import propagate
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.estimates import nav_states, with_unknown_way
from stario.fusion.filter.estimator_state import EstimatorState
from stario.fusion.filter.frame_transform import with_unknown_yaws
from stario.fusion.filter.gained import Gained
from stario.fusion.filter.jacobians import GAIN
from stario.fusion.filter.record import Record
from stario.fusion.graph.builder import GraphBuilder
from stario.fusion.graph.covariances import with_reported_covariances
from stario.fusion.graph.factors import Bearing, GyroBias
from stario.fusion.graph.term import IndeterminateError
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import Accepted, Fix
from stario.fusion.values.state import NavState

_WIDER, _NARROWER = 1.2, 0.99
"""Ratios of variances beyond which the gyroscope bias's prior has changed: a wider one restarts the
graph, a narrower one is added as a measurement of the difference."""

_MAX_ROUNDS = 3
"""Maximum rounds of each optimisation; the next keyframe's continues from there."""


class FixedLag:
    """The graph of a stream, which follows the filter's steps.

    Args:
        filtered: the filter's state from which it begins.
        config: noise, filter and graph settings.

    Attributes:
        builder: the graph.
    """

    def __init__(self, filtered: EstimatorState, config: NavigatorConfig) -> None:
        self._config = config
        self._fallbacks, self._reason = 0, ""
        self._begin(filtered, 0)

    def _begin(self, filtered: EstimatorState, count: int) -> None:
        """Begin from the filter's state, `count` intervals since the start or a gap."""
        first = nav_states([filtered.estimate()], GAIN)[0]
        local = first.shifted(-first.p_W)
        self._origin_W = first.p_W  # of the graph; see `EkfState`
        self.builder = GraphBuilder(self._config, local, count, streaming=True)
        # The newest state, propagated from the last keyframe.
        self._ahead = EkfState.initial(local, 0)
        self._frame = first.map_frame, len(filtered.map_frame.jumps)
        # Of the gyroscope bias's prior, narrowed since as in the filter [rad^2/s^2].
        self._bias_variance = filtered.bias_prior.variance

    @property
    def notes(self) -> list[str]:
        """Remarks for the health report."""
        if self._fallbacks == 0:
            return []
        times = f"graph fell back to the filter {self._fallbacks} times"
        return [f"{times}, last because {self._reason}"]

    def nav_state(self, filtered: EstimatorState) -> NavState:
        """Return the newest state, given the filter's."""
        ahead = self._ahead.estimate(filtered.in_gap, self._frame[0])
        state = nav_states([ahead])[0].shifted(self._origin_W)
        estimate = filtered.estimate()
        (state,) = with_reported_covariances([state], [estimate])
        state = with_unknown_way(state, estimate.way_variance)
        return with_unknown_yaws([state], filtered.map_frame.unknown_yaws)[0]

    def step(self, filtered: EstimatorState, record: Record) -> None:
        """Follow the filter through an interval.

        Args:
            filtered: the filter's state at its end.
            record: what the filter did in it.
        """
        builder = self.builder
        self._narrow_prior(filtered.bias_prior.variance)
        if self._is_stale(filtered) or record.interval.gap or record.rejected_later:
            self._begin(filtered, 0 if record.interval.gap else builder.count + 1)
            return
        yielded = record.at_rate(record.climb_rate)
        fixes = [self._in_graph_frame(accepted) for accepted in record.fixes]
        new_keyframe = builder.step(yielded, yielded.displacement, fixes)
        if record.bearing is not None:
            self._add_bearing(record.bearing)
        if new_keyframe:
            self._solve(filtered)
        else:
            self._ahead = propagate(self._ahead, builder.segments[builder.graph.last][-1])

    def late_fix(
        self, before: EstimatorState, filtered: EstimatorState, fix: Fix, accepted: list[Accepted]
    ) -> None:
        """Follow the filter through a fix at a time before now.

        Args:
            before: the filter's state before the fix was known.
            filtered: its state with the fix.
            fix: the fix.
            accepted: the fixes applied by the filter since the time of this one.
        """
        applied = next((each for each in accepted if each.fix is fix), None)
        regated = filtered.counts.gating != before.counts.gating
        if not regated and not self._is_stale(filtered):
            if applied is None:
                return
            if self.builder.fix(self._in_graph_frame(applied)):
                self._solve(filtered)
                return
        # If the fix is from before the graph began, only the filter's state contains it.
        self._begin(filtered, self.builder.count)

    def _is_stale(self, filtered: EstimatorState) -> bool:
        """Return whether the filter has since changed the state from which the graph began."""
        frame = filtered.map_frame
        moved = (len(frame.transforms), len(frame.jumps)) != self._frame
        return moved or filtered.bias_prior.variance > _WIDER * self._bias_variance

    def _narrow_prior(self, variance: float) -> None:
        """Narrow the bias's prior as the filter did: its information is a measurement of zero."""
        if variance < _NARROWER * self._bias_variance:
            covariance = np.eye(3) / (1.0 / variance - 1.0 / self._bias_variance)
            graph = self.builder.graph
            graph.add(GyroBias((graph.last,), covariance, np.zeros(3)), gated=False)
            self._bias_variance = variance

    def _add_bearing(self, gained: Gained) -> None:
        """Add what a magnetic bearing has just told the filter about attitude and bias."""
        graph = self.builder.graph
        R, _, _ = self.builder.dead_reckoned(graph.last)
        R_k = gained.R_WB @ R.T @ graph.states[graph.last].R_WB
        covariance = np.array([[gained.variance]])
        told = gained.b_g, gained.weights, gained.value
        graph.add(Bearing((graph.last,), covariance, R_k, *told), gated=False)

    def _in_graph_frame(self, accepted: Accepted) -> Fix:
        """Return a fix as inflated by the filter, relative to the graph's origin."""
        return accepted.inflated.shifted(-self._origin_W)

    def _solve(self, filtered: EstimatorState) -> None:
        builder, last = self.builder, self.builder.graph.last
        try:
            newest = builder.graph.solve(_MAX_ROUNDS, only_last=True)[last]
            builder.marginalise_until(newest.time - self._config.graph.lag)
        except IndeterminateError as error:
            self._fallbacks, self._reason = self._fallbacks + 1, str(error)
            self._begin(filtered, builder.count)
            return
        self._ahead = EkfState.initial(newest, 0)
        for segment in builder.segments[last]:
            self._ahead = propagate(self._ahead, segment)
