import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from told import told
from walked import walked

from stario.sequences import ImuSequence, Trajectory, WalkStyle, generate_walk, inspect_recording
from stario.sequences.clean_samples import middle_part
from stario.sequences.conventions import SAME_AXES, with_axes
from stario.sequences.simulation.imu import PERFECT_IMU, PHONE_IMU, simulate_imu
from stario.sequences.truth.fit import fit_truth, yaw_drift
from stario.sequences.truth.problems import fit_findings


def recorded_in(sequence: ImuSequence, axes: str) -> ImuSequence:
    """Return the recording of an IMU with other axes, to which no option was applied."""
    return replace(with_axes(sequence, axes), axes=SAME_AXES)


@pytest.fixture(scope="module")
def walk():
    return simulate_imu(generate_walk(8, 40.0, style=WalkStyle()), 100.0, seed=2)


def test_a_truth_that_fits_needs_no_correction(walk):
    fit = fit_truth(walk)
    assert abs(fit.time_offset) < 0.002
    assert fit.misalignment < np.radians(1.0)
    assert fit.tilt < np.radians(1.5)  # misaligned by 0.6 degrees per axis, and biased
    assert fit.correlation > 0.99
    assert fit.agreeing > 0.99
    assert fit.jumps == 0
    assert fit.axes() is None
    measured = np.interp(fit.times, walk.time, np.linalg.norm(walk.gyro, axis=1))
    assert np.nanmedian(fit.speed / measured) == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("offset", [-3.21, -0.05, 0.4, 2.503])
def test_the_clock_offset_is_found(walk, offset):
    truth = walk.truth
    late = replace(walk, truth=replace(truth, time=truth.time - offset))
    assert fit_truth(late).time_offset == pytest.approx(offset, abs=0.003)


def test_the_rotation_between_the_axes_and_a_tilt_of_the_world_are_found(walk):
    truth = walk.truth
    R_TB = Rotation.from_rotvec([0.3, -0.8, 0.4])
    turned = replace(walk, truth=replace(truth, attitude_WB=truth.attitude_WB * R_TB.inv()))
    fit = fit_truth(turned)
    assert (fit.R_TB.inv() * R_TB).magnitude() < np.radians(1.0)
    assert fit.axes() is None  # no permutation is close
    lean = Rotation.from_rotvec([np.radians(5.0), 0.0, 0.0])
    leaning = replace(walk, truth=replace(truth, attitude_WB=lean * truth.attitude_WB))
    assert np.degrees(fit_truth(leaning).tilt) == pytest.approx(5.0, abs=1.0)
    accel = walk.accel.copy()
    accel[3000] = [1e4, 0.0, 0.0]  # a spike does not tilt it
    assert fit_truth(replace(walk, accel=accel)).tilt < np.radians(1.5)


@pytest.mark.parametrize(
    ("turned", "corrected"), [("y,-x,z", "-y,x,z"), ("z,x,y", "y,z,x"), ("-x,-y,z", "-x,-y,z")]
)
def test_axes_are_named_despite_a_clock_offset(walk, turned, corrected):
    truth = walk.truth
    late = replace(walk, truth=replace(truth, time=truth.time + 1.0))
    assert fit_truth(with_axes(late, turned)).axes() == corrected


def test_a_truth_of_another_recording_or_time_is_not_taken_for_right(walk):
    other = simulate_imu(generate_walk(97, 40.0, style=WalkStyle(carry="pocket")), 200.0)
    fit = fit_truth(replace(walk, truth=other.truth))
    assert fit.correlation < 0.7
    assert fit.axes() is None
    truth = walk.truth
    fit = fit_truth(replace(walk, truth=replace(truth, time=truth.time + 500.0)))
    assert fit.time_offset == pytest.approx(-500.0, abs=0.01)
    assert not fit.consistent


