import json
import re
from dataclasses import replace

import numpy as np
import pytest
from recorded import DATA
from scipy.spatial.transform import Rotation
from told import told
from walked import walked

from stario.sequences import (
    InputError,
    inspect_recording,
    read_recording,
    truth_findings,
)
from stario.sequences.drawing.plots import imu_overview
from stario.sequences.files import json_text
from stario.sequences.inspection.samples import clock_findings
from stario.sequences.sequence import (
    STANDARD_GRAVITY,
    Barometer,
    ImuSequence,
    Magnetometer,
    PositionTrack,
    Satellites,
)


@pytest.fixture(scope="module")
def walk():
    return walked(8, 30.0, imu_seed=2, mount_rotvec=(0.0, 0.0, 0.0))


def problem(sequence: ImuSequence) -> str:
    (text,) = told(sequence)
    return text


def test_jumps_of_satellite_positions_are_a_problem(walk):
    time = np.arange(1.0, 29.0)
    path, sigma = np.outer(time, [1.2, 0.0]), np.full(len(time), 5.0)
    known = PositionTrack(time, path, "positions", sigma=sigma)
    outdoors = replace(walk, truth=None, positions=known)
    taps = replace(outdoors, positions=replace(known, kind="waypoints"))
    path[5] += [0.0, 12.0]  # within the stated errors
    assert told(outdoors) == []
    path[10:15] += [0.0, 100.0]
    assert "positions: found jumps of up to 100 m" in problem(outdoors)
    assert told(taps) == []  # no source of positions jumps there


@pytest.mark.parametrize(
    ("by", "words"),
    [
        (3600.0, ["jumps ahead by 3600 s at 15.0 s: by an hour, .*daylight saving: export UTC"]),
        (-3600.0, ["jumps back by 3600 s at 15.0 s: by an hour, .*daylight saving: export UTC"]),
        (3603.0, []),
        (-3603.0, ["jumps back by 3603 s at 15.0 s: split the recording there"]),
    ],
)
def test_a_clock_that_changes_for_daylight_saving_is_named(walk, by, words):
    changed = replace(walk, truth=None, time=walk.time + np.where(walk.time > 15.0, by, 0.0))
    for found, expected in zip(told(changed), words, strict=True):
        assert re.search(expected, found)


def test_an_hour_at_the_middle_is_no_error_of_the_truth(walk):
    time = walk.time + np.where(walk.time > 15.0, 3600.0, 0.0)
    changed = replace(walk, time=time, truth=replace(walk.truth, time=time))
    assert truth_findings(changed.select(np.arange(1, len(walk)))) == []


@pytest.mark.parametrize("part", ["magnetometer", "barometer", "satellites", "positions"])
@pytest.mark.parametrize(
    ("factor", "offset", "words"),
    [(1e3, 0.0, "they seem to be in ms"), (1.0, 500.0, "use one clock for both")],
)
def test_what_is_at_other_times_than_the_samples_is_reported(walk, part, factor, offset, words):
    time, place = walk.time[::20], np.tile([48.0, 11.0], (len(walk.time[::20]), 1))
    parts = {
        "magnetometer": Magnetometer(time, np.ones((len(time), 3))),
        "barometer": Barometer(time, np.full(len(time), 1013.0)),
        "satellites": Satellites(time, place),
        "positions": PositionTrack(time, place, "waypoints"),
    }
    whole = replace(walk, truth=None, **parts)
    assert clock_findings(whole) == []
    elsewhere = replace(parts[part], time=factor * time + offset)
    wrong = replace(whole, **{part: elsewhere})
    [found] = map(str, clock_findings(wrong))
    assert found in told(wrong)
    times = f"found times from {offset:.6g} to {factor * time[-1] + offset:.6g} s, expected most"
    assert found.startswith(f"{part}: {times} during the samples, 0 to ")
    assert found.endswith(words)


@pytest.mark.parametrize("count", [0, 1])
def test_a_truth_of_hardly_any_poses_is_a_problem(walk, count):
    valid = np.arange(len(walk.truth)) < count
    found = told(replace(walk, truth=replace(walk.truth, valid=valid)))
    assert any(f"truth: only {count} usable pose" in problem for problem in found)


def test_a_good_recording_has_no_problems_and_findings_are_plain_json_values(walk):
    found = inspect_recording(walk)
    assert found.findings == ()
    figures = found.figures
    assert figures["samples"] == len(walk)
    assert figures["rate_hz"] == pytest.approx(100.0)
    assert figures["gaps"] == []
    assert figures["accel_norm_mean_m_s2"] == pytest.approx(STANDARD_GRAVITY, abs=0.5)
    assert figures["truth"]["coverage"] > 0.99
    assert figures["truth"]["path_m"] == pytest.approx(walk.truth.path_length())
    content = json.loads(json_text(inspect_recording(walk).as_dict()))
    assert content["truth"]["coverage"] > 0.99
    assert abs(content["truth_against_gyroscope"]["time_offset_s"]) < 0.005
    assert len(content["truth_against_gyroscope"]["misalignment_rotvec_rad"]) == 3
    bare = json.loads(json_text(inspect_recording(walk.without_truth()).as_dict()))
    assert bare["truth"] is None
    assert bare["truth_against_gyroscope"] is None


