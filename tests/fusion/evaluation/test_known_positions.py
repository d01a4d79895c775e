"""The error at waypoints ignores a rotation and translation of the track, and nothing else."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.known_positions import placed, position_error, position_error_words
from stario.sequences import PositionTrack, Trajectory

TIME = np.linspace(0.0, 20.0, 201)
PATH = np.column_stack([TIME, np.sin(0.3 * TIME), 0.0 * TIME])


def track(path):
    trajectory = Trajectory(TIME, path, Rotation.identity(len(TIME)))
    return SimpleNamespace(time=TIME, trajectory=trajectory)


def waypoints(path, every=40, delay=0.0):
    return PositionTrack(TIME[::every] + delay, path[::every, :2], "waypoints")


def test_a_rotated_and_translated_track_has_no_error():
    rotated = Rotation.from_euler("z", 50.0, degrees=True).apply(PATH)
    rotated += np.array([7.0, -3.0, 1.0])
    assert position_error(track(rotated), waypoints(PATH)) == (pytest.approx(0.0, abs=1e-9), 6)


def test_a_track_ten_percent_too_long_has_a_tenth_of_its_spread_as_error():
    line = np.column_stack([TIME, 0.0 * TIME, 0.0 * TIME])
    error, _ = position_error(track(1.1 * line), waypoints(line))
    assert error == pytest.approx(0.1 * np.std(TIME[::40]))


def test_waypoints_outside_the_track_are_excluded():
    words = position_error_words(track(PATH), waypoints(PATH, delay=19.0))
    assert words == "1 of 6 waypoints lie within the track: too few to compare with"
    words = position_error_words(track(PATH), waypoints(PATH))
    assert words.startswith("6 of 6 waypoints lie within the track: 0.00 m rms")


def test_the_error_is_given_next_to_the_sigma_of_the_positions_used():
    valid, sigma = np.arange(6) > 2, np.where(np.arange(6) > 2, 3.0, 50.0)
    known = PositionTrack(TIME[::40], PATH[::40, :2], "positions", valid, sigma)
    words = position_error_words(track(PATH), known)
    assert words.startswith("3 of 3 positions lie within the track: 0.00 m rms")
    assert words.endswith("; their sigma is 3 m per axis")


def test_placed_positions_are_fitted_to_the_track_in_the_frame_of_the_track():
    rotated = Rotation.from_euler("z", 50.0, degrees=True).apply(PATH) + np.array([7.0, -3.0, 1.0])
    shown = placed(track(rotated), waypoints(PATH, delay=0.0))
    np.testing.assert_allclose(shown.position_W, rotated[::40, :2], atol=1e-9)
    assert placed(track(PATH), waypoints(PATH, delay=100.0)) is None


def test_positions_in_a_gap_of_the_track_are_excluded():
    known = np.r_[0:50, 150:201]
    broken = Trajectory(TIME[known], PATH[known], Rotation.identity(len(known)))
    gapped = SimpleNamespace(time=TIME[known], trajectory=broken)
    around = PositionTrack(TIME[::20], PATH[::20, :2], "waypoints")
    assert position_error(gapped, around) == (pytest.approx(0.0, abs=1e-9), 6)


def test_a_track_with_two_poses_per_second_has_no_gaps():
    """As that of detected steps, from which most positions were left out."""
    sparse = Trajectory(TIME[::5], PATH[::5], Rotation.identity(len(TIME[::5])))
    walked = SimpleNamespace(time=TIME[::5], trajectory=sparse)
    error, count = position_error(walked, waypoints(PATH, every=4))
    assert (count, error) == (51, pytest.approx(0.0, abs=0.02))


@pytest.mark.parametrize(("sigma", "jump"), [(8.0, 90.0), (8.0, 12.0), (30.0, 90.0)])
def test_jumps_far_beyond_the_stated_accuracy_are_named(sigma, jump):
    path = PATH[::10, :2] + np.outer(TIME[::10] >= 9.0, [jump, 0.0])
    known = PositionTrack(TIME[::10], path, "positions", sigma=np.full(len(path), sigma))
    words = position_error_words(track(PATH), known)
    assert f"their sigma is {sigma:.0f} m per axis" in words
    assert words.endswith("but jump by up to 91 m") == (jump > 4.3 * sigma)
