import math
from dataclasses import replace

import numpy as np
import pytest
from initial_ekf import Driven
from scipy.spatial.transform import Rotation
from support import GRAPH as CONFIG
from support import nav_state, stream, stream_deviation
from told import health_lines

from stario.fusion import Navigator, PriorPose, position_fix, yaw_fix
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.field_rotation import HARD_IRON_SIGMA
from stario.fusion.filter.jacobians import bearing_jacobian
from stario.fusion.filter.magnetic import (
    DISTURBANCE_SIGMA,
    HARD_IRON_SECONDS,
    MagneticReference,
    propagated_field,
    update_bearing,
    with_field,
)
from stario.fusion.report.health import health_findings
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.attitude.so3 import exp_so3
from stario.sequences.sequence import ImuSequence, Magnetometer
from stario.sequences.simulation.imu import ImuErrors, simulate_imu
from stario.sequences.simulation.magnetometer import MagneticField
from stario.sequences.simulation.walks import WalkStyle, generate_walk

FIELD_W = np.array([15.0, 12.0, -40.0])


def measured(sequence: ImuSequence, rate: float = 25.0, seed: int = 0) -> Magnetometer:
    truth = sequence.truth
    time = np.arange(truth.time[0], truth.time[-1], 1.0 / rate)
    field = truth.at(time).attitude_WB.inv().apply(FIELD_W)
    return Magnetometer(time, field + np.random.default_rng(seed).normal(size=field.shape))


@pytest.fixture(scope="module")
def biased_walk():
    """Two minutes with a gyroscope that drifts by a third of a degree per second."""
    style = WalkStyle(carry="handheld", mount_rotvec=(0.0, 0.0, 0.4))
    walk = generate_walk(3, 120.0, style=style)
    clean = simulate_imu(walk, 50.0, ImuErrors(gyro_turn_on=1e-4, accel_turn_on=1e-2), 3)
    sequence = replace(clean, gyro=clean.gyro + np.array([0.0, 0.0, 0.006]))
    return replace(sequence, magnetometer=measured(sequence))


@pytest.fixture(scope="module")
def oracle(biased_walk, make_oracle):
    """The true displacements of that walk with an error of 0.1 m."""
    return make_oracle(biased_walk, biased_walk.truth, CONFIG, noise=0.1, sigma=0.1)


@pytest.fixture(scope="module")
def biased_track(biased_walk, oracle):
    return Navigator(oracle, CONFIG, backend="ekf").run(biased_walk)


def state() -> EkfState:
    ekf, R_WB = Driven(2), exp_so3(np.array([0.3, -0.5, 1.2]))
    ekf.initialise(nav_state(0.01 * np.eye(15), R_WB=R_WB, p_W=np.array([3.0, 1.0, 0.0])))
    return with_field(ekf.state, R_WB.T @ FIELD_W)


def test_a_field_that_varies_along_the_path_has_a_wandering_azimuth() -> None:
    rng = np.random.default_rng(1)
    wander = {}
    places = ("quiet", 0.01, True), ("steel", 0.4, True), ("table", 0.01, False)
    for place, spread, travelled in places:
        reference = MagneticReference()
        for k in range(120):
            size, dip = 45.0 * (1.0 + spread * rng.normal()), 1.0 + spread * rng.normal()
            reference = reference.updated(0.5 * k, size, dip, travelled)
        wander[place] = reference.disturbance_sigma
    assert wander["quiet"] < 0.15
    # One spot tells nothing of others.
    assert wander["steel"] == wander["table"] == DISTURBANCE_SIGMA