def test_gaps_and_wrong_times_are_counted(walk, caplog):
    keep = np.ones(len(walk), dtype=bool)
    keep[500:750] = keep[1200:1203] = False
    time = walk.time.copy()
    time[100], time[200] = time[99], time[190]
    accel = walk.accel.copy()
    accel[300, 1] = np.nan
    found = inspect_recording(ImuSequence("dirty", time[keep], walk.gyro[keep], accel[keep]))
    assert caplog.text.count("not finite or too large dropped: 1") == 2  # by units, for all others
    timing = found.figures
    lengths = {round(gap["start_s"], 2): round(gap["length_s"], 2) for gap in timing["gaps"]}
    assert lengths[4.99] == 2.51
    assert lengths[11.99] == 0.04
    assert timing["times_repeated"] == 1
    assert timing["times_backward"] == 1
    assert timing["samples_not_finite"] == 1
    # The two samples with wrong times leave gaps where they should have been.
    lost = timing["samples_lost_in_gaps"]
    assert lost >= 250 + 3
    places = f"{lost} samples missing in {len(timing['gaps'])} places; longest"
    assert any(line.startswith(places) for line in found.lines())
    assert timing["jitter_s"] < 1e-9


def test_one_wild_time_is_counted_and_nothing_else(walk, caplog):
    for wild in (1e9, -1e9):
        time = walk.time.copy()
        time[1000] = wild
        found = inspect_recording(replace(walk, time=time))
        assert found.findings == ()
        assert found.figures["times_ahead"] + found.figures["times_backward"] == 1
        assert found.figures["samples"] == len(walk)
        assert "ahead" not in caplog.text
        if wild > 0.0:
            assert found.figures["duration_s"] == pytest.approx(walk.duration)
            assert found.figures["samples_lost_in_gaps"] == 1
            assert any("1 ahead of their time" in line for line in found.lines())


def test_a_truth_too_slow_or_of_another_body_is_named_as_such(walk):
    """Its attitude between two poses is unknown, so neither clock nor axes may be blamed."""
    truth = walk.truth
    found = inspect_recording(replace(walk, truth=truth.at(np.arange(0.0, truth.time[-1], 0.2))))
    (slow,) = found.findings
    assert "5 Hz; at least 10 Hz" in slow.text
    assert found.fit is None
    # Rotated about the vertical of a level device, so that gravity gives no information.
    turned = truth.attitude_WB * Rotation.from_rotvec([0.0, 0.0, 0.6])
    text = problem(replace(walk, truth=replace(truth, attitude_WB=turned)))
    assert "34." in text
    assert "no option fixes" in text


def test_rest_is_reported(walk):
    assert any("at rest: never" in line for line in inspect_recording(walk).lines())
    rng = np.random.default_rng(0)
    time = np.arange(500) / 100.0
    gyro, accel = 0.003 * rng.normal(size=(500, 3)), 0.02 * rng.normal(size=(500, 3))
    accel[:, 2] += STANDARD_GRAVITY
    found = inspect_recording(ImuSequence("r", time, gyro, accel))
    assert "at rest: 5.0 s in 1 stretch" in found.lines()
    assert "truth: none" in found.lines()


def test_poor_recordings_are_described_not_refused(walk):
    for poor in (
        walk.slice(0.0, 0.5),
        walk.slice(0.0, 5.0),
        ImuSequence("one", walk.time[:1], walk.gyro[:1], walk.accel[:1]),
        ImuSequence("slow", walk.time[::10], walk.gyro[::10], walk.accel[::10]),
        replace(walk, truth=replace(walk.truth, time=walk.truth.time + 1000.0)),
    ):
        found = inspect_recording(poor)
        assert found.lines()
        json_text(found.as_dict())
    with pytest.raises(InputError, match="no finite sample"):
        inspect_recording(replace(walk, gyro=np.nan * walk.gyro))


def test_the_figure_shows_rest_gaps_and_the_rotation_of_the_truth(walk):
    fit = inspect_recording(walk).fit
    figure = imu_overview(walk, (fit.times, fit.speed), rest=[(1.0, 2.0)], gaps=[(5.0, 6.0)])
    labels = {
        text.get_text()
        for axes in figure.axes
        if (legend := axes.get_legend())
        for text in legend.get_texts()
    }
    assert {"at rest", "gap", "gyroscope", "truth"} <= labels
    assert len(figure.axes) == 4


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no recordings at {DATA}")
@pytest.mark.parametrize(
    "name", ["tumvi/dataset-room1_512_16", "euroc/V1_02_medium", "oxiod/trolley/data2/syn/imu4.csv"]
)
def test_real_recordings_have_no_problems(name):
    found = inspect_recording(read_recording(DATA / name))
    assert found.findings == ()
    assert found.fit.correlation > 0.95
    assert abs(found.fit.time_offset) < 0.01
    assert np.degrees(found.fit.misalignment) < 2.5
