"""A navigator's stream: all that changes from sample to sample.

A sample passes the front end, which cuts it into intervals; the network predicts the displacement
of the window that ends with an interval, and both step the filter, which the graph follows.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

from stario.fusion.backends import BackendName
from stario.fusion.filter import estimator
from stario.fusion.filter.estimator_state import EstimatorState
from stario.fusion.filter.initial import PriorPose
from stario.fusion.graph.fixed_lag import FixedLag
from stario.fusion.imu.faults import ClockSetBackError
from stario.fusion.imu.front_end import FrontEnd
from stario.fusion.imu.inference import Predictor, StatefulInference, displacements_of
from stario.fusion.imu.intervals import ImuInterval, Sample
from stario.fusion.imu.units import check_start
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import Fix, FixOutcome, FixQueue
from stario.fusion.values.health import Health
from stario.fusion.values.state import ContinuousPose, NavState, advanced, copied
from stario.sequences.errors import InputError


class Stream:
    """Front end, network's memory, filter, graph and waiting fixes of one stream.

    Args:
        model: predicts displacements.
        config: settings.
        prior: prior on the first pose, or None.
        backend: "graph" has the fixed-lag graph follow the filter.

    Attributes:
        prior: the prior; None after the clock was set back.
        state: state of the filter; None before the first one.
        graph: the graph; None without one.
        continuous: newest pose without steps at updates; None before the first state.
    """

    def __init__(
        self,
        model: Predictor,
        config: NavigatorConfig,
        prior: PriorPose | None,
        backend: BackendName,
    ) -> None:
        self._model, self._config, self._backend = model, config, backend
        self.prior, self._fixes = prior, FixQueue()
        self._begin()

    def _begin(self) -> None:
        self.front_end = FrontEnd(self._config)
        self.state: EstimatorState | None = None
        self.graph: FixedLag | None = None
        self.continuous: ContinuousPose | None = None
        self._network = StatefulInference(self._model, self._config.filter.window_updates)

    def push(self, sample: Sample) -> NavState | None:
        """Process one sample: time, gyro and accel; return the newest state if it completed one.

        Raises:
            InputError: the stream begins again, since its samples cannot be right; or the model's
                predictions have other shapes.
        """
        try:
            intervals = self.front_end.push(sample)
        except ClockSetBackError:
            # The prior and the waiting fixes belong to the other clock.
            self.prior, self._fixes = None, FixQueue()
            self._begin()
            raise
        state: NavState | None = None
        failure: Exception | None = None
        for interval in intervals:  # several after a hole that was bridged
            try:
                state = self._advance(interval)
            except Exception as error:
                if self.state is None:  # the stream begins again
                    raise
                failure = failure or error
        if failure is not None:
            raise failure
        return state

    def _advance(self, interval: ImuInterval) -> NavState:
        start = self.front_end.start
        assert start is not None  # set before the first interval
        try:
            self.front_end.sensors.check(interval)
            if self.state is None:
                check_start(start, self._config.gravity, interval.table)
                self.state = estimator.begin(self._config, start, self.prior, streaming=True)
                if self._backend == "graph":
                    self.graph = FixedLag(self.state, self._config)
                self._fixes.start(start.time)
        except InputError:
            self._begin()
            raise
        if interval.gap:
            self._network.restart()
        displacement = None
        try:
            if interval.window is not None:
                (displacement,) = displacements_of(self._network, [interval.window])
        finally:  # if the network fails, the IMU's motion must not be lost
            due = self._fixes.due(interval.stop)
            self.state, record = estimator.step(
                self.state, interval.without_window(), displacement, due, self._config
            )
            if self.graph is not None:
                self.graph.step(self.state, record)
        state = self._newest(self.state)
        self.continuous = copied(advanced(self.continuous, state))  # `state` is writable
        return state

    def nav_state(self) -> NavState | None:
        """Return the newest state; None before the first one."""
        return None if self.state is None else self._newest(self.state)

    def _newest(self, filtered: EstimatorState) -> NavState:
        return filtered.nav_state() if self.graph is None else self.graph.nav_state(filtered)

    def take(self, fix: Fix) -> FixOutcome:
        """Apply a fix, or keep it until its time."""
        if self.state is None or fix.fault() or fix.time > self.state.time:
            return self._fixes.add(fix)
        self._fixes.count(fix)
        before, found = self.state, estimator.late_fix(self.state, fix, self._config)
        if found is None:
            self._fixes.refuse("too late")
            return "refused"
        self.state, accepted = found
        if self.graph is not None:
            self.graph.late_fix(before, self.state, fix, accepted)
        if self.continuous is not None:
            state = self._newest(self.state)
            if state.map_frame != self.continuous.map_frame:
                self.continuous = advanced(self.continuous, state)
        return next((applied.outcome for applied in accepted if applied.fix is fix), "refused")

    def health(self) -> Health:
        """Return the health report so far."""
        counts = self.front_end.counts
        if self.state is None:
            return self._fixes.health(deepcopy(counts))
        health = self.state.health(counts, self._config.filter, self.nav_state())
        if self.graph is not None:
            health = replace(health, notes=health.notes + self.graph.notes)
        return self._fixes.health(health)

    def parts(self) -> dict[str, Any]:
        """Return all that a snapshot holds of the stream, by name."""
        return {
            "prior": self.prior,
            "front end": self.front_end,
            "fixes": self._fixes,
            "network": self._network.memory,
            "continuous": self.continuous,
            "filter": self.state,
            "graph": self.graph,
        }

    def continue_from(self, parts: dict[str, Any]) -> None:
        """Continue a new stream from the parts of another."""
        self.prior, self._fixes = parts["prior"], parts["fixes"]
        self.front_end, self.continuous = parts["front end"], parts["continuous"]
        if parts["network"] is not None and not self._network.is_recurrent:
            raise InputError(
                "snapshot: network", "a different kind of memory", "that of the same network"
            )
        self._network.memory = parts["network"]
        self.state, self.graph = parts["filter"], parts["graph"]