def test_bearing_jacobian_agrees_with_finite_differences():
    R = exp_so3(np.array([0.3, -0.5, 1.2]))
    hard_iron, step, n = np.array([3.0, -2.0, 1.0]), 1e-6, 32
    m_B = R.T @ FIELD_W + hard_iron

    def residual(error):
        """Azimuth minus bearing of the true state, given its error from the estimate."""
        m_W = exp_so3(error[:3]) @ R @ (m_B - hard_iron - error[29:32])
        return error[27] + error[28] - math.atan2(m_W[1], m_W[0])

    numeric = [(residual(d) - residual(-d)) / (2.0 * step) for d in step * np.eye(n)]
    H = np.zeros(n)
    for first, block in bearing_jacobian(R, FIELD_W, 27):
        H[first : first + block.shape[1]] += block[0]
    np.testing.assert_allclose(H, numeric, atol=1e-6)


def test_a_turned_frame_turns_the_azimuth():
    before = state()
    turned = before.transformed(exp_so3(np.array([0.0, 0.0, 0.7])), np.array([5.0, 0.0, 0.0]))
    assert turned.field.azimuth - before.field.azimuth == pytest.approx(0.7)
    turn = exp_so3(np.array([0.0, 0.0, 0.7]))
    np.testing.assert_allclose(turned.R_WB @ before.R_WB.T @ FIELD_W, turn @ FIELD_W)


def test_bearings_of_a_device_at_rest_leave_its_yaw_unknown():
    ekf = Driven(2)
    ekf.state = state()
    yaw_variance, reference = ekf.state.P[2, 2], MagneticReference()
    for _ in range(20):
        m_B = ekf.state.R_WB.T @ FIELD_W
        ekf.state, _, reference = update_bearing(ekf.state, reference, m_B)
    assert ekf.state.P[2, 2] > 0.99 * yaw_variance


def azimuth_variance(places: np.ndarray) -> float:
    """Variance of the azimuth after a bearing each half second, in a hand that moves at 2 m/s."""
    s, reference = state(), MagneticReference()
    n = s.field_row + 2
    P = s.covariances.copy()
    P[:, n:], P[:, :, n:] = 0.0, 0.0  # without a hard iron
    for k, x in enumerate(places):
        X = s.X.copy()
        X[0, 0, 3:] = 2.0, x
        s = replace(s, time=0.5 * k, X=X, covariances=P if k == 0 else s.covariances)
        s, _, reference = update_bearing(s, reference, s.R_WB.T @ FIELD_W)
    return s.P[s.field_row, s.field_row]


def test_one_place_tells_its_own_azimuth_however_a_device_is_shaken_there():
    shaken, walked = azimuth_variance(0.2 * (np.arange(60) % 2)), azimuth_variance(np.arange(60))
    assert walked < DISTURBANCE_SIGMA**2 < shaken


def weight_left(reference: MagneticReference, scale: float = 1.0) -> float:
    """Variance of what is unknown of the field after a bearing 0.2 rad off."""
    s = state()
    m_B = exp_so3(np.array([0.0, 0.0, 0.2])) @ s.R_WB.T @ FIELD_W * scale
    s, *_ = update_bearing(s, reference, m_B)
    return float(np.trace(s.P[27:, 27:]))


def test_a_field_of_unusual_size_or_that_the_device_carries_on_has_less_weight():
    reference, size = MagneticReference(), float(np.linalg.norm(FIELD_W))
    carried = weight_left(MagneticReference(measured=size))
    assert carried > weight_left(MagneticReference(measured=0.0)) + 0.1
    for k in range(20):
        reference = reference.updated(0.5 * k, 45.0, 1.0, travelled=True)
    usual = replace(reference, size=size)
    assert weight_left(usual, scale=1.5) > weight_left(usual)


def test_a_field_that_the_device_carries_on_tells_nothing_of_the_place():
    wander = []
    for noise in (0.02, 0.0):
        rng, reference = np.random.default_rng(2), MagneticReference()
        s = state()
        for k in range(30):
            s = replace(s, time=0.5 * k)
            s.X[0, :, 4] += np.array([0.5, 0.0, 0.0])
            size = 1.0 + noise * rng.normal()
            s, _, reference = update_bearing(s, reference, s.R_WB.T @ FIELD_W * size)
            reference = replace(reference, pose=(s.R_WB, s.p_W))
        wander.append(reference.disturbance_sigma)
    assert wander[0] < 0.3 < wander[1]