@pytest.mark.parametrize(
    "found", [{"time_offset": 4.97}, {"correlation": 0.87}, {"correlation": 0.94, "agreeing": 0.6}]
)
def test_a_truth_that_may_be_of_another_walk_gives_neither_offset_nor_axes(walk, found):
    """A steady gait resembles itself some steps later, so a search always finds some offset."""
    fit = fit_truth(with_axes(replace(walk, name="w"), "y,-x,z"))
    assert fit.axes() == "-y,x,z"
    other = replace(fit, **{"time_offset": -2.0} | found)
    assert other.axes() is None
    (problem,) = fit_findings(other, "")
    if "time_offset" in found:  # all else agrees
        assert "add +4.97 s" in problem.advice
    else:
        assert "clocks more than 5 s apart, is the truth of another" in problem.advice


@pytest.mark.parametrize("signs", [(-1.0, -1.0, -1.0), (1.0, 1.0, -1.0)])
def test_wrong_gyroscope_signs_are_not_blamed_on_the_truth(signs):
    walk = walked(8, 40.0, imu_seed=2, carry="pocket", mount_rotvec=(0.0, 0.0, 0.0))
    (problem,) = fit_findings(fit_truth(replace(walk, gyro=walk.gyro * signs)), "")
    assert "gyroscope" in str(problem)
    assert "sign" in problem.advice
    for right in (walk, recorded_in(walk, "y,-x,z"), recorded_in(walk, "y,z,x")):
        assert "sign" not in " ".join(str(p) for p in fit_findings(fit_truth(right), ""))


def test_the_accelerometer_decides_whether_gyroscope_or_truth_is_turned(walk):
    fit = fit_truth(replace(walk, gyro=walk.gyro @ Rotation.from_rotvec([0.5, 0, 0]).as_matrix().T))
    (problem,) = fit_findings(fit, "")
    assert "gyroscope: its axes or signs are not those of the accelerometer" in problem.advice
    truth = walk.truth
    turned = replace(truth, attitude_WB=truth.attitude_WB * Rotation.from_rotvec([0.5, 0, 0]))
    problems = fit_findings(fit_truth(replace(walk, truth=turned)), "")
    assert "truth: axes" in str(problems[0])


@pytest.mark.parametrize("axes", ["y,z,x", "y,-x,z", "-z,y,x"])
def test_the_axes_remedy_refers_to_the_file_and_converges(walk, axes):
    """Followed literally, it leaves nothing to correct, whatever option was given before."""
    assert fit_truth(with_axes(walk, axes)).axes_remedy() == "omit `--axes`"
    recorded = recorded_in(walk, "-x,-y,z")
    remedy = fit_truth(with_axes(recorded, axes)).axes_remedy()
    right = remedy.removeprefix("pass `--axes=").removesuffix("`")
    assert fit_truth(with_axes(recorded, right)).axes_remedy() is None


def test_of_a_long_recording_the_middle_is_compared():
    time, zero = np.arange(18_000) / 10.0, np.zeros((18_000, 3))
    part = middle_part(ImuSequence("long", time, zero, zero))
    assert (part.time[0], part.time[-1]) == pytest.approx((600.0, 1200.0), abs=0.2)


