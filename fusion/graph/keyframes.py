"""A factor graph over keyframes on gtsam: IMU, prior and measurements, solved and marginalised.

A keyframe is a pose, a velocity and the biases. gtsam's `CombinedImuFactor` connects each to the
next by the same preintegration as in the filter; the measurements are the terms of `factors`,
linearised again in every round. No factor calls back into Python.

Sources: C. Forster et al., "On-manifold preintegration for real-time visual-inertial odometry",
2017; F. Dellaert, M. Kaess, "Factor graphs for robot perception", 2017 (marginalisation).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from scipy.linalg import block_diag

from stario.fusion.graph.covariances import marginal_covariances
from stario.fusion.graph.factors import Prior
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.fusion.graph.term import IndeterminateError, Term, Whitened, linear_factor
from stario.fusion.imu.preintegration import Segment
from stario.fusion.values.checked import check_covariance
from stario.fusion.values.state import NavState
from stario.sequences.accuracy.chi_square import chi2_quantile
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray

_CONVERGED = 1e-3
"""The optimisation stops after a round that moves no keyframe further than this [m]."""

_FULL_STEPS, _SMALL_TURNS = 50, 60
"""Maximum number of Gauss-Newton steps, and of those that turn only so far."""

_MAX_TURN = 0.3
"""Largest turn of a keyframe in one of these [rad]: the tangent leaves the circle by 4 % of the
radius."""

_NEARLY_CONVERGED = 0.1
"""A track that the last step still moves by more [m] has no figure that could be given out."""

_UNDETERMINED_SIGMA = 1e5
"""A state this uncertain [m, m/s, rad, ...] is undetermined: no walk is so far, fast or biased."""

_GROUPS = ("attitude", "velocity", "position", "gyroscope bias", "accelerometer bias")
_NAMES = {"x": "pose", "v": "velocity", "b": "bias"}


class KeyframeGraph:
    """Keyframes, numbered from 0, with their IMU segments and measurements.

    Args:
        first: the first keyframe; its covariance is the prior.
        gate: probability beyond which a residual counts as an outlier and is down-weighted, unless
            it is added with `gated` false.

    Attributes:
        times: time of each keyframe held [s], by its number, in order.
        states: state of each keyframe held, likewise.
        last: number of the last keyframe.
    """

    def __init__(self, first: NavState, gate: float) -> None:
        self._gate = gate
        self.times: dict[int, float] = {}
        self.states: dict[int, KeyframeState] = {}
        self._segments: dict[int, Segment] = {}  # by the keyframe at which each begins
        self._terms: list[Whitened] = []
        self.last = -1
        self.add_disconnected(first)

    def add_keyframe(
        self, time: float, guess: KeyframeState, segment: Segment | None = None
    ) -> None:
        """Add a keyframe at a time [s], connected to the last one by a segment if there is one."""
        if segment is not None:
            self._segments[self.last] = segment
        self.last += 1
        self.times[self.last], self.states[self.last] = time, guess

    def add_disconnected(self, state: NavState) -> None:
        """Add a disconnected keyframe with its covariance as prior."""
        self.add_keyframe(state.time, KeyframeState.from_nav(state))
        self.add(Prior.of(self.last, state), gated=False)

    def add(self, term: Term, gated: bool = True) -> None:
        """Add a measurement with positive definite covariance, if `gated` as a possible outlier."""
        limit = chi2_quantile(self._gate, len(term.covariance)) if gated else math.inf
        self._terms.append(Whitened.of(term, limit))

    def solve(
        self,
        max_rounds: int | None = None,
        trusted_rounds: int = 0,
        only_last: bool = False,
    ) -> dict[int, NavState]:
        """Optimise the keyframes by Gauss-Newton steps.

        Args:
            max_rounds: number of linearisations of the measurements after which it need not have
                converged; None if it must.
            trusted_rounds: number of first rounds in which none is down-weighted: a poor start must
                not decide which of them are false.
            only_last: whether the last keyframe alone is wanted, and checked.

        Returns:
            The keyframes by number, with their marginal covariances.

        Raises:
            IndeterminateError: a state is not determined, or the optimisation does not converge;
                the keyframes are then unchanged.
        """
        with self._undetermined_named():
            values, net = self._optimised(max_rounds, trusted_rounds)
            last_first = marginal_covariances(net)
            covariances = dict([next(last_first)] if only_last else last_first)
        states = {k: KeyframeState.of(values, k) for k in self.times}
        solved = {
            k: _solved(self.times[k], states[k], covariances[k]) for k in states if k in covariances
        }
        for k in (next(iter(solved)), self.last):
            _check_determined(solved[k])
        self.states = states
        return solved

    def marginalise(self, before: int) -> None:
        """Marginalise the keyframes before a given one, keeping their information on later ones.

        Raises:
            IndeterminateError: a marginalised state is not determined.
        """
        old = [k for k in self.times if k < before]
        if not old:
            return
        values = self._values()
        linear = self._imu_factors(before).linearize(values)
        connected, kept = [before], []
        for term in self._terms:
            first, *later = term.term.keyframes
            if first < before:
                linear.push_back(term.factor(values))
                connected += later
            else:
                kept.append(term)
        with self._undetermined_named():
            _, remaining = linear.eliminatePartialMultifrontal(
                self._ordering(old), gtsam.EliminateQR
            )
        self._terms = kept
        self.add(self._marginal(range(before, max(connected) + 1), remaining), gated=False)
        for k in old:
            for held in (self.times, self.states, self._segments):
                held.pop(k, None)

    def _values(self) -> Any:
        values = gtsam.Values()
        for k, state in self.states.items():
            state.insert_into(values, k)
        return values

    def _imu_factors(self, before: float = math.inf) -> Any:
        """Return the factors that connect each keyframe before a given one to the next."""
        factors = gtsam.NonlinearFactorGraph()
        for i, segment in self._segments.items():
            if i < before:
                j, pim = i + 1, segment.pim
                factors.add(gtsam.CombinedImuFactor(X(i), V(i), X(j), V(j), B(i), B(j), pim))
        return factors

    def _marginal(self, keyframes: range, remaining: Any) -> Prior:
        """Return the prior that elimination left on the keyframes that it reached."""
        reference = tuple(self.states[k] for k in keyframes)
        to_local = [np.linalg.inv(state.invariant_from_local()) for state in reference]
        for k, state in zip(keyframes, reference, strict=True):
            # A window may reach only a pose: add the other columns, without information.
            nothing = state.blocks(k, np.zeros((1, 15 + (state.offset is not None))))
            remaining.push_back(linear_factor(nothing, np.zeros(1)))
        A, b = remaining.jacobian(self._ordering(keyframes))
        table = np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"))[: A.shape[1]]
        root = table[:, :-1] @ block_diag(*to_local)
        return Prior.white(keyframes[0], reference, root, table[:, -1])

    def _optimised(self, max_rounds: int | None, trusted_rounds: int) -> tuple[Any, Any]:
        """Take full Gauss-Newton steps, which follow the IMU's stiff factors as a filter does.

        From a poor start, a correct step may increase their error by its second-order terms.
        Levenberg-Marquardt's damping is then slow, and a stream would output unconverged states.
        Where hardly anything tells the heading for a long time, full steps lead from one end of
        what is possible to the other, by more than half a turn: then small turns, one after the
        other, converge.

        Return the values and gtsam's Bayes net of the last step.
        """
        if max_rounds is not None:
            values, net, _ = self._after_steps(max_rounds, trusted_rounds)
            return values, net
        for rounds, *limits in (
            (_FULL_STEPS, math.pi, math.inf),
            (_SMALL_TURNS, math.inf, _MAX_TURN),
        ):
            values, net, change = self._after_steps(rounds, trusted_rounds, *limits)
            if change < _NEARLY_CONVERGED:
                return values, net
        raise IndeterminateError("the optimisation does not converge")

    def _after_steps(
        self,
        rounds: int,
        trusted_rounds: int,
        no_turn: float = math.inf,
        max_turn: float = math.inf,
    ) -> tuple[Any, Any, float]:
        """Return the values after Gauss-Newton steps, the last step's net and motion [m].

        Args:
            rounds: maximum number of steps.
            trusted_rounds: as for `solve`.
            no_turn: turn of a keyframe [rad] from which a step is not taken, which is given up.
            max_turn: turn to which steps are scaled [rad].
        """
        factors, values, ordering = self._imu_factors(), self._values(), self._ordering(self.times)
        net, change = None, math.inf
        for k in range(rounds):
            linear = factors.linearize(values)
            for term in self._terms:
                linear.push_back(term.factor(values, trusted=k < trusted_rounds))
            net = linear.eliminateSequential(ordering, gtsam.EliminateQR)
            step = net.optimize()
            turn = max(float(np.linalg.norm(step.at(X(n))[:3])) for n in self.times)
            if turn > no_turn:
                return values, net, math.inf
            if turn > max_turn:
                step.scaleInPlace(max_turn / turn)
            before, values = values, values.retract(step)
            change = float(np.abs(_positions(values) - _positions(before)).max())
            if not change > _CONVERGED:
                break
        if not np.isfinite(change):
            raise IndeterminateError("the optimisation diverged")
        return values, net, change

    def _ordering(self, keyframes: Iterable[int]) -> Any:
        """Return the keys in order of time: the graph's longest link is a window."""
        ordering = gtsam.Ordering()
        for k in keyframes:
            for key in self.states[k].keys(k):
                ordering.push_back(key)
        return ordering

    @contextmanager
    def _undetermined_named(self) -> Iterator[None]:
        """Raise what gtsam reports of a state as an error that names it and its time."""
        try:
            yield
        except RuntimeError as error:
            message = str(error).strip().splitlines()[0]
            if found := re.search(r"Symbol: ([xvb])(\d+)", str(error)):
                message = f"{_NAMES[found[1]]} at {self.times[int(found[2])]:.1f} s is undetermined"
            raise IndeterminateError(message) from error


def _positions(values: Any) -> FloatArray:
    """Return the keyframes' positions (N, 3) [m]."""
    return np.asarray(gtsam.utilities.extractPose3(values)[:, 9:])


def _solved(time: float, state: KeyframeState, covariance: FloatArray) -> NavState:
    """Return a keyframe's state from its covariance in gtsam's tangent."""
    R, v, p, b_g, b_a, _ = state
    to_world = KeyframeState(R, np.zeros(3), np.zeros(3), b_g, b_a).invariant_from_local()
    return NavState(time, R, v, p, b_g, b_a, to_world @ covariance @ to_world.T)


def _check_determined(state: NavState) -> None:
    variance = state.covariance.diagonal()
    if not (variance < _UNDETERMINED_SIGMA**2).all():
        worst = int(np.argmax(np.where(np.isfinite(variance), variance, np.inf)))
        raise IndeterminateError(f"{_GROUPS[worst // 3]} at {state.time:.1f} s is undetermined")
    try:
        check_covariance(state.covariance)
    except InputError as error:
        message = f"the covariance at {state.time:.1f} s has no digits left"
        raise IndeterminateError(message) from error
