"""Floors from heights: their distance, the way between them, and what is none."""

import numpy as np
import pytest

from stario.fusion.values.floors import FloorChange, floor_at, floor_changes

DRIFT = 0.3
"""Drift of the height over each track [m]."""


def found(*legs: tuple[float, float, float]) -> tuple[list[FloorChange], float]:
    """Return the changes of a track of legs of seconds, climb [m] and horizontal speed [m/s]."""
    ends = np.cumsum([(0.0, 0.0), *((seconds, climb) for seconds, climb, _ in legs)], axis=0)
    time = np.arange(0.0, ends[-1, 0], 0.1)
    height = np.interp(time, ends[:, 0], ends[:, 1]) + DRIFT * time / time[-1]
    speeds = np.array([speed for *_, speed in legs])
    return floor_changes(time, height, speeds[np.searchsorted(ends[1:-1, 0], time)])


@pytest.mark.parametrize("spacing", [2.7, 3.2, 4.0])
def test_stairs_and_a_lift_between_floors_of_any_distance(spacing):
    changes, distance = found(
        (30, 0, 1.2), (12, spacing, 0.5), (20, 0, 1.2), (15, -3 * spacing, 0.0), (20, 0, 1.0)
    )
    assert [(c.before, c.after, c.how) for c in changes] == [(0, 1, "stairs"), (1, -2, "lift")]
    assert distance == pytest.approx(spacing, abs=0.2)
    assert changes[0].start == pytest.approx(30.0, abs=2.5)
    assert changes[0].stop == pytest.approx(42.0, abs=2.5)
    assert [floor_at(changes, t) for t in (0.0, 36.0, 50.0, 95.0)] == [0, None, 1, -2]
    assert str(changes[1]).startswith("floor 1 to -2 by lift, 6")


def test_landings_are_no_floors():
    for rest in (3.0, 11.0):  # at once, and after a look out of the window
        changes, _ = found((30, 0, 1.2), (6, 1.5, 0.5), (rest, 0, 0.2), (6, 1.5, 0.5), (30, 0, 1.2))
        assert [(c.before, c.after) for c in changes] == [(0, 1)]


def test_a_level_walk_a_ramp_and_a_doorstep_are_one_floor():
    for legs in ([(300, 0.0, 1.2)], [(60, 2.0, 1.2)], [(30, 0, 1.2), (3, 0.6, 1.0), (30, 0, 1.2)]):
        assert found(*legs) == ([], 0.0)


def test_too_short_a_track_has_no_floors():
    assert found((2.0, 0.0, 1.0)) == ([], 0.0)
