import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stario.sequences import Trajectory
from stario.sequences.arrays import even_grid
from stario.sequences.clean_samples import in_order
from stario.sequences.inspection.samples import without_times_ahead
from stario.sequences.sequence import FloatArray, ImuSequence
from stario.sequences.time_order import CONFIRMED_FAR, increasing_mask
from stario.sequences.truth.positions import fit_positions

TIME = np.arange(400) / 100.0


def moved(rows: slice, by: float) -> FloatArray:
    time = TIME.copy()
    time[rows] += by
    return time


def dropped_rows(time: FloatArray) -> list[int]:
    kept = increasing_mask(time)
    assert (np.diff(time[kept]) > 0.0).all()
    return np.flatnonzero(~kept).tolist()


def test_increasing_times_are_all_kept_whatever_the_gaps_and_late_times():
    gaps = np.concatenate([TIME[:100], 5.0 + TIME[:1], 1e9 + TIME])
    assert dropped_rows(TIME) == dropped_rows(gaps) == []
    assert increasing_mask(np.empty(0)).tolist() == []
    time = np.concatenate([TIME[:100], TIME[200:201], TIME[50:60], TIME[201:]])
    assert dropped_rows(time) == list(range(101, 111))
    repeated = np.concatenate([TIME[:100], TIME[200:201], TIME[50:60], TIME[200:]])
    assert dropped_rows(repeated) == list(range(101, 112))
    swapped = np.concatenate([TIME[:101], [0.5, 1.02, 1.01], TIME[103:]])
    assert dropped_rows(swapped) == [101, 103]


@pytest.mark.parametrize("by", [0.3, 5.0, 100.0, 1e9])
@pytest.mark.parametrize("row", [0, 1, 200, 398])
def test_one_outlying_time_drops_only_its_own_sample(row, by):
    assert dropped_rows(moved(slice(row, row + 1), by)) == [row]


def test_times_from_the_far_future_are_dropped_until_they_confirm_a_jump():
    last = 100 + CONFIRMED_FAR - 1
    assert dropped_rows(moved(slice(100, last), 1e6)) == list(range(100, last))
    time = moved(slice(100, 102), 1e6)
    time[101] += 1e3
    time[200] -= 3.0
    assert dropped_rows(time) == [100, 101, 200]
    assert dropped_rows(moved(slice(100, 102), 0.3)) == list(range(102, 132))
    assert dropped_rows(moved(slice(100, 100 + CONFIRMED_FAR), 1e6)) == list(range(120, 400))


def test_rows_far_out_of_order_are_neither_sorted_nor_thinned_out():
    """They are refused as they are, with how many there are."""
    time = np.random.default_rng(0).permutation(TIME)
    shuffled = ImuSequence("shuffled", time, np.zeros((400, 3)), np.ones((400, 3)))
    assert in_order(shuffled) is shuffled
    assert without_times_ahead(shuffled) is shuffled


STEPS = st.sampled_from([1.0 / 200.0, 0.05, 0.1, 0.15, 1.0 / 30.0])


@given(start=st.floats(0.0, 1e4), steps=st.integers(0, 5000), step=STEPS)
def test_no_time_is_at_or_beyond_the_end(start, steps, step):
    """Rounding decides whether a whole number of steps reaches the end."""
    stop = start + steps * step
    grid = even_grid(start, stop, step)
    assert (grid < stop).all()
    assert abs(len(grid) - steps) <= 1
    assert np.allclose(np.diff(grid), step, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("first", range(2, 14))
def test_positions_are_compared_whenever_a_recording_begins(first):
    """The last instant is compared with what is 0.3 s later: rounding may place that at the end."""
    time = (first + np.arange(1411)) / 50.0
    rest = np.zeros((len(time), 3))
    truth = Trajectory(time, rest, Rotation.identity(len(time)))
    still = ImuSequence("still", time, rest, rest + np.array([0.0, 0.0, 9.81]), truth=truth)
    assert fit_positions(still, 0.0) is None
