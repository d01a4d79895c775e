"""The direction of a track from several positions together."""

import numpy as np
import pytest
from simulated import measured
from support import GRAPH as CONFIG

from stario.fusion import Navigator
from stario.fusion.evaluation.checks.fusion import true_fixes
from stario.fusion.filter.planar_alignment import PlanarAlignment
from stario.sequences.accuracy.metrics import pose_errors


def test_positions_too_close_to_give_a_direction_alone_give_it_together():
    walk, _, oracle = measured(8, 60.0, CONFIG, noise=0.02)
    farthest = np.linalg.norm(walk.truth.position_W[:, :2] - walk.truth.position_W[0, :2], axis=1)
    sigma = 0.4 * float(farthest.max())
    fixes = true_fixes(walk.truth, 1.0, sigma, seed=3)
    track = Navigator(oracle, CONFIG).run(walk, fixes=fixes)
    counts = track.filtered.health.fixes
    assert counts["yaw not known"] > 3
    assert counts["applied"] > 10
    yaw = pose_errors(track.trajectory, walk.truth).yaw[-1]
    assert abs(yaw) < 3.0 * np.sqrt(track.covariance[-1, 2, 2])


# --- the alignment -------------------------------------------------------------------------------


def alignment_of(
    rng: np.random.Generator, turn: float, count: int, sigma: float
) -> PlanarAlignment:
    """Alignment of a walk in a room, with independent noise in every fix."""
    z = rng.uniform(-2.0, 2.0, count) + 1j * rng.uniform(-2.0, 2.0, count)
    noise = rng.normal(0.0, sigma, count) + 1j * rng.normal(0.0, sigma, count)
    fixed = np.exp(1j * turn) * z + (3.0 - 1.0j) + noise
    positions = PlanarAlignment()
    for a, b in zip(z, fixed, strict=True):
        pair = np.array([a.real, a.imag]), np.array([b.real, b.imag])
        positions = positions.with_position(*pair, sigma**2, 0.0)
    return positions


@pytest.mark.parametrize("count", [5, 20])
def test_the_sigma_of_the_fitted_turn_is_consistent(count):
    rng, errors = np.random.default_rng(0), []
    for turn in rng.uniform(-np.pi, np.pi, 400):
        found, sigma = alignment_of(rng, turn, count, 0.3).turn
        errors.append(np.angle(np.exp(1j * (found - turn))) / sigma)
    assert 0.8 < np.mean(np.square(errors)) < 1.3


def test_fewer_than_two_places_give_no_direction():
    assert PlanarAlignment().turn[1] == np.inf
    here = PlanarAlignment()
    for fix in np.random.default_rng(1).normal(0.0, 1.0, (50, 2)):
        here = here.with_position(np.zeros(2), fix, 1.0, 0.0)
    assert here.turn[1] > 10.0


def test_positions_count_for_less_once_the_track_has_drifted():
    steady = alignment_of(np.random.default_rng(2), 0.5, 8, 0.3)
    last = np.array([1.0, 1.0]), np.array([2.0, 2.0])
    kept, drifted = (steady.with_position(*last, 0.09, drift) for drift in (0.0, 5.0))
    assert drifted.turn[1] > 2.0 * kept.turn[1]
    # The eight before it now have the drift's variance as well.
    assert drifted.sums[0] == pytest.approx(8.0 / (0.09 + 5.0) + 1.0 / 0.09)
