import re
import warnings
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from recorded import CASES
from scipy.spatial.transform import Rotation
from support import CONFIG

from stario.fusion import Navigator
from stario.fusion.evaluation.known_positions import (
    length_ratio,
    placed,
    position_error,
    position_error_words,
    position_findings,
    recording_verdict,
)
from stario.network import load_model
from stario.sequences import Finding, PositionTrack, Trajectory, read_recording

TIME = np.linspace(0.0, 20.0, 201)
PATH = np.column_stack([TIME, np.sin(0.3 * TIME), 0.0 * TIME])


def track(path):
    trajectory = Trajectory(TIME, path, Rotation.identity(len(TIME)))
    return SimpleNamespace(time=TIME, trajectory=trajectory)


def waypoints(path, every=40, delay=0.0):
    return PositionTrack(TIME[::every] + delay, path[::every, :2], "waypoints")


def test_a_rotated_and_translated_track_has_no_error_and_positions_are_placed_on_it():
    rotated = Rotation.from_euler("z", 50.0, degrees=True).apply(PATH) + np.array([7.0, -3.0, 1.0])
    found = position_error(track(rotated), waypoints(PATH))
    assert found == (pytest.approx(0.0, abs=1e-9), 6)
    shown = placed(track(rotated), waypoints(PATH))
    np.testing.assert_allclose(shown.position_W, rotated[::40, :2], atol=1e-9)
    assert placed(track(PATH), waypoints(PATH, delay=100.0)) is None


def test_a_track_ten_percent_too_long_has_a_tenth_of_its_spread_as_error():
    line = np.column_stack([TIME, 0.0 * TIME, 0.0 * TIME])
    error, _ = position_error(track(1.1 * line), waypoints(line))
    assert error == pytest.approx(0.1 * np.std(TIME[::40]))


def test_waypoints_outside_the_track_are_excluded():
    known = (waypoints(PATH, delay=delay) for delay in (19.0, 0.0))
    few, all_of_them = (position_error_words(track(PATH), each) for each in known)
    assert few.startswith("1 of 6 waypoints")
    assert "too few" in few
    assert re.match(r"6 of 6 waypoints.* 0\.00 m rms", all_of_them)


def test_the_error_is_given_next_to_the_sigma_of_the_positions_used():
    valid, sigma = np.arange(6) > 2, np.where(np.arange(6) > 2, 3.0, 50.0)
    known = PositionTrack(TIME[::40], PATH[::40, :2], "positions", valid, sigma)
    words = position_error_words(track(PATH), known)
    assert re.match(r"3 of 3 positions.* 0\.00 m rms.* sigma is 3 m", words)


@pytest.mark.parametrize(
    ("rows", "every", "count", "atol"),
    [
        (np.r_[0:50, 150:201], 20, 6, 1e-9),  # positions in a gap are excluded
        (np.r_[0:201:5], 4, 51, 0.02),  # two poses a second, as of detected steps, are no gaps
    ],
)
def test_positions_are_compared_between_poses_but_not_in_gaps(rows, every, count, atol):
    trajectory = Trajectory(TIME[rows], PATH[rows], Rotation.identity(len(rows)))
    broken = SimpleNamespace(time=TIME[rows], trajectory=trajectory)
    found = position_error(broken, waypoints(PATH, every))
    assert found == (pytest.approx(0.0, abs=atol), count)


@pytest.mark.parametrize(("sigma", "jump"), [(8.0, 90.0), (8.0, 12.0), (30.0, 90.0)])
def test_jumps_far_beyond_the_stated_accuracy_are_named(sigma, jump):
    path = PATH[::10, :2] + np.outer(TIME[::10] >= 9.0, [jump, 0.0])
    known = PositionTrack(TIME[::10], path, "positions", sigma=np.full(len(path), sigma))
    words = position_error_words(track(PATH), known)
    assert f"sigma is {sigma:.0f} m" in words
    assert words.endswith("jump by up to 91 m") == (jump > 4.3 * sigma)


