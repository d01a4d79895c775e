import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import even_grid
from stario.sequences.attitude.rotations import about_z, tilt_aligning, yaw_of
from stario.sequences.clean_samples import in_order
from stario.sequences.geodesy import Georeference, east_north
from stario.sequences.inspection.samples import without_times_ahead
from stario.sequences.sequence import (
    FloatArray,
    ImuSequence,
    PositionTrack,
    Trajectory,
    low_rate_message,
    whole_seconds,
)
from stario.sequences.time_order import CONFIRMED_FAR, increasing_mask
from stario.sequences.truth.positions import fit_positions


def screw(time: FloatArray) -> Trajectory:
    """Constant velocity and constant body rate: linear interpolation and slerp are exact."""
    position = np.outer(time, [1.0, -2.0, 0.5])
    spin = Rotation.from_rotvec(np.outer(time, [0.3, 0.4, -0.5]))
    covariance = np.outer(1.0 + time, np.eye(3)).reshape(-1, 3, 3)
    velocity = np.tile([1.0, -2.0, 0.5], (len(time), 1))
    return Trajectory(time, position, spin, velocity, covariance)


def marked(track: Trajectory, lost: slice) -> Trajectory:
    """The track with rows `lost` marked invalid and their positions set to NaN."""
    valid = np.ones(len(track), dtype=np.bool_)
    valid[lost] = False
    position = np.where(valid[:, None], track.position_W, np.nan)
    return Trajectory(track.time, position, track.attitude_WB, valid=valid)


GRID = np.arange(101) / 50.0


def test_interpolation_follows_a_screw_motion_exactly():
    time = np.sort(np.random.default_rng(0).uniform(0.0, 2.0, 300))
    read, true = screw(GRID).at(time), screw(time)
    assert read.valid.all()
    assert np.abs(read.position_W - true.position_W).max() < 1e-10
    assert (read.attitude_WB.inv() * true.attitude_WB).magnitude().max() < 1e-7
    assert np.allclose(read.velocity_W, [1.0, -2.0, 0.5])
    assert np.allclose(read.position_covariance_W, np.einsum("n,ij->nij", 1 + time, np.eye(3)))
    outside = screw(GRID).at(np.array([-0.01, 0.0, 2.0, 2.01]))
    assert outside.valid.tolist() == [False, True, True, False]


@pytest.mark.parametrize("missing", [False, True], ids=["marked", "missing"])
def test_interpolation_never_crosses_a_gap(missing):
    """Rows 40 to 54 are lost: 0.8 to 1.08 s; both neighbours (0.78 and 1.1 s) stay valid."""
    kept = np.delete(np.arange(len(GRID)), np.arange(40, 55))
    track = screw(GRID[kept]) if missing else marked(screw(GRID), slice(40, 55))
    time = np.array([0.77, 0.78, 0.781, 0.9, 1.099, 1.1, 1.11])
    read = track.at(time)
    assert read.valid.tolist() == [True, True, False, False, False, True, True]
    assert np.isfinite(read.position_W).all()
    bridged = marked(screw(GRID), slice(40, 43)).at(GRID)
    assert bridged.valid.all()
    assert np.allclose(bridged.position_W, screw(GRID).position_W)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_truth_at_the_lowest_rate_has_no_gaps_despite_rounding(start):
    """0.3 - 0.2 > 0.1 in floating point."""
    track = screw(start + np.round(np.arange(201) * 0.1, 1))
    assert track.covers(start + np.linspace(0.05, 19.95, 400)).all()
    assert not low_rate_message(track)
    assert "at 5 Hz; at least 10 Hz are needed" in low_rate_message(screw(track.time[::2]))


def test_gaps_are_not_bridged_at_times_since_1970():
    """A relative tolerance of 1e-9 is 1.7 s at such times."""
    kept = np.delete(1.7e9 + GRID, np.arange(40, 55))
    outside = 1.7e9 + np.array([-0.5, 0.9, 2.5])
    assert not screw(kept).covers(outside).any()
    assert screw(kept).covers(kept).all()


def test_path_length_is_hardly_affected_by_noise():
    time = np.arange(1001) / 100.0
    circle = np.stack([np.cos(0.5 * time), np.sin(0.5 * time), 0 * time], axis=1)
    rest = Rotation.identity(len(time))
    assert Trajectory(time, circle, rest).path_length() == pytest.approx(5.0, rel=0.02)
    noisy = circle + 0.01 * np.random.default_rng(0).standard_normal(circle.shape)
    assert Trajectory(time, noisy, rest).path_length() == pytest.approx(5.0, rel=0.03)
    assert marked(Trajectory(time, circle, rest), slice(1, None)).path_length() == 0.0


def test_bad_samples_are_kept_and_masked_ones_are_missing():
    """Dropping and counting bad samples is left to the navigator."""
    time, zeros = np.array([0.0, 0.01, 0.01, np.nan]), np.zeros((4, 3))
    sequence = ImuSequence("odd", time, np.nan * zeros, zeros)
    assert len(sequence) == 4
    assert sequence.rate == pytest.approx(100.0)
    assert sequence.duration == pytest.approx(0.01)
    gyro = np.ma.masked_equal(np.where(np.eye(3) > 0, -9999.0, 0.5), -9999.0)
    sequence = ImuSequence("masked", np.arange(3.0), gyro, np.zeros((3, 3)))
    np.testing.assert_array_equal(np.isnan(sequence.gyro), np.eye(3) > 0)
    assert np.nanmax(sequence.gyro) == 0.5


