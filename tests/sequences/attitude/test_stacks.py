"""Products and interpolation of stacks of rotations are SciPy's."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from stario.sequences.attitude.stacks import composed, slerp


def same(found: Rotation, expected: Rotation) -> None:
    np.testing.assert_allclose(found.as_quat(), expected.as_quat(), rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("counts", [(50, 50), (50, None), (None, 50), (None, None), (0, 0)])
def test_products_are_scipys(counts: tuple[int | None, int | None]) -> None:
    p, q = (Rotation.random(count, rng=seed) for seed, count in enumerate(counts))
    same(composed(p, q), p * q)


@pytest.mark.parametrize("count", [0, 7, 1000])
def test_interpolated_rotations_are_scipys(count: int) -> None:
    """At fewer times than are known and at more, in any order, at the ends and at known times."""
    rng = np.random.default_rng(0)
    known = np.cumsum(rng.uniform(0.01, 0.1, 40))
    rotations = Rotation.random(40, rng=1)
    time = np.concatenate([rng.uniform(known[0], known[-1], count), known[[3, 0, -1]]])
    same(slerp(known, rotations, time), Slerp(known, rotations)(time))
