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
from collections.abc import Iterable
from copy import copy
from typing import Any, TypeVar

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from scipy.linalg import block_diag

from stario.fusion.graph.factors import Prior, Term
from stario.fusion.graph.keyframe_state import KeyframeState
from stario.fusion.graph.marginals import LinearSolution
from stario.fusion.graph.processes import Coasting
from stario.fusion.graph.whitening import IndeterminateError, Whitened, linear_factor
from stario.fusion.imu.gap import gap_covariance, gap_rotation, yaw_variance
from stario.fusion.imu.intervals import ImuInterval
from stario.fusion.imu.preintegration import Segment
from stario.fusion.values.checked import check_covariance
from stario.fusion.values.config import NavigatorConfig
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


Held = TypeVar("Held")


def shallow_copy(held: Held) -> Held:
    """Return a copy of an object with copies of its lists and dictionaries."""
    new = copy(held)
    parts = {k: v.copy() for k, v in vars(held).items() if isinstance(v, dict | list)}
    vars(new).update(parts)
    return new


class KeyframeGraph:
    """Keyframes, numbered from 0, with their IMU segments and measurements.

    Args:
        first: the first keyframe; its covariance is the prior.
        gate: probability beyond which a residual counts as an outlier and is down-weighted, unless
            it is added with `gated` false.
    """

    def __init__(self, first: NavState, gate: float) -> None:
        self._gate = gate
        self._states: dict[int, KeyframeState] = {}
        self._time: dict[int, float] = {}
        self._segments: dict[int, Segment] = {}  # by the keyframe at which each begins
        self._terms: list[Whitened] = []
        self._solution: LinearSolution | None = None  # of the last round
        self.last = -1
        self.add_disconnected(first)

    def __getstate__(self) -> dict[str, Any]:
        """Return all but the solution: after restoring, call `solve` before `state`."""
        return vars(self) | {"_solution": None}

    @property
    def keyframes(self) -> list[int]:
        """Numbers of the keyframes held, in order."""
        return list(self._time)

    def copied(self) -> KeyframeGraph:
        """Return an unsolved copy that may be changed; what both hold is never modified."""
        return shallow_copy(self)

    def time(self, k: int) -> float:
        """Return the time of a keyframe [s]."""
        return self._time[k]

    def add_keyframe(self, segment: Segment, guess: KeyframeState) -> int:
        """Connect a new keyframe to the last one by a segment; return its number."""
        self._segments[self.last] = segment
        self._insert(segment.stop, guess)
        return self.last

    def add_after_gap(self, gap: ImuInterval, guess: NavState, config: NavigatorConfig) -> int:
        """Connect a new keyframe to the last one across a gap; return its number."""
        i, t = self.last, gap.duration
        self._insert(gap.stop, KeyframeState.from_nav(guess))
        covariance = gap_covariance(t, yaw_variance(t, gap), np.zeros(3), config)[2:, 2:]
        rotation = gap_rotation(gap.table, t, self._states[i].b_g)
        self.add(Coasting(i, self.last, t, rotation, covariance), gated=False)
        return self.last

    def add_disconnected(self, state: NavState) -> int:
        """Add a disconnected keyframe with its covariance as prior; return its number."""
        prior = Prior.of(self.last + 1, state)
        self._insert(state.time, prior.reference[0])
        self.add(prior, gated=False)
        return self.last

    def add_offset(self, k: int, offset: float) -> None:
        """Give a keyframe the state of a barometer's offset [m]."""
        self._states[k], self._solution = self._states[k]._replace(offset=offset), None

    def add(self, term: Term, gated: bool = True) -> None:
        """Add a measurement with positive definite covariance, if `gated` as a possible outlier."""
        limit = chi2_quantile(self._gate, len(term.covariance)) if gated else math.inf
        self._terms.append(Whitened.of(term, limit))
        self._solution = None

    def solve(self, max_rounds: int | None = None, trusted_rounds: int = 0) -> None:
        """Optimise the keyframes by Gauss-Newton steps.

        Args:
            max_rounds: number of linearisations of the measurements after which it need not have
                converged; None if it must.
            trusted_rounds: number of first rounds in which none is down-weighted: a poor start must
                not decide which of them are false.

        Raises:
            IndeterminateError: a state is not determined, or the optimisation does not converge;
                the keyframes are then unchanged.
        """
        start = self._states
        try:
            values = self._optimised(max_rounds, trusted_rounds)
            self._states = {k: KeyframeState.of(values, k) for k in self._time}
            self._check_determined()
        except (RuntimeError, IndeterminateError) as error:
            self._states, self._solution = start, None
            if isinstance(error, IndeterminateError):
                raise
            # gtsam's way to report it
            raise IndeterminateError(self._undetermined_state(str(error))) from error

    def keyframe(self, k: int) -> KeyframeState:
        """Return a keyframe without its covariance."""
        return self._states[k]

    def state(self, k: int) -> NavState:
        """Return a keyframe with its marginal covariance; call after `solve`."""
        R, v, p, b_g, b_a, _ = self.keyframe(k)
        assert self._solution is not None  # solved
        joint = self._solution.covariances[k]
        to_world = KeyframeState(R, np.zeros(3), np.zeros(3), b_g, b_a).invariant_from_local()
        return NavState(self._time[k], R, v, p, b_g, b_a, to_world @ joint @ to_world.T)

    def marginalise(self, before: int) -> None:
        """Marginalise the keyframes before a given one, keeping their information on later ones.

        Raises:
            IndeterminateError: a marginalised state is not determined.
        """
        old = [k for k in self._time if k < before]
        if not old:
            return
        values = self._values()
        linear = self._imu_factors(before).linearize(values)
        connected = [before]
        for term in self._terms:
            if term.first < before:
                linear.push_back(term.factor(values))
                connected += [k for k in term.term.keyframes if k > before]
        ordering = self._ordering(old)
        try:
            _, remaining = linear.eliminatePartialMultifrontal(ordering, gtsam.EliminateQR)
        except RuntimeError as error:  # gtsam's way to report it
            raise IndeterminateError(self._undetermined_state(str(error))) from error
        self._terms = [term for term in self._terms if term.first >= before]
        self.add(self._marginal(range(before, max(connected) + 1), remaining), gated=False)
        for k in old:
            del self._time[k], self._states[k]
            self._segments.pop(k, None)
        self._solution = None

    def _values(self) -> Any:
        values = gtsam.Values()
        for k, state in self._states.items():
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
        reference = tuple(self.keyframe(k) for k in keyframes)
        to_local = [np.linalg.inv(state.invariant_from_local()) for state in reference]
        for k, state in zip(keyframes, reference, strict=True):
            # A window may reach only a pose: add the other columns, without information.
            nothing = state.blocks(k, np.zeros((1, 15 + (state.offset is not None))))
            remaining.push_back(linear_factor(nothing, np.zeros(1)))
        A, b = remaining.jacobian(self._ordering(keyframes))
        table = np.asarray(np.linalg.qr(np.column_stack([A, b]), mode="r"))[: A.shape[1]]
        return Prior(keyframes[0], reference, table[:, :-1] @ block_diag(*to_local), table[:, -1])

    def _insert(self, time: float, state: KeyframeState) -> None:
        self.last += 1
        self._time[self.last], self._states[self.last], self._solution = time, state, None

    def _optimised(self, max_rounds: int | None, trusted_rounds: int) -> Any:
        """Take full Gauss-Newton steps, which follow the IMU's stiff factors as a filter does.

        From a poor start, a correct step may increase their error by its second-order terms.
        Levenberg-Marquardt's damping is then slow, and a stream would output unconverged states.
        Where hardly anything tells the heading for a long time, full steps lead from one end of
        what is possible to the other, by more than half a turn: then small turns, one after the
        other, converge.
        """
        if max_rounds is not None:
            return self._after_steps(max_rounds, trusted_rounds)[0]
        for rounds, limits in (
            (_FULL_STEPS, (math.pi, None)),
            (_SMALL_TURNS, (math.inf, _MAX_TURN)),
        ):
            values, change = self._after_steps(rounds, trusted_rounds, *limits)
            if change < _NEARLY_CONVERGED:
                return values
        raise IndeterminateError("the optimisation does not converge")

    def _after_steps(
        self,
        rounds: int,
        trusted_rounds: int,
        no_turn: float = math.inf,
        max_turn: float | None = None,
    ) -> tuple[Any, float]:
        """Return the values after Gauss-Newton steps, and how far the last one moved any [m].

        Args:
            rounds: maximum number of steps.
            trusted_rounds: as for `solve`.
            no_turn: turn of a keyframe [rad] from which a step is not taken, which is given up.
            max_turn: turn to which steps are scaled [rad]; None takes them in full.
        """
        factors, values, ordering = self._imu_factors(), self._values(), self._ordering(self._time)
        change = math.inf
        for k in range(rounds):
            linear = factors.linearize(values)
            for term in self._terms:
                linear.push_back(term.factor(values, trusted=k < trusted_rounds))
            self._solution = LinearSolution(linear, ordering)
            step = self._solution.step()
            turn = max(float(np.linalg.norm(step.at(X(n))[:3])) for n in self._time)
            if turn > no_turn:
                return values, math.inf
            if max_turn is not None and turn > max_turn:
                step = self._scaled(step, max_turn / turn)
            before = self._positions(values)
            values = values.retract(step)
            change = float(np.abs(self._positions(values) - before).max())
            if not change > _CONVERGED:
                break
        if not np.isfinite(change):
            raise IndeterminateError("the optimisation diverged")
        return values, change

    def _scaled(self, step: Any, share: float) -> Any:
        """Return a part of a step of gtsam's."""
        part = gtsam.VectorValues()
        for k in self._time:
            for key in self._states[k].keys(k):
                part.insert(key, share * step.at(key))
        return part

    def _positions(self, values: Any) -> FloatArray:
        return np.array([values.atPose3(X(k)).translation() for k in self._time])

    def _ordering(self, keyframes: Iterable[int]) -> Any:
        """Return the keys in order of time: the graph's longest link is a window."""
        ordering = gtsam.Ordering()
        for k in keyframes:
            for key in self._states[k].keys(k):
                ordering.push_back(key)
        return ordering

    def _check_determined(self) -> None:
        for k in (next(iter(self._time)), self.last):
            covariance = self.state(k).covariance
            variance = covariance.diagonal()
            if not (variance < _UNDETERMINED_SIGMA**2).all():
                worst = int(np.argmax(np.where(np.isfinite(variance), variance, np.inf)))
                raise IndeterminateError(
                    f"{_GROUPS[worst // 3]} at {self._time[k]:.1f} s is undetermined"
                )
            try:
                check_covariance(covariance)
            except InputError as error:
                message = f"the covariance at {self._time[k]:.1f} s has no digits left"
                raise IndeterminateError(message) from error

    def _undetermined_state(self, message: str) -> str:
        """Return the name and time of the state that gtsam's message concerns."""
        match = re.search(r"Symbol: ([xvb])(\d+)", message)
        if match is None:
            return message.strip().splitlines()[0]
        return f"{_NAMES[match[1]]} at {self._time[int(match[2])]:.1f} s is undetermined"
