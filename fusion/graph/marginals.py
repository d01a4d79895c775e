"""The solution of a linear graph, and marginal covariances from the triangular system of QR.

gtsam's own marginals use Cholesky's algorithm, which calls a pose undetermined if its last axis is
4096 times as uncertain as the one before, as with positions good to 5 cm and an unknown height.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from stario.fusion.filter.jacobians import symmetric
from stario.sequences.sequence import FloatArray

_KEYS = 3
"""Number of successive variables of which the covariance is wanted: pose, velocity, biases."""


class LinearSolution:
    """Solution of a linear graph by QR.

    Args:
        linear: gtsam's Gaussian factors.
        ordering: their keys in order of time; those of a keyframe k are X(k), V(k), B(k) and
            perhaps more.
    """

    def __init__(self, linear: Any, ordering: Any) -> None:
        self._net = linear.eliminateSequential(ordering, gtsam.EliminateQR)

    def step(self) -> Any:
        """Return the solution as gtsam's vector values."""
        return self._net.optimize()

    @cached_property
    def covariances(self) -> dict[int, FloatArray]:
        """Covariance (15, 15) of every keyframe's pose, velocity and biases.

        Raises:
            RuntimeError: they are not determined.
        """
        return marginal_covariances(self._net)


def marginal_covariances(net: Any) -> dict[int, FloatArray]:
    """Return the covariance (15, 15) of pose, velocity and biases of every keyframe.

    Its tangent is gtsam's. Variable x of the system R x + S y = d + n, with unit white noise n and
    later variables y of covariance P, has the covariance R^-1 (I + S P S^T) R^-T, and -R^-1 S P
    with y. So one pass back in time suffices, which keeps the rows of P that earlier variables
    need.

    Args:
        net: gtsam's Bayes net, with one conditional per variable, in order of time.

    Raises:
        RuntimeError: a variable is not determined; names it as gtsam does.
    """
    conditionals = [net.at(n) for n in range(net.size())]
    place = {c.keys()[0]: n for n, c in enumerate(conditionals)}
    parents = [[place[key] for key in c.keys()[1:]] for c in conditionals]
    widths = [len(c.R()) for c in conditionals]
    begin = np.cumsum([0, *widths])
    variable = np.repeat(np.arange(len(widths)), widths)  # by row
    # The earliest variable that needs the covariance of each one.
    first_use = np.arange(len(parents)) - _KEYS
    for n, p in enumerate(parents):
        first_use[p] = np.minimum(first_use[p], n)
    covariances = {}
    held = np.zeros(0, dtype=np.intp)  # rows of the variables that P covers, in order of time
    P = np.zeros((0, 0))
    for n in reversed(range(len(conditionals))):
        c, rows = conditionals[n], np.arange(begin[n], begin[n + 1])
        S = np.zeros((len(rows), len(P)))
        if parents[n]:
            needed = np.concatenate([np.arange(begin[m], begin[m + 1]) for m in parents[n]])
            S[:, np.searchsorted(held, needed)] = c.S()
        symbol = gtsam.Symbol(c.keys()[0])
        try:
            root = solve_triangular(c.R(), np.column_stack([np.eye(len(S)), S]))
        except np.linalg.LinAlgError as error:
            raise RuntimeError(f"Symbol: {chr(symbol.chr())}{symbol.index()}") from error
        by_noise, by_later = root[:, : len(S)], -root[:, len(S) :]
        cross = by_later @ P
        own = symmetric(by_noise @ by_noise.T + cross @ by_later.T)
        P, held = np.block([[own, cross], [cross.T, P]]), np.concatenate([rows, held])
        if chr(symbol.chr()) == "x":
            size = begin[n + _KEYS] - begin[n]
            covariances[symbol.index()] = P[:size, :size]
        kept = first_use[variable[held]] < n
        if not kept.all():
            P, held = P[np.ix_(kept, kept)], held[kept]
    return covariances
