"""From intervals to a graph: add keyframes, connect them, and add their measurements."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from stario.fusion.filter.height import WEATHER_WALK
from stario.fusion.filter.initial import tilt_sigma
from stario.fusion.filter.record import Record
from stario.fusion.filter.zero_velocity import ZeroVelocity
from stario.fusion.graph.factors import (
    ConstantVelocity,
    Displacement,
    GyroBias,
    Height,
    Position,
    Tilt,
    Velocity,
    Yaw,
)
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.fusion.graph.keyframes import KeyframeGraph
from stario.fusion.graph.term import Term
from stario.fusion.imu.barometer import HeightSample
from stario.fusion.imu.gap import gap_covariance, gap_rotation, yaw_variance
from stario.fusion.imu.inference import WindowDisplacement
from stario.fusion.imu.intervals import SAME_TIME, ImuInterval, split_at
from stario.fusion.imu.preintegration import MAX_TURN, Segment, segment_of
from stario.fusion.values.config import NavigatorConfig
from stario.fusion.values.fixes import Fix
from stario.fusion.values.state import NavState
from stario.sequences.attitude.so3 import exp_so3, log_so3
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SECONDS

_SPACING_TURN = MAX_TURN - 3.5
"""Rotation [rad] after which a keyframe does not wait for a window's end: in the next tenth of a
second a gyroscope measures up to 35 rad/s."""

Pose = tuple[FloatArray, FloatArray, FloatArray]
"""R_WB (3, 3), v_W (3,), p_W (3,)."""


class GraphBuilder:
    """Builds a `KeyframeGraph` from intervals.

    Keyframes are placed where windows begin and end, at both ends of a gap, and in a spin before a
    segment has turned by more than gtsam's tangent holds. More of them gain nothing: the IMU
    connects them as well over half a second as over a tenth, and predicts the motion between a
    keyframe and a fix. Two windows per second, where updates are that frequent, do better than one
    that is trusted as much as both (whole tracks of 177 recordings, on which this was chosen: 0.84
    of the network's error instead of 0.90, 95th percentile 1.19 instead of 1.46).

    Args:
        config: noise, filter and graph settings.
        first: the first state; its covariance is the prior.
        count: number of intervals since the start or the last gap, for a graph that begins later.
        streaming: rely on the filter's gating of fixes, and of displacements if it weights them
            equally. A robust loss in the graph starts from the IMU's prediction: while the speed
            was still unknown it rejected correct displacements, one after the other, and in 2 of
            100 simulated walks permanently.

    Attributes:
        graph: the graph so far.
        segments: for each keyframe, the intervals' segments up to the next keyframe or now.
        count: number of intervals since the start or the last gap.
    """

    def __init__(
        self, config: NavigatorConfig, first: NavState, count: int = 0, streaming: bool = False
    ) -> None:
        self._config, f = config, config.filter
        self.graph = KeyframeGraph(first, config.filter.gate)
        self.segments: dict[int, tuple[Segment, ...]] = {0: ()}
        self.count = count
        self._streaming = streaming
        self._overlap = 2 if f.update_rate % 2 == 0 else 1
        # The filter uses every window of a second, the graph only one or two of them.
        self._gated_by_filter = streaming and f.update_rate == self._overlap
        self._window = round(f.output_rate * WINDOW_SECONDS)  # intervals
        self._spacing = self._window // self._overlap  # intervals
        self._pending: list[Record] = []
        # Keyframes where windows begin and end, by the count of intervals; cleared at a gap.
        self._window_keyframes: dict[int, int] = {count: 0} if count % self._spacing == 0 else {}
        self._gaps: dict[int, ImuInterval] = {}  # by the keyframe before them
        self._last_height: tuple[int, float] | None = None  # keyframe and time

    def step(
        self,
        record: Record,
        displacement: WindowDisplacement | None,
        fixes: Sequence[Fix],
        guess: NavState | None = None,
    ) -> bool:
        """Add an interval and its measurements.

        Args:
            record: of the next interval.
            displacement: its displacement, weighted as the graph needs it; None if there is none.
            fixes: its fixes, relative to the graph's origin, in order.
            guess: initial guess of the state at its end, and the filter's segment is used; None
                predicts it from the IMU, except across a gap.

        Returns:
            Whether a keyframe was added.
        """
        interval = record.interval
        if interval.gap:
            assert guess is not None  # a stream's graph begins again after each gap
            self._cross(interval, guess)
            if not interval.lost:
                for fix in fixes:
                    self.fix(fix)
            return True
        before = self.graph.last
        self.count += 1
        segment = record.segment
        if guess is None or segment is None:
            segment = self._segment_of([record])
        self.segments[before] = (*self.segments[before], segment)
        self._pending.append(record)
        due = self.count % self._spacing == 0
        if due:
            self.close(guess)
            window_start = self._window_keyframes.get(self.count - self._window)
            if displacement is not None and window_start is not None:
                self._add_displacement(window_start, displacement)
            self._window_keyframes[self.count] = self.graph.last
            if record.zero_velocity is not None:
                self._add_zero_velocity(record.zero_velocity)
        elif _turned(self._pending) > _SPACING_TURN:
            self.close(guess)
        if interval.height is not None:
            self._add_height(interval.height)
        for fix in fixes:
            self.fix(fix)
        return self.graph.last > before

    def close(self, guess: NavState | None = None) -> None:
        """Add a keyframe at the end of the intervals since the last one, if there are any."""
        if not self._pending:
            return
        graph = self.graph
        pieces = self.segments[graph.last]
        segment = pieces[0] if len(pieces) == 1 else self._segment_of(self._pending)
        if guess is None:
            start = graph.states[graph.last]
            state = KeyframeState(*self.dead_reckoned(graph.last), start.b_g, start.b_a)
        else:
            state = KeyframeState.from_nav(guess)
        self._pending = []
        graph.add_keyframe(segment.stop, state, segment)
        self.segments[graph.last] = ()

    def _segment_of(self, records: Sequence[Record]) -> Segment:
        """Preintegrate the samples of records since the last keyframe, with its biases."""
        start = self.graph.states[self.graph.last]
        intervals, factors = [r.interval for r in records], [r.accel_factor for r in records]
        return segment_of(intervals, factors, start.b_g, start.b_a, self._config)

    def fix(self, fix: Fix) -> bool:
        """Add a fix up to now to the keyframe before it; return False if there is none."""
        graph = self.graph
        before = [k for k, time in graph.times.items() if time <= fix.time + SAME_TIME]
        if not before:
            return False
        graph.add(self._fix_term(fix, before[-1]), gated=not self._streaming)
        return True

    def marginalise_until(self, time: float) -> None:
        """Marginalise the keyframes before the last one at or before a time [s].

        Raises:
            IndeterminateError: their states are not determined.
        """
        first = max((k for k, at in self.graph.times.items() if at <= time), default=0)
        self.graph.marginalise(first)
        self._window_keyframes = {n: k for n, k in self._window_keyframes.items() if k >= first}
        self.segments = {k: pieces for k, pieces in self.segments.items() if k >= first}
        self._gaps = {k: gap for k, gap in self._gaps.items() if k >= first}

    def dead_reckoned(self, k: int, time: float = math.inf) -> Pose:
        """Dead-reckon from a keyframe to a time [s], or to the end of its data if earlier."""
        R, v, p, b_g, b_a, _ = self.graph.states[k]
        if k in self._gaps:
            gap = self._gaps[k]
            until = min(time, gap.stop)
            if until < gap.stop:
                gap, _ = split_at(gap, until)
            turn = gap_rotation(gap.table, self._gaps[k].duration, b_g)
            return R @ turn, v, p + gap.duration * v
        for segment in self.segments[k]:
            end = segment.predict(R, v, p, b_g, b_a)
            if segment.stop > time:
                fraction = (time - segment.start) / segment.duration
                return _pose_between((R, v, p), end, fraction, segment.duration)
            R, v, p = end
        return R, v, p

    def _cross(self, gap: ImuInterval, guess: NavState) -> None:
        """Add a keyframe at the end of a gap."""
        self.close()
        graph, before = self.graph, self.graph.last
        if gap.lost:
            graph.add_disconnected(guess)  # the filter's new start
        else:
            self._gaps[before] = gap
            graph.add_keyframe(gap.stop, KeyframeState.from_nav(guess))
            t, zero = gap.duration, np.zeros(3)
            covariance = gap_covariance(t, yaw_variance(t, gap), zero, self._config)[2:, 2:]
            rotation = gap_rotation(gap.table, t, graph.states[before].b_g)
            graph.add(ConstantVelocity((before, graph.last), covariance, t, rotation), gated=False)
            assert gap.levelled is not None  # it comes with the end of every gap
            variance = tilt_sigma(gap.levelled, self._config) ** 2
            graph.add(Tilt((graph.last,), variance * np.eye(3), gap.levelled.up_B), gated=False)
        self.count = 0
        self.segments[graph.last] = ()
        self._window_keyframes = {0: graph.last}

    def _add_displacement(self, i: int, displacement: WindowDisplacement) -> None:
        d_N, covariance_N, R_NB = displacement
        covariance = covariance_N * (self._overlap * self._config.filter.covariance_scale)
        term = Displacement((i, self.graph.last), covariance, d_N, R_NB)
        self.graph.add(term, gated=not self._gated_by_filter)

    def _add_zero_velocity(self, zero_velocity: ZeroVelocity) -> None:
        zero, at = np.zeros(3), (self.graph.last,)
        # One keyframe represents all intervals since the previous one.
        covariance = zero_velocity.covariance / self._spacing
        self.graph.add(Velocity(at, covariance[:3, :3], zero, zero))
        self.graph.add(GyroBias(at, covariance[3:, 3:], zero_velocity.b_g))

    def _add_height(self, sample: HeightSample) -> None:
        graph, k, before = self.graph, self.graph.last, self._last_height
        measured: tuple[int, ...] = (k,)
        variances = [sample.sigma**2]
        # In a stream the one before may have left the graph.
        if before is not None and before[0] != k and before[0] in graph.times:
            measured = (before[0], k)
            walked = WEATHER_WALK**2 * (sample.time - before[1]) + sample.stepped**2
            variances.append(walked)
        if before is None or before[0] != k:
            state = graph.states[k]
            graph.states[k] = state._replace(offset=sample.height - float(state.p_W[2]))
            self._last_height = k, sample.time
        dt = sample.time - graph.times[k]
        graph.add(Height(measured, np.diag(variances), sample.height, dt), gated=False)

    def _fix_term(self, fix: Fix, k: int) -> Term:
        graph = self.graph
        dt = fix.time - graph.times[k]
        R_k, v_k, p_k, *_ = graph.states[k]
        R, v, p = (R_k, v_k, p_k) if dt <= SAME_TIME else self.dead_reckoned(k, fix.time)
        dt, f = max(dt, 0.0), self._config.filter
        # Noise of the IMU since the keyframe, or of the motion in a gap.
        accel_noise = f.gap_accel_noise if k in self._gaps else self._config.noise.accel_noise
        turned = yaw_variance(dt, self._gaps[k]) if k in self._gaps else 0.0
        drift = accel_noise**2 * dt * np.eye(3)
        if fix.kind == "position":
            covariance = fix.covariance + dt**2 / 3.0 * drift
            return Position((k,), covariance, fix.value, dt, p - p_k - dt * v_k)
        if fix.kind == "velocity":
            return Velocity((k,), fix.covariance + drift, fix.value, v - v_k)
        return Yaw((k,), fix.covariance + turned, float(fix.value[0]), R_k.T @ R)


def _turned(records: Sequence[Record]) -> float:
    """Return the rotation over consecutive intervals, to first order [rad]."""
    turns = [r.interval.duration * r.interval.gyro.mean(axis=0) for r in records]
    return float(np.linalg.norm(np.sum(turns, axis=0)))


def _pose_between(start: Pose, end: Pose, fraction: float, duration: float) -> Pose:
    """Interpolate between poses a tenth of a second apart, at constant rate and acceleration."""
    (R0, v0, p0), (R1, v1, _) = start, end
    v = v0 + fraction * (v1 - v0)
    return exp_so3(fraction * log_so3(R1 @ R0.T)) @ R0, v, p0 + 0.5 * fraction * duration * (v0 + v)
