"""The fixed-lag graph for streams: the last seconds optimised anew at every keyframe.

What leaves the lag is marginalised. The filter runs alongside: it judges what is measured for both
(`GraphBuilder`), and the stream goes on from the filter's state where the graph does not determine
its own, or where a late fix has changed what was judged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.filter.ekf import StateCloningEkf
from stario.fusion.filter.estimate import nav_states
from stario.fusion.filter.estimator import FilterRecipe, PriorPose
from stario.fusion.filter.history import Measurement
from stario.fusion.fixes import Fix
from stario.fusion.graph.builder import GraphBuilder
from stario.fusion.graph.keyframes import IndeterminateError
from stario.fusion.imu.intervals import Epoch, IntakeCounts, Start
from stario.fusion.state import Health, Innovations, NavState

_ROUNDS = 3
"""Of each optimisation: the next keyframe's goes on from there."""


class GraphRecipe:
    """A `FilterRecipe` whose states are those of a fixed-lag graph.

    Between keyframes the state is that of the last one, carried on by the IMU.

    Args:
        config: noise, filter and graph settings.
        start: time and levelled attitude of the first sample.
        prior: what is known of the first pose; None starts level, at rest, at the origin.
    """

    def __init__(
        self, config: NavigatorConfig, start: Start, prior: PriorPose | None = None
    ) -> None:
        self._config = config
        self._filter = FilterRecipe(config, start, prior, streaming=True)
        self._fallbacks = 0
        self._why = ""
        self._ahead = StateCloningEkf(slots=0, gravity=config.gravity)
        self._origin_W = np.zeros(3)  # of the graph's positions: see `StateCloningEkf`
        self._builder: GraphBuilder
        self._begin(self._filter.filtered(), 0)

    def step(
        self, epoch: Epoch, measurement: Measurement | None, fixes: Sequence[Fix] = ()
    ) -> None:
        """Move to the epoch's end and take in what was measured; as `FilterRecipe.step`."""
        self._filter.step(epoch, measurement, fixes)
        if self._filter.world != self._world or epoch.anew is not None:
            self._begin(self._filter.filtered(), 0 if epoch.gap else self._builder.count + 1)
            return
        accepted = [fix.inflated.shifted(-self._origin_W) for fix in self._filter.accepted]
        if self._builder.step(epoch, self._filter.taken, accepted, self._filter.held):
            self._solve()
        else:
            self._ahead.propagate(self._builder.newest)

    def late_fix(self, fix: Fix) -> bool:
        """Take in a fix at a time before now; False where it is more than a window late."""
        judged = self._filter.judged
        if not self._filter.late_fix(fix):
            return False
        if self._filter.world != self._world or self._filter.judged != judged:
            self._begin(self._filter.filtered(), self._builder.count)
            return True
        for taken in self._filter.accepted:
            if taken.fix is fix and self._builder.fix(taken.inflated.shifted(-self._origin_W)):
                self._solve()
        return True

    @property
    def time(self) -> float:
        """Of the newest state [s]."""
        return self._ahead.time

    def state(self) -> NavState:
        """The newest state."""
        ahead = self._ahead.estimate(self._filter.in_gap, self._world)
        return nav_states([ahead], self._filter.gyro_prior)[0].shifted(self._origin_W)

    def innovations(self) -> Innovations:
        """Those of the filter alongside."""
        return self._filter.innovations()

    def health(self, counts: IntakeCounts) -> Health:
        """The filter's report with the graph's sigmas, and how often the graph fell back."""
        health = self._filter.health(counts, self.state())
        if self._fallbacks == 0:
            return health
        note = f"graph fell back to the filter {self._fallbacks} times, last for {self._why}"
        return replace(health, notes=[*health.notes, note])

    def dump(self) -> dict[str, Any]:
        """A stream's recipe for `load`: arrays, numbers, text, lists and dictionaries."""
        return {
            "filter": self._filter.dump(),
            "builder": self._builder.dump(),
            "ahead": self._ahead.checkpoint(),
            "origin": self._origin_W,
            "world": self._world,
            "fallbacks": self._fallbacks,
            "why": self._why,
        }

    def load(self, dump: dict[str, Any]) -> None:
        """Become what was dumped by a recipe of the same configuration."""
        self._filter.load(dump["filter"])
        self._builder.load(dump["builder"])
        self._ahead.rewind(dump["ahead"])
        self._world, self._origin_W = dump["world"], dump["origin"]
        self._fallbacks, self._why = dump["fallbacks"], dump["why"]

    def _begin(self, first: NavState, count: int) -> None:
        """A new graph from a state of the filter."""
        self._world, self._origin_W = first.world, first.p_W
        first = first.shifted(-self._origin_W)
        self._builder = GraphBuilder(self._config, first, count, streaming=True)
        self._take(first)

    def _solve(self) -> None:
        builder = self._builder
        graph = builder.graph
        try:
            graph.solve(_ROUNDS)
            newest = graph.state(graph.last)
            builder.forget(newest.time - self._config.graph.lag)
        except IndeterminateError as error:
            self._fallbacks += 1
            self._why = str(error)
            self._begin(self._filter.filtered(), builder.count)
            return
        self._take(newest)
        for segment in builder.segments[graph.last]:
            self._ahead.propagate(segment)

    def _take(self, s: NavState) -> None:
        self._ahead.initialise(s.time, s.R_WB, s.v_W, s.p_W, s.b_g, s.b_a, s.covariance)
