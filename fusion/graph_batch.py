"""The whole track at once: keyframes optimised together, the states between them filled in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from stario.fusion.config import NavigatorConfig
from stario.fusion.graph import IndeterminateError, KeyframeGraph
from stario.fusion.graph_builder import GraphBuilder
from stario.fusion.intake import Epoch
from stario.fusion.lie import FloatArray, exp_so3, log_so3
from stario.fusion.preintegration import Segment
from stario.fusion.recipe import Measurement
from stario.fusion.state import NavState


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A smoothed track.

    Attributes:
        states: as many as were given, at the same times.
        note: one line on how it went, for the health report.
        fell_back: whether the states are the filter's.
    """

    states: list[NavState]
    note: str
    fell_back: bool = False


def smooth(
    filtered: Sequence[NavState],
    epochs: Sequence[Epoch],
    measurements: Sequence[Measurement | None],
    config: NavigatorConfig,
) -> Smoothed:
    """Optimise a filtered track as a whole.

    Args:
        filtered: the filter's states: the start and one for each epoch.
        epochs: of the recording.
        measurements: one for each epoch, None where there is none.
        config: noise, filter and graph settings.

    Returns:
        The graph's states with their marginal covariances; the filter's own where the graph does
        not determine one.
    """
    builder = GraphBuilder(config, filtered[0])
    for epoch, measurement, state in zip(epochs, measurements, filtered[1:], strict=True):
        builder.step(epoch, measurement, state)
    builder.close()
    try:
        solution = builder.graph.solve()
    except IndeterminateError as error:
        return Smoothed(list(filtered), f"graph fell back to the filter's track: {error}", True)
    states = filled(builder.graph, builder.segments)
    marked = [replace(s, in_gap=f.in_gap) for s, f in zip(states, filtered, strict=True)]
    note = (
        f"graph of {len(builder.graph.keyframes)} keyframes, {solution.rounds} rounds, "
        f"{solution.weighed_down} measurements weighed down"
    )
    return Smoothed(marked, note)


def filled(graph: KeyframeGraph, segments: dict[int, list[Segment]]) -> list[NavState]:
    """The keyframes of a solved graph and the states at the ends of the segments between them."""
    keyframes = graph.keyframes
    states = [graph.state(keyframes[0])]
    for i in keyframes[:-1]:
        start, end = states[-1], graph.state(i + 1)
        if len(segments[i]) > 1:
            states += _between(start, end, segments[i])
        states.append(end)
    return states


def _between(start: NavState, end: NavState, segments: list[Segment]) -> list[NavState]:
    """The states inside an interval, by the IMU from its start, bent to meet its end.

    What is missing at the end comes from white noise all along: the angle grows with time, the
    position along the cubic that leaves with no error and arrives with both (Hermite).
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
        along = s * s * (3.0 - 2.0 * s) * dp + duration * s * s * (s - 1.0) * dv
        speed = 6.0 * s * (1.0 - s) / duration * dp + s * (3.0 * s - 2.0) * dv
        states.append(
            NavState(
                time,
                exp_so3(s * turn) @ R,
                v + speed,
                p + along,
                _mix(start.b_g, end.b_g, s),
                _mix(start.b_a, end.b_a, s),
                _mix(start.covariance, end.covariance, s),
            )
        )
    return states


def _mix(a: FloatArray, b: FloatArray, s: float) -> FloatArray:
    return np.asarray((1.0 - s) * a + s * b)