@pytest.mark.slow
def test_the_bias_is_consistent_in_a_quiet_and_in_a_disturbed_field(make_oracle):
    walk = generate_walk(3, 50.0, style=WalkStyle(carry="handheld", mount_rotvec=(0.0, 0.0, 0.4)))
    for disturbance in (0.5, 8.0):
        field = MagneticField(disturbance=disturbance)
        clean = simulate_imu(walk, 50.0, ImuErrors(), 3, magnetic_field=field)
        sequence = replace(clean, gyro=clean.gyro + np.array([0.0, 0.0, 0.006]))
        oracle = make_oracle(sequence, sequence.truth, CONFIG, noise=0.1, sigma=0.1)
        track = Navigator(oracle, CONFIG, backend="ekf").run(sequence)
        sigma = math.sqrt(track.covariance[-1, 11, 11])
        assert abs(track.b_g[-1, 2] - 0.006) < 3.0 * sigma


def test_bearings_determine_the_gyroscope_bias(biased_walk, oracle, biased_track):
    """In a stream as in a batch; without it the error of the bias is larger."""
    track = biased_track
    blind = Navigator(oracle, CONFIG, backend="ekf").run(replace(biased_walk, magnetometer=None))
    assert abs(track.b_g[-1, 2] - 0.006) < 3.0 * np.sqrt(track.covariance[-1, 11, 11])
    assert abs(track.b_g[-1, 2] - 0.006) < 0.65 * abs(blind.b_g[-1, 2] - 0.006)
    assert track.health.bearings["applied"] > 200
    assert blind.health.bearings == {}

    states = stream(Navigator(oracle, CONFIG), biased_walk.slice(0.0, 16.0))
    assert stream_deviation(states, track) < 1e-6
    ends = states[0], states[-1]
    true = biased_walk.truth.at(np.array([s.time for s in ends])).attitude_WB
    turned = yaw_of(Rotation.from_matrix([s.R_WB for s in ends]) * true.inv())
    assert abs(math.remainder(turned[1] - turned[0], 2.0 * math.pi)) < math.radians(20.0)


def test_what_a_magnetometers_calibration_was_is_forgotten_within_minutes():
    s = state()
    P, row = s.covariances.copy(), s.field_row + 2
    P[:, row : row + 3, row : row + 3] = np.eye(3)
    field = replace(s.field, hard_iron_B=np.array([20.0, -25.0, 10.0]))
    known = replace(s, covariances=P, field=field)
    later = propagated_field(known, 0.0, 3.0 * HARD_IRON_SECONDS, DISTURBANCE_SIGMA)
    assert np.abs(later.field.hard_iron_B).max() < 2.0
    assert math.sqrt(later.P[row, row]) == pytest.approx(HARD_IRON_SIGMA, rel=0.01)


@pytest.mark.parametrize("iron", [[50.0, 0.0, 0.0], [-120.0, 200.0, 590.0]])
def test_a_magnetometer_that_was_never_calibrated_tells_the_bias_all_the_same(
    biased_walk, oracle, iron
):
    """A device in a hand turns enough to tell its hard iron, whatever its size."""
    field = biased_walk.magnetometer
    shifted = replace(biased_walk, magnetometer=replace(field, field=field.field + iron))
    track = Navigator(oracle, CONFIG, backend="ekf").run(shifted)
    blind = Navigator(oracle, CONFIG, backend="ekf").run(replace(biased_walk, magnetometer=None))
    error = abs(track.b_g[-1, 2] - 0.006)
    assert error < 3.0 * np.sqrt(track.covariance[-1, 11, 11])
    assert error < 0.8 * abs(blind.b_g[-1, 2] - 0.006)
    assert track.health.bearings["applied"] > 150


