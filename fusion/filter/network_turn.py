"""By how much the network's displacements are turned, where fixes can tell it.

README.md, "Fixes". How somebody carries the device turns all that the network says of a stretch by
some degrees, alike for a minute or so. A filter that takes it for white noise soon claims to know
the direction better than it does, once fixes tell it. So from the first fix on that is taken in
with the direction known the turn is a Gauss-Markov state of its own. Without fixes nothing could
tell turn and yaw apart, and a track in a frame of its own gains nothing from it: there it is zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from stario.fusion.changed import changed
from stario.fusion.filter.ekf_state import EkfState, gauss_markov
from stario.fusion.filter.jacobians import CORE, plain_covariance
from stario.sequences.sequence import FloatArray

SECONDS = 60.0
"""After which a turn is forgotten."""


@dataclass(frozen=True, eq=False)
class TurnEstimate:
    """What a filter knows of the turn, for a graph that begins from its state.

    Attributes:
        turn: [rad].
        covariance: (16,) with the plain errors of the state (order of `NavState.covariance`), and
            its variance.
    """

    turn: float
    covariance: FloatArray


def turn_estimate(s: EkfState) -> TurnEstimate | None:
    """What a filter knows of it; None where no turn has begun."""
    if not s.has_turn:
        return None
    rows = [*range(CORE), s.turn_row]
    P = plain_covariance(s.P[rows][:, rows], s.X[0, :, 3:].T)
    return TurnEstimate(s.network_turn, P[CORE])


def with_turn(s: EkfState, sigma: float) -> EkfState:
    """The state with a turn of which no more is known than its deviation [rad]."""
    if s.has_turn or sigma == 0.0:
        return s
    P = s.P.copy()
    P[s.turn_row, s.turn_row] = sigma**2
    return changed(s, P=P)


def propagated_turn(s: EkfState, seconds: float, sigma: float) -> EkfState:
    """The state after a time [s]; as it is where no turn has begun."""
    if not s.has_turn:
        return s
    kept = math.exp(-seconds / SECONDS)
    P = gauss_markov(s.P, s.turn_row, kept, sigma)
    return changed(s, P=P, network_turn=kept * s.network_turn)