@pytest.mark.parametrize("rate", [30.0, 100.0])
def test_a_new_mounting_after_each_gap_of_the_truth_does_not_contradict_the_gyroscope(rate):
    """All pieces but the first are too short for the long fit; no mount lasts across a gap."""
    walk = simulate_imu(generate_walk(8, 120.0, style=WalkStyle()), 100.0, PHONE_IMU, 2)
    time = np.arange(0.0, 120.0, 1.0 / rate)
    truth = walk.truth.at(time[(time < 11.0) | ((time + 1.0) % 12.0 > 2.1)])
    turned = Rotation.random(11, random_state=1)[(truth.time // 12.0).astype(int)]
    mounted = replace(truth, attitude_WB=truth.attitude_WB * turned)
    fit = fit_truth(replace(walk, truth=mounted))
    assert fit.correlation > 0.98
    assert abs(fit.time_offset) < 0.005
    assert fit.consistent


def test_rotation_about_one_axis_leaves_clock_and_axes_open(walk):
    time = np.arange(0.0, 60.0, 0.01)
    yaw = Rotation.from_euler("z", 2.0 * np.sin(0.4 * time)[:, None])
    robot = Trajectory(time, np.column_stack([0.5 * time, 0.0 * time, 0.0 * time]), yaw)
    planar = fit_truth(simulate_imu(robot, 100.0, PHONE_IMU, 1))
    assert planar.one_axis
    assert fit_findings(planar, "") == []
    assert not fit_truth(walk).one_axis


def test_a_gap_is_no_jump(walk):
    truth = walk.truth
    fit = fit_truth(walk.select((walk.time < 15.0) | (walk.time > 18.0)))
    assert fit.jumps == 0
    assert fit.misalignment < np.radians(1.0)
    assert abs(fit.time_offset) < 0.003
    gappy = replace(walk, truth=replace(truth, valid=np.abs(truth.time - 20.0) > 1.0))
    assert fit_truth(gappy).jumps == 0
    turned = Rotation.from_euler("z", np.where(truth.time > 20.0, 2.0, 0.0)[:, None])
    reset = replace(gappy.truth, attitude_WB=turned * truth.attitude_WB)
    assert fit_truth(replace(walk, truth=reset)).jumps == 1


@pytest.fixture(scope="module")
def turning():
    return walked(5, 90.0, PERFECT_IMU, 1, carry="handheld", mount_rotvec=(0.3, -0.5, 0.4))


@pytest.mark.parametrize(("scale", "bias"), [(0.0, 0.004), (0.023, 0.0), (-0.015, 0.004)])
def test_scale_and_bias_are_recovered(turning, scale, bias):
    truth = turning.truth
    up_B = truth.at(turning.time).attitude_WB.apply([0.0, 0.0, 1.0], inverse=True)
    turned = replace(turning, gyro=(1.0 + scale) * turning.gyro + bias * up_B)
    found = yaw_drift(turned, fit_truth(turned))
    assert found.scale == pytest.approx(scale, abs=2e-3)
    assert found.bias == pytest.approx(bias, abs=5e-4)
    assert found.residual_rms < np.radians(1.0)


@pytest.mark.parametrize("carry", ["pocket", "swinging", "rig"])
def test_scale_is_recovered_from_a_device_that_tilts_with_a_bias(carry):
    """Neither its tilting nor a bias about its own axes is taken for a scale error."""
    track = generate_walk(5, 120.0, style=WalkStyle(carry=carry))
    tilting = simulate_imu(track, 100.0, PERFECT_IMU)
    off = replace(tilting, gyro=1.03 * tilting.gyro + [0.03, -0.02, 0.04])
    found = yaw_drift(off, fit_truth(off))
    assert found.scale == pytest.approx(0.03, abs=2e-3)
    assert found.residual_rms < np.radians(0.3)


def test_the_report_states_the_scale_error(turning):
    too_high, too_low = (
        "\n".join(inspect_recording(replace(turning, gyro=scale * turning.gyro)).lines())
        for scale in (1.03, 0.97)
    )
    assert re.search(r"the gyroscope reads (2\.9|3\.[01]) % too high", too_high)
    assert re.search(r"the gyroscope reads (2\.9|3\.[01]) % too low", too_low)


def test_without_rotation_no_yaw_drift_is_estimated(turning):
    truth = turning.truth
    until = turning.time < turning.time[0] + 12.0
    short = ImuSequence(
        turning.name,
        turning.time[until],
        1e-3 * turning.gyro[until],
        turning.accel[until],
        truth,
    )
    still = replace(truth, attitude_WB=truth.attitude_WB[np.zeros(len(truth.time), dtype=int)])
    unturned = replace(short, truth=still)
    assert yaw_drift(unturned, fit_truth(unturned)) is None


@pytest.mark.parametrize(
    ("scale", "words"),
    [(1.3, r"(29|30)\.\d % too high"), (1 / 57.3, r"98\.\d % too low"), (1.04, "")],
)
def test_an_implausible_scale_is_a_problem(turning, scale, words):
    reported = "\n".join(told(replace(turning, gyro=scale * turning.gyro)))
    assert ("gyroscope: reads" in reported) is bool(words)
    assert re.search(words, reported)