def test_what_a_magnetometer_told_before_it_was_calibrated_anew_is_forgotten(biased_walk, oracle):
    """As by a phone that is turned and shaken before the walk: its hard iron changes at once."""
    field, time = biased_walk.magnetometer.field.copy(), biased_walk.magnetometer.time
    field[time < 8.0] += [40.0, -40.0, 5.0]
    calibrated = replace(biased_walk, magnetometer=Magnetometer(time, field))
    after = replace(biased_walk, magnetometer=Magnetometer(time[time >= 8.0], field[time >= 8.0]))
    tracks = [Navigator(oracle, CONFIG, backend="ekf").run(each) for each in (calibrated, after)]
    biases, sigma = [t.b_g[-1, 2] for t in tracks], np.sqrt(tracks[1].covariance[-1, 11, 11])
    assert abs(biases[0] - biases[1]) < 0.3 * sigma


@pytest.mark.parametrize("fault", ["axes swapped", "stopped"])
def test_a_contradicting_field_turns_no_track(biased_walk, oracle, biased_track, fault):
    field, time = biased_walk.magnetometer.field.copy(), biased_walk.magnetometer.time
    if fault == "axes swapped":
        field = field[:, [1, 0, 2]]
    else:
        field[time > 25.0] = field[np.searchsorted(time, 25.0)]
    wrong = replace(biased_walk, magnetometer=Magnetometer(time, field))
    track = Navigator(oracle, CONFIG, backend="ekf").run(wrong.slice(0.0, 55.0))
    bias_error = abs(track.b_g[-1, 2] - 0.006)
    assert bias_error < 3.0 * np.sqrt(track.covariance[-1, 11, 11])
    if fault == "stopped":
        assert track.health.fields_dropped > 50
    else:
        assert track.health.bearings["contradicts the gyroscope"] > 0.5 * 2 * 55
    assert "contradicts the gyroscope" not in biased_track.health.bearings


def test_repeated_and_invalid_fields_are_dropped_and_counted(still_model):
    navigator = Navigator(still_model, CONFIG)
    wrong = (0.0, FIELD_W), (-0.5, FIELD_W), (1.0, [np.nan, 0.0, 0.0]), (1.5, [np.inf, 0.0, 0.0])
    for time, field in ((0.0, FIELD_W), *wrong):
        navigator.push_magnetometer(time, field)
    assert navigator.health.fields_dropped == len(wrong)
    assert "magnetometer samples dropped: 4" in navigator.health.lines()


def test_a_field_on_another_clock_is_reported(biased_walk, still_model):
    walk = biased_walk.slice(0.0, 6.0)
    field = replace(walk.magnetometer, time=walk.magnetometer.time + 1e4)
    health = Navigator(still_model, CONFIG).run(replace(walk, magnetometer=field)).health
    assert health.fields_dropped == len(field.time) > 50
    assert any("magnetic fields were dropped" in line for line in health_lines(health))


@pytest.mark.parametrize(
    ("scale", "named"),
    [(1e-2, "weak"), (1e3, "strong")],  # gauss, nT
)
def test_a_field_in_another_unit_is_named_as_such(biased_walk, make_oracle, scale, named):
    walk = biased_walk.slice(0.0, 6.0)
    field = replace(walk.magnetometer, field=scale * walk.magnetometer.field)
    oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
    track = Navigator(oracle, CONFIG, backend="ekf").run(replace(walk, magnetometer=field))
    [reason] = track.health.bearings
    assert named in reason


def test_a_field_that_tells_nothing_makes_no_track_surer(biased_walk, make_oracle):
    walk = biased_walk.slice(0.0, 30.0)
    in_gauss = replace(walk.magnetometer, field=0.01 * walk.magnetometer.field)
    sigmas = []
    for magnetometer in (None, in_gauss):
        oracle = make_oracle(walk, walk.truth, CONFIG, noise=0.1, sigma=0.1)
        track = Navigator(oracle, CONFIG).run(replace(walk, magnetometer=magnetometer))
        sigmas.append(track.health.final_sigma["yaw_rad"])
    assert sigmas[1] == pytest.approx(sigmas[0], rel=0.01)