def test_recordings_and_trajectories_print_in_one_line():
    track = screw(GRID)
    assert repr(track) == "Trajectory(101 rows, 0.00 to 2.00 s at 50.0 Hz)"
    walk = ImuSequence("walk", GRID, np.zeros((101, 3)), np.zeros((101, 3)), track)
    text = "101 samples of walk: 2.0 s at 50.0 Hz, no magnetometer, truth: 101 poses"
    assert repr(walk) == f"ImuSequence({text})"
    assert repr(track.slice(0.0, 0.0)) == "Trajectory(1 rows, 0.00 to 0.00 s)"


def test_a_wild_time_changes_neither_duration_nor_rate_nor_exhausts_memory():
    time, zero = np.arange(1001) / 100.0, np.zeros((1001, 3))
    time[500] += 1e9
    sequence = ImuSequence("wild", time, zero, zero)
    assert sequence.duration == pytest.approx(10.0)
    assert sequence.rate == pytest.approx(100.0)
    time = np.concatenate([[0.0], 1.7e9 + np.arange(1001) / 100.0])
    position = np.outer(np.append(0.0, np.arange(1001) / 100.0), [1.0, 0.0, 0.0])
    track = Trajectory(time, position, Rotation.identity(len(time)))
    assert track.path_length() == pytest.approx(10.0)
    assert len(whole_seconds(time)) < 20


def test_parts_have_the_truth_of_their_time_and_without_truth_none_is_left():
    zeros = np.zeros((len(GRID), 3))
    sequence = ImuSequence("cut", GRID, zeros, zeros, screw(GRID))
    part = sequence.slice(0.5, 1.0)
    assert np.array_equal(part.time, part.truth.time)
    assert part.time[[0, -1]].tolist() == [0.5, 1.0]
    assert part.duration == 0.5
    early = ImuSequence("cut", GRID, zeros, zeros, screw(GRID).slice(0.0, 0.2))
    assert early.slice(0.5, 1.0).truth is None
    zero = np.zeros((101, 3))
    known = PositionTrack(GRID, zero, "positions")
    sequence = ImuSequence("both", GRID, zero, zero, screw(GRID), positions=known)
    bare = sequence.without_truth()
    assert bare.truth is bare.positions is None


def test_rotating_the_world_adds_to_the_yaw_and_tilt_aligning_rotates_up_to_z():
    attitudes = Rotation.random(200, rng=np.random.default_rng(1))
    for yaw in (-2.0, 0.3, 3.0):
        turned = yaw_of(about_z(yaw) * attitudes)
        assert np.allclose(np.exp(1j * (turned - yaw_of(attitudes) - yaw)), 1.0, atol=1e-9)
        assert (np.abs(turned) <= np.pi).all()
    rng = np.random.default_rng(2)
    for up in rng.standard_normal((100, 3)):
        R_WB = tilt_aligning(9.8 * up)
        assert np.allclose(R_WB.apply(up / np.linalg.norm(up)), [0.0, 0.0, 1.0])
        angle = np.arccos(up[2] / np.linalg.norm(up))
        assert R_WB.magnitude() == pytest.approx(angle, abs=1e-7)
        assert yaw_of(R_WB)[0] == pytest.approx(0.0, abs=1e-9)
    for up in ([0.0, 0.0, 2.0], [0.0, 0.0, -2.0], [1e-9, 0.0, -1.0]):
        assert np.allclose(tilt_aligning(np.array(up)).apply(up)[2], np.linalg.norm(up))


# --- maps on the earth ----------------------------------------------------------------------------


def test_a_degree_has_its_length_and_yaw_turns_counter_clockwise_from_east():
    at_equator = east_north(np.array([[0.0, 7.0], [0.01, 7.0], [0.0, 7.01]]))[1:]
    np.testing.assert_allclose(at_equator, [[0.0, 1105.743], [1113.195, 0.0]], atol=0.01)
    north = Georeference(48.0, 11.0, np.radians(90.0)).latlon_deg(np.array([[100.0, 0.0]]))[0]
    assert north[0] > 48.0005
    assert north[1] == pytest.approx(11.0, abs=1e-9)


@pytest.mark.parametrize("latitude", [-78.0, 0.0, 48.1, 69.9])
@pytest.mark.parametrize("yaw", [0.0, 2.1])
def test_positions_come_back_from_latitude_and_longitude(latitude, yaw):
    xy = np.array([[0.0, 0.0], [1500.0, -300.0], [-20.0, 900.0]])
    place = Georeference(latitude, 179.999, yaw)
    latlon = place.latlon_deg(np.column_stack([xy, [0.0, 12.0, -3.0]]))
    assert (np.abs(latlon[:, 1]) <= 180.0).all()
    np.testing.assert_allclose(place.xy(latlon), xy, atol=1e-3)
    np.testing.assert_allclose(place.xy(latlon[1]), xy[1:2], atol=1e-3)


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
