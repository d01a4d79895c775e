"""Marginal covariances from the triangular system against those of the dense inverse."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, T, V, X

from stario.fusion.graph.covariances import marginal_covariances
from stario.fusion.graph.term import linear_factor

WIDTHS = (6, 3, 6, 1)


def system(
    keyframes: int, height_sigma: float, closed: bool
) -> tuple[list[int], np.ndarray, object]:
    """Return keys, dense Jacobian and factors of keyframes, each linked to the next two.

    If closed, the last one is linked to the first.

    The last axis of each pose is that much less certain than the others.
    """
    rng = np.random.default_rng(3)
    keys = [(X(k), V(k), B(k), T(k)) for k in range(keyframes)]
    graph, rows = gtsam.GaussianFactorGraph(), []
    for k in range(keyframes):
        linked = list(range(k, min(k + 3, keyframes)))
        linked += [0] if closed and k == keyframes - 1 else []
        blocks, row = [], np.zeros((20, 16 * keyframes))
        for j in linked:
            H = rng.normal(size=(20, 16))
            H[:, 5] /= height_sigma
            row[:, 16 * j : 16 * j + 16] = H
            blocks += list(zip(keys[j], np.split(H, np.cumsum(WIDTHS)[:3], axis=1), strict=True))
        graph.push_back(linear_factor(blocks, np.zeros(20)))
        rows.append(row)
    return [key for group in keys for key in group], np.vstack(rows), graph


@pytest.mark.parametrize("closed", [False, True])
@pytest.mark.parametrize("height_sigma", [1.0, 1e6])
def test_covariances_are_blocks_of_the_dense_inverse(height_sigma, closed):
    keys, J, graph = system(7, height_sigma, closed)
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    covariances = marginal_covariances(graph.eliminateSequential(ordering, gtsam.EliminateQR))
    scale = np.tile([*[1.0] * 5, height_sigma, *[1.0] * 10], 7)
    dense = np.linalg.inv((J * scale).T @ (J * scale))
    assert sorted(covariances) == list(range(7))
    for k, covariance in covariances.items():
        rows = slice(16 * k, 16 * k + 15)
        found = covariance / np.outer(scale[rows], scale[rows])
        np.testing.assert_allclose(found, dense[rows, rows], rtol=1e-6, atol=1e-9)