def test_a_disabled_magnetometer_has_no_effect(biased_walk, make_oracle):
    short = biased_walk.slice(0.0, 6.0)
    off = replace(CONFIG, filter=replace(CONFIG.filter, magnetometer=False))
    oracle = make_oracle(short, biased_walk.truth, CONFIG)
    blind = Navigator(oracle, CONFIG, backend="ekf").run(replace(short, magnetometer=None))
    without = Navigator(oracle, off, backend="ekf").run(short)
    np.testing.assert_array_equal(without.trajectory.position_W, blind.trajectory.position_W)


def test_a_declination_turns_the_track_to_true_north(biased_walk, make_oracle):
    """The whole track from the first pose on; the azimuth of the field here is 39 degrees."""
    declination = math.pi / 2.0 - math.atan2(FIELD_W[1], FIELD_W[0])
    settings = replace(CONFIG, filter=replace(CONFIG.filter, declination=declination))
    walk = biased_walk.slice(0.0, 20.0)
    oracle = make_oracle(walk, biased_walk.truth, settings, noise=0.05, sigma=0.05)
    graph = Navigator(oracle, settings).run(walk)
    for track in (graph, graph.filtered):
        truth = walk.truth.at(track.time)
        R = track.trajectory.attitude_WB * truth.attitude_WB.inv()
        off = np.arctan2(*R.as_matrix()[:, [1, 0], 0].T)
        sigma = np.sqrt(track.covariance[:, 2, 2])
        assert 0.05 < sigma[-1] < 0.6
        assert np.all(np.abs(off) < 3.0 * sigma[-1])
        assert track.health.fixes == {}
        assert track.health.bearings["north"] == 1
    before = Navigator(oracle, CONFIG, backend="ekf").run(walk.slice(0.0, 5.0))
    assert abs(yaw_of(before.trajectory.attitude_WB)[0]) < 0.02  # first yaw without a declination


def test_the_field_tells_no_unknown_yaw_after_a_gap(biased_walk, make_oracle, without):
    whole = biased_walk.slice(0.0, 20.0)
    walk = without(whole, (whole.time > 10.0) & (whole.time < 14.0))
    oracle = make_oracle(walk, biased_walk.truth, CONFIG)
    fix = position_fix(5.0, walk.truth.at(np.array([5.0])).position_W[0], np.eye(3))
    track = Navigator(oracle, CONFIG, backend="ekf").run(walk, fixes=[fix])
    assert np.sqrt(track.covariance[track.time > 6.0, 2, 2]).min() > 1.5


def test_a_north_that_contradicts_a_yaw_fix_is_told(biased_walk, make_oracle):
    declination = math.pi / 2.0 - math.atan2(FIELD_W[1], FIELD_W[0])
    walk = biased_walk.slice(0.0, 20.0)
    oracle = make_oracle(walk, biased_walk.truth, CONFIG, noise=0.05, sigma=0.05)
    yaw = float(yaw_of(walk.truth.at(np.array([1.5])).attitude_WB)[0])
    for wrong in (0.0, -2.5):
        settings = replace(CONFIG, filter=replace(CONFIG.filter, declination=declination + wrong))
        fix = yaw_fix(1.5, yaw, 0.05)
        health = Navigator(oracle, settings, backend="ekf").run(walk, fixes=[fix]).health
        assert health.north_contradiction == pytest.approx(wrong, abs=0.4)
        told = "north_contradicts" in [found.code for found in health_findings(health)]
        assert told == bool(wrong)


def test_north_is_not_applied_if_the_direction_is_known(biased_walk, make_oracle):
    walk = biased_walk.slice(0.0, 20.0)
    settings = replace(CONFIG, filter=replace(CONFIG.filter, declination=0.1))
    oracle = make_oracle(walk, biased_walk.truth, settings)
    known = PriorPose(exp_so3(np.array([0.0, 0.0, 1.0])), np.zeros(3), np.zeros(3))
    track = Navigator(oracle, settings, prior=known, backend="ekf").run(walk)
    assert track.health.fixes == {}
