"""Yaw error (turn) of the network's displacements, estimated once fixes make it observable.

README.md, "Fixes". How the device is carried turns all displacements that the network predicts by
some degrees, and by a similar angle for about a minute. A filter that treats this as white noise
becomes overconfident in the direction once fixes determine it. From the first fix that is applied
with the direction known, the turn is therefore a Gauss-Markov state of its own. Without fixes, turn
and yaw cannot be distinguished, and a track in its own frame gains nothing: there the turn is zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stario.fusion.filter.ekf_state import EkfState, gauss_markov
from stario.fusion.filter.jacobians import CORE, plain_covariance
from stario.fusion.state import changed
from stario.sequences.sequence import FloatArray

CORRELATION_SECONDS = 60.0
"""Correlation time of the turn [s]."""


@dataclass(frozen=True, eq=False)
class TurnEstimate:
    """A filter's estimate of the turn, for a graph that starts from its state.

    Attributes:
        turn: the network's turn [rad].
        covariance: (16,) covariance with the plain errors of the state (order of
            `NavState.covariance`), then the turn's variance.
    """

    turn: float
    covariance: FloatArray


def turn_estimate(s: EkfState) -> TurnEstimate | None:
    """Return a filter's estimate of the turn; None while it is not estimated."""
    if not s.has_turn:
        return None
    rows = [*range(CORE), s.turn_row]
    P = plain_covariance(s.P[rows][:, rows], s.X[0, :, 3:].T)
    return TurnEstimate(s.network_turn, P[CORE])


def with_turn(s: EkfState, sigma: float) -> EkfState:
    """Return the state with its turn estimated from now on, with prior sigma [rad]."""
    if s.has_turn or sigma == 0.0:
        return s
    P = s.P.copy()
    P[s.turn_row, s.turn_row] = sigma**2
    return changed(s, P=P)


def propagated_turn(s: EkfState, seconds: float, sigma: float) -> EkfState:
    """Return the state with its turn propagated over a time [s]; unchanged if it has none."""
    if not s.has_turn:
        return s
    correlation = math.exp(-seconds / CORRELATION_SECONDS)
    P = gauss_markov(s.P, s.turn_row, correlation, sigma)
    return changed(s, P=P, network_turn=correlation * s.network_turn)
