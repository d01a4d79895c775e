"""Covariances of a graph: a prior's information, marginal ones, and what they are in truth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from stario.fusion.filter.estimates import Estimate, plain_covariances
from stario.fusion.filter.jacobians import GAIN, REPORTED, symmetric
from stario.fusion.values.state import NavState, changed
from stario.sequences.sequence import FloatArray

_KEYS = 3
"""Number of successive variables of which the covariance is wanted: pose, velocity, biases."""

_MIN_VARIANCE, _MIN_EIGENVALUE = 1e-16, 1e-12
"""Lower bounds of variances and of the eigenvalues of normalised covariances: less is rounding."""


def marginal_covariances(net: Any) -> Iterator[tuple[int, FloatArray]]:
    """Yield every keyframe and its covariance (15, 15) of pose, velocity and biases, last first.

    Its tangent is gtsam's. gtsam's own marginals use Cholesky's algorithm, which calls a pose
    undetermined if its last axis is 4096 times as uncertain as the one before, as with positions
    good to 5 cm and an unknown height. Variable x of the system R x + S y = d + n, with unit white
    noise n and later variables y of covariance P, has the covariance R^-1 (I + S P S^T) R^-T, and
    -R^-1 S P with y. So one pass back in time suffices, which keeps the rows of P that earlier
    variables need.

    Args:
        net: gtsam's Bayes net by QR, with one conditional per variable in order of time; those of a
            keyframe k are X(k), V(k), B(k) and perhaps more.

    Raises:
        RuntimeError: a variable is not determined; names it as gtsam does.
    """
    conditionals = [net.at(n) for n in range(net.size())]
    place = {c.keys()[0]: n for n, c in enumerate(conditionals)}
    parents = [[place[key] for key in c.keys()[1:]] for c in conditionals]
    begin = np.cumsum([0, *(len(c.R()) for c in conditionals)])
    variable = np.repeat(np.arange(len(parents)), np.diff(begin))  # by row
    # The earliest variable that needs the covariance of each one.
    first_use = np.arange(len(parents)) - _KEYS
    for n, p in enumerate(parents):
        first_use[p] = np.minimum(first_use[p], n)
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
            yield symbol.index(), P[:size, :size]
        kept = first_use[variable[held]] < n
        if not kept.all():
            P, held = P[np.ix_(kept, kept)], held[kept]


def root_information(covariance: FloatArray) -> FloatArray:
    """Return a square root (n, n) of a covariance's inverse, r with r^T r = P^-1."""
    sigma = np.sqrt(np.maximum(covariance.diagonal(), _MIN_VARIANCE))
    roots, axes = _semi_axes(covariance / np.outer(sigma, sigma))
    return np.asarray((axes / roots).T / sigma)


def with_reported_covariances(
    states: Sequence[NavState], estimates: Sequence[Estimate], turns: FloatArray | None = None
) -> list[NavState]:
    """Return a graph's states, whose measurements are the filter's, with covariances as they are.

    The graph assumes white errors of the network, as the filter's gains do. What the errors'
    correlation makes of the filter's covariance P, a linear map T with T P T^T = Q makes of the
    graph's. T is the symmetric one, which is closest to the identity (in units of P's sigmas):

        T = P^-1/2 (P^1/2 Q P^1/2)^1/2 P^-1/2

    Args:
        states: N states of the graph, with the covariances that it assumes.
        estimates: N estimates of the filter at the same times.
        turns: (N, 15, 15) rotations from the filter's frame to that of the states; None if they are
            the same.
    """
    P, Q = (plain_covariances(estimates, which) for which in (GAIN, REPORTED))
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    scale = sigma[:, :, None] * sigma[:, None, :]
    root, inverse_root = _roots(P / scale)
    T = inverse_root @ _roots(root @ (Q / scale) @ root)[0] @ inverse_root
    T = sigma[:, :, None] * T / sigma[:, None, :]
    if turns is not None:
        T = turns @ T @ np.swapaxes(turns, 1, 2)
    covariance = np.array([state.covariance for state in states])
    covariance = symmetric(T @ covariance @ T.transpose(0, 2, 1))
    return [changed(s, covariance=c) for s, c in zip(states, covariance, strict=True)]


def _roots(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the symmetric square roots (N, n, n) of covariances and of their inverses."""
    roots, axes = _semi_axes(P)
    transposed = axes.transpose(0, 2, 1)
    return (axes * roots) @ transposed, (axes / roots) @ transposed


def _semi_axes(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the semi-axes (..., 1, n) of normalised covariances, and their directions."""
    values, axes = np.linalg.eigh(P)
    return np.sqrt(np.maximum(values, _MIN_EIGENVALUE))[..., None, :], axes
