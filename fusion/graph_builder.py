"""From epochs to a graph: when a keyframe is made, what binds and what measures it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.linalg.lapack import dpotrf

from stario.fusion.config import NavigatorConfig
from stario.fusion.graph import KeyframeGraph
from stario.fusion.graph_terms import Displacement
from stario.fusion.intake import Epoch
from stario.fusion.lie import FloatArray
from stario.fusion.preintegration import Segment
from stario.fusion.recipe import Measurement
from stario.fusion.segments import segment_of
from stario.fusion.state import NavState
from stario.sequences.windows import WINDOW_SECONDS


class GraphBuilder:
    """Feeds epochs to a `KeyframeGraph`.

    Keyframes stand at the grid's times, `keyframe_rate` a second, and at both ends of a gap.

    Args:
        config: noise, filter and graph settings.
        first: the first state; its covariance is the prior.

    Attributes:
        graph: the graph so far.
        segments: by keyframe, the epochs' segments from it to the next (or to now).
    """

    def __init__(self, config: NavigatorConfig, first: NavState) -> None:
        self._config = config
        self.graph = KeyframeGraph(first, config.filter.gate)
        self.segments: dict[int, list[Segment]] = {0: []}
        self._stride = config.filter.output_rate // config.graph.keyframe_rate
        # Overlapping windows see the same motion again, as in the filter's settings.
        rate = min(config.filter.update_rate, config.graph.keyframe_rate)
        self._scale = rate * WINDOW_SECONDS * config.filter.covariance_scale
        self._window = round(config.filter.output_rate * WINDOW_SECONDS)
        self._pending: list[Epoch] = []
        self._guess = first
        self._count = 0  # epochs since the start or the last gap
        self._keyframe_at = {0: 0}  # count to keyframe, as far back as a window reaches

    def step(self, epoch: Epoch, measurement: Measurement | None, guess: NavState) -> bool:
        """Take in an epoch and the measurement of the window that ends with it.

        Args:
            epoch: the next one.
            measurement: displacement and covariance, None where there is none.
            guess: the state at the epoch's end, from where the optimisation starts.

        Returns:
            Whether a keyframe was made.
        """
        made = epoch.gap and self.close()
        graph = self.graph
        R, _, _, b_g, b_a = graph.pose(graph.last)
        self.segments[graph.last].append(segment_of(epoch, R, b_g, b_a, self._config))
        self._pending.append(epoch)
        self._guess = guess
        if epoch.gap:
            self._count = 0
            self._keyframe_at.clear()
        else:
            self._count += 1
        if self._count % self._stride:
            return made
        self.close()
        self._keyframe_at[self._count] = graph.last
        self._keyframe_at.pop(self._count - self._window - self._stride, None)
        if measurement is not None:
            self._measure(epoch, *measurement)
        return True

    def close(self) -> bool:
        """Make a keyframe of the epochs since the last one; False where there are none."""
        if not self._pending:
            return False
        graph = self.graph
        pieces = self.segments[graph.last]
        whole = pieces[0]
        if len(pieces) > 1:
            R, _, _, b_g, b_a = graph.pose(graph.last)
            whole = segment_of(_merged(self._pending), R, b_g, b_a, self._config)
        self._pending = []
        self.segments[graph.add_keyframe(whole, self._guess)] = []
        return True

    def _measure(self, epoch: Epoch, d_N: FloatArray, covariance_N: FloatArray) -> None:
        i = self._keyframe_at.get(self._count - self._window)
        covariance = covariance_N * self._scale
        if i is None or not usable(d_N, covariance):
            return
        assert epoch.R_NB_window is not None  # a window always comes with its first attitude
        self.graph.add(Displacement(i, self.graph.last, d_N, epoch.R_NB_window, covariance))


def usable(value: FloatArray, covariance: FloatArray) -> bool:
    """Whether a measurement is finite and its covariance positive definite."""
    with np.errstate(invalid="ignore", over="ignore"):
        finite = math.isfinite(float(np.vdot(value, value) + np.vdot(covariance, covariance)))
    return finite and dpotrf(covariance, lower=1)[1] == 0


def _merged(epochs: Sequence[Epoch]) -> Epoch:
    """Epochs without gaps as one; each begins with the sample that ended the one before."""
    first, rest = epochs[0], epochs[1:]

    def joined(name: str) -> FloatArray:
        return np.concatenate([getattr(first, name), *(getattr(e, name)[1:] for e in rest)])

    return Epoch(
        time=joined("time"),
        gyro=joined("gyro"),
        accel=joined("accel"),
        gap=False,
        attitudes=first.attitudes,
        R_NB=epochs[-1].R_NB,
    )
