"""Even grids end before the data do, at whatever times the data begin and end."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stario.sequences import ImuSequence, Trajectory
from stario.sequences.arrays import even_grid
from stario.sequences.truth.positions import fit_positions

STEPS = st.sampled_from([1.0 / 200.0, 0.05, 0.1, 0.15, 1.0 / 30.0])


@given(start=st.floats(0.0, 1e4), steps=st.integers(0, 5000), step=STEPS)
def test_no_time_is_at_or_beyond_the_end(start: float, steps: int, step: float) -> None:
    """Rounding decides whether a whole number of steps reaches the end."""
    stop = start + steps * step
    grid = even_grid(start, stop, step)
    assert (grid < stop).all()
    assert abs(len(grid) - steps) <= 1
    assert np.allclose(np.diff(grid), step, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("first", range(2, 14))
def test_positions_are_compared_whenever_a_recording_begins(first: int) -> None:
    """The last instant is compared with what is 0.3 s later: rounding may place that at the end."""
    time = (first + np.arange(1411)) / 50.0
    rest = np.zeros((len(time), 3))
    truth = Trajectory(time, rest, Rotation.identity(len(time)))
    still = ImuSequence("still", time, rest, rest + np.array([0.0, 0.0, 9.81]), truth=truth)
    assert fit_positions(still, 0.0) is None