@cache
def case(name: str) -> dict[str, Finding]:
    path = CASES / name
    if not path.exists():
        pytest.skip(f"{path} is missing")
    sequence = read_recording(path).slice(0.0, 60.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        track = Navigator(load_model("default")).run(sequence)
        return {found.code: found for found in recording_verdict(sequence, track, train="train")}


@pytest.mark.slow
def test_positions_that_say_the_way_is_longer_are_told_with_the_factor():
    """A real walk with an instrument in the hand; nothing but its positions can tell."""
    found = case("handheld_walk_too_short/walk.csv")
    assert found["track_scale"].values["scale"] == pytest.approx(1.9, abs=0.3)
    assert "nothing" not in found
    assert "train" not in found  # positions without attitude cannot teach the weights


@pytest.mark.slow
def test_positions_that_fit_the_mirror_image_name_the_accelerometers_sign():
    found = case("sign_flipped_with_positions/walk.csv")["mirror_image"]
    assert found.values["error_m"] == pytest.approx(7.6, abs=0.5)
    assert found.values["mirrored_m"] < 1.2
    assert "--accel-sign apple" in found.advice


@pytest.mark.slow
def test_a_robot_that_turns_about_one_axis_gets_no_remedy_that_harms():
    found = case("planar_robot/robot.csv")
    assert not {code for code in found if code.startswith("truth_")}
    assert "track_scale" not in found  # weights that know virtual devices take it for no walker
    assert found["train"].advice == "Run `train`."


@pytest.fixture(scope="module")
def walk_and_track(make_walk, make_oracle):
    walk = make_walk(3, 60.0)
    return walk, Navigator(make_oracle(walk, walk.truth, CONFIG), CONFIG).run(walk)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda xy: xy, ""),
        (lambda xy: xy @ [[0.6, 0.8], [-0.8, 0.6]] + [100.0, -30.0], ""),  # another map
        (lambda xy: 1.15 * xy, ""),
        (lambda xy: 2.4 * xy, "track_scale"),
        (lambda xy: 0.5 * xy, "track_scale"),
        (lambda xy: xy * [1.0, -1.0], "mirror_image"),
    ],
)
def test_positions_contradict_by_length_and_handedness_alone(walk_and_track, change, code):
    walk, track = walk_and_track
    time = np.arange(0.0, 60.0, 0.5)
    path = change(walk.truth.at(time).position_W[:, :2])
    known = PositionTrack(time, path, "positions")
    found = position_findings(track, replace(walk, truth=None, positions=known))
    codes = [finding.code for finding in found if finding.code != "track_error"]
    assert codes == [code] * bool(code)
    few = replace(walk, truth=None, positions=known.slice(0.0, 1.2))
    assert position_findings(track, few) == []


def test_in_a_room_where_no_chord_of_ten_seconds_is_long_the_way_is_compared_too(walk_and_track):
    walk, track = walk_and_track
    circles = np.column_stack([np.cos(track.time / 0.75), np.sin(track.time / 0.75)])
    position = np.column_stack([0.2 * circles, np.zeros(len(track.time))])
    short = replace(track, trajectory=replace(track.trajectory, position_W=position))
    known = PositionTrack(track.time, 0.6 * circles, "positions")
    found = position_findings(short, replace(walk, truth=None, positions=known))
    assert [f.values["scale"] for f in found if f.code == "track_scale"] == [pytest.approx(3.0)]


@pytest.mark.parametrize(("degrees", "codes"), [(30.0, []), (163.0, ["network_direction"])])
def test_a_walk_taken_backwards_is_told_by_true_attitudes(walk_and_track, degrees, codes):
    """Its shape fits after a turn; only where the device faces says that the turn is wrong."""
    walk, track = walk_and_track
    turned = Rotation.from_euler("z", degrees, degrees=True) * walk.truth.attitude_WB
    found = position_findings(track, replace(walk, truth=replace(walk.truth, attitude_WB=turned)))
    assert [finding.code for finding in found] == codes
    turns = [finding.values["turn_deg"] for finding in found]
    assert turns == pytest.approx([degrees] * len(codes), abs=5.0)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_the_length_of_a_track_is_compared_along_its_way(walk_and_track, scale):
    walk, track = walk_and_track
    assert position_findings(track, walk) == []
    truth = replace(walk.truth, position_W=scale * walk.truth.position_W)
    ratio = length_ratio(track, replace(walk, truth=truth))
    assert ratio == pytest.approx(1.0 / scale, rel=0.05)
    assert np.isnan(length_ratio(track, walk.without_truth()))
    assert position_findings(track, walk.without_truth()) == []
