from dataclasses import replace

import numpy as np
import pytest
from initial_ekf import Driven
from simulated import Still
from support import nav_state, samples
from support import stream as states_of

from stario.fusion import Navigator, NavigatorConfig, Track, WindowDisplacement
from stario.fusion.evaluation.checks.fusion import heights_table, score_heights
from stario.fusion.evaluation.scores import values
from stario.fusion.filter.ekf_state import EkfState
from stario.fusion.filter.height import with_height, yielding
from stario.fusion.imu.barometer import HeightSample
from stario.fusion.report.health import health_findings
from stario.fusion.report.panels import motion_panels
from stario.fusion.report.series import track_series
from stario.sequences import Barometer, ImuSequence, InputError
from stario.sequences.attitude.so3 import exp_so3
from stario.sequences.simulation.house import simulate_house
from stario.sequences.simulation.outside_sensors import simulate_barometer
from stario.sequences.units import standard_pressure

CONFIG = NavigatorConfig()


def state() -> EkfState:
    """A state with two clones and correlated errors."""
    ekf = Driven(2)
    root = np.random.default_rng(3).normal(size=(15, 15)) * 0.1
    v_W, p_W, turn = np.array([[0.4, 1.0, 0.3], [30.0, -20.0, 5.0], [0.3, -0.5, 1.2]])
    ekf.initialise(nav_state(root @ root.T, 10.0, R_WB=exp_so3(turn), v_W=v_W, p_W=p_W))
    ekf.clone()
    return ekf.state


def sample(height: float = 7.0, time: float = 9.8, **rest: float) -> HeightSample:
    return HeightSample(time, height, 0.1, **rest)


def height_variance(s: EkfState) -> float:
    return float(s.nav_state().covariance[8, 8])


def test_the_first_height_determines_the_offset_alone():
    before = state()
    after, result = with_height(before, sample())
    assert result.accepted
    # A fifth of a second ago it was lower by a fifth of 0.3 m/s.
    assert after.offset.metres == pytest.approx(7.0 - (5.0 - 0.06))
    n = before.covariances.shape[1]
    np.testing.assert_array_equal(after.covariances[:, :n, :n], before.covariances)
    # The same height again: nothing new, wherever the track is by its own uncertainty.
    again, result = with_height(after, sample())
    assert result.residual == pytest.approx(0.0, abs=1e-12)
    assert height_variance(again) == pytest.approx(height_variance(before), rel=1e-6)


def test_jacobian_agrees_with_finite_differences():
    s, _ = with_height(state(), sample())
    n, step = s.covariances.shape[1], 1e-6
    root = np.random.default_rng(1).normal(size=(n, n))
    s = replace(s, covariances=np.stack([root @ root.T] * 2))
    errors = [step * np.eye(n)[k] for k in range(n)]
    moved = [with_height(s.plus(e), sample())[1].residual for e in errors]
    at_rest = with_height(s, sample())[1]
    H = -(np.array(moved)[:, 0] - at_rest.residual[0]) / step
    H[s.considered_rows] = 0.0
    expected = np.sqrt(H @ s.P_reported @ H + 0.1**2)
    assert at_rest.sigma[0] == pytest.approx(expected, rel=1e-5)


def test_pressure_tells_a_change_of_height():
    s, _ = with_height(state(), sample())
    climbed, _ = with_height(s, sample(height=10.0, time=9.9, rate=1.0, risen=3.0))
    assert climbed.p_W[2] - s.p_W[2] == pytest.approx(3.0, abs=0.2)
    stepped, _ = with_height(s, sample(height=10.0, time=9.9, stepped=3.0))
    assert stepped.offset.metres - s.offset.metres > 2.0
    # Neither tells where the track was before: the first pressure is any height's.
    for after in (climbed, stepped):
        assert height_variance(after) > 0.9 * height_variance(s)


@pytest.mark.parametrize(
    "transform",
    [
        lambda s: s.transformed(exp_so3(np.array([0.0, 0.0, 0.7])), np.array([5.0, 6.0, 2e4])),
        lambda s: s.with_position_inflated(100.0),
        lambda s: s.with_yaw_inflated(np.array([1.0, 2.0, 3.0]), 2.0),
        lambda s: s.with_yaw_inflated(np.zeros(3), 2.0).with_lost_yaw_forgotten(),
    ],
)
def test_moving_the_map_changes_nothing_that_pressure_tells(transform):
    s, _ = with_height(state(), sample())
    now = sample(height=7.4, time=9.9)
    before, after = with_height(s, now)[1], with_height(transform(s), now)[1]
    np.testing.assert_allclose(after.residual, before.residual, atol=1e-7)
    np.testing.assert_allclose(after.sigma, before.sigma, rtol=1e-5)


@pytest.fixture(scope="module")
def house():
    """A minute: stairs to the first floor, and a lift to the fourth."""
    walk = simulate_house(9, 120.0, rate=50.0)
    sequence = replace(walk.sequence, magnetometer=None).slice(45.0, 113.0)
    return replace(walk, sequence=sequence)


@pytest.fixture(scope="module")
def level_oracle(house, make_oracle):
    """The true horizontal displacements; the vertical ones are those of a level floor."""
    oracle = make_oracle(house.sequence, house.sequence.truth, CONFIG, noise=0.03, sigma=0.05)
    oracle._displacements = {k: v * [1.0, 1.0, 0.0] for k, v in oracle._displacements.items()}
    return oracle


def climb_error(track: Track, sequence: ImuSequence) -> float:
    z = track.trajectory.position_W[:, 2]
    true = sequence.truth.at(track.time).position_W[:, 2]
    return float(np.abs(z - z[0] - true + true[0]).max())


@pytest.fixture(scope="module")
def house_track(house, level_oracle):
    return Navigator(level_oracle, CONFIG).run(house.sequence)


def test_heights_follow_stairs_and_a_lift(house, house_track):
    true = house.sequence.truth.position_W[:, 2]
    assert np.ptp(true) > 11.0
    assert climb_error(house_track, house.sequence) < 1.0
    assert climb_error(house_track.filtered, house.sequence) < 2.5  # a lift shows after a second
    error = house_track.trajectory.position_W[:, 2] - true[0]
    error -= house.sequence.truth.at(house_track.time).position_W[:, 2] - true[0]
    variance = house_track.covariance[:, 8, 8]
    assert 0.05 < np.mean((error - error[0]) ** 2 / variance) < 3.0


def test_without_pressures_on_a_climb_its_height_is_as_uncertain_as_it_is(house, level_oracle):
    barometer = house.sequence.barometer
    first, *_, last = Navigator(level_oracle, CONFIG).run(house.sequence).health.floors
    heard = (barometer.time < first.start - 2.0) | (barometer.time > last.stop + 4.0)
    silent = Barometer(barometer.time[heard], barometer.pressure_hPa[heard])
    track = Navigator(level_oracle, CONFIG).run(replace(house.sequence, barometer=silent))
    truth = house.sequence.truth.at(track.time).position_W[:, 2]
    error = track.trajectory.position_W[:, 2] - truth
    error -= error[0]
    sigma = np.sqrt(track.covariance[:, 8, 8])
    assert np.abs(error).max() > 2.0
    assert np.all(np.abs(error) < 3.5 * sigma + 0.3)
    assert abs(error[-1]) < 1.0
    start, _ = track.health.pressure_silence
    assert start == pytest.approx(
        barometer.time[heard][np.diff(heard.nonzero()[0]).argmax()], abs=1
    )
    assert "pressure_silent" in [found.code for found in health_findings(track.health)]


@pytest.mark.parametrize("kind", ["late", "silent", "stuck"])
def test_what_the_barometer_did_not_hear_of_a_ride_is_uncertain(
    house, level_oracle, house_track, kind
):
    """Late, silent, or stuck in a lift: nobody knows whether one climbs, and sigma says so."""
    air, ride = house.sequence.barometer, house_track.health.floors[-1]
    middle = 0.5 * (ride.start + ride.stop)
    start, stop = {"late": (0.0, ride.stop)}.get(kind, (middle - 3.0, middle + 3.0))
    unheard = (air.time > start) & (air.time < stop)
    if kind == "stuck":
        pressures = np.where(unheard, air.pressure_hPa[unheard][0], air.pressure_hPa)
        air = Barometer(air.time, pressures)
    else:
        air = Barometer(air.time[~unheard], air.pressure_hPa[~unheard])
    track = Navigator(level_oracle, CONFIG).run(replace(house.sequence, barometer=air))
    error = track.trajectory.position_W[:, 2]
    error = error - house.sequence.truth.at(track.time).position_W[:, 2]
    sigma = np.sqrt(track.covariance[:, 8, 8])
    assert np.all(np.abs(error - error[0]) < 4.0 * sigma + 0.2)


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_a_door_during_a_ride_moves_the_air_and_not_the_track(
    house, level_oracle, house_track, share
):
    """The accelerometer says how fast the lift is: what jumps beside is the air, by 2.5 m here."""
    barometer, ride = house.sequence.barometer, house_track.health.floors[-1]
    shut = barometer.time > ride.start + share * (ride.stop - ride.start)
    air = Barometer(barometer.time, barometer.pressure_hPa + 0.3 * shut)
    track = Navigator(level_oracle, CONFIG).run(replace(house.sequence, barometer=air))
    assert climb_error(track, house.sequence) < 1.2
    assert track.health.floors[-1].after == ride.after


def test_floors_are_those_of_the_house(house, house_track):
    found = [(change.after, change.how) for change in house_track.health.floors]
    assert found == [(stay.floor, stay.way) for stay in house.stays[2:]]
    stays = house.stays[1:-1], house.stays[2:]
    for change, before, after in zip(house_track.health.floors, *stays, strict=True):
        assert change.start == pytest.approx(before.stop, abs=7.0)  # one waits for the lift
        assert change.stop == pytest.approx(after.start, abs=4.0)
    assert any(str(change) in str(house_track.health) for change in house_track.health.floors)


@pytest.mark.slow
def test_the_check_of_heights_tells_with_from_without(house, level_oracle):
    scores = score_heights(level_oracle, house.sequence, CONFIG)
    assert values(scores, "height_rms", track="pressure")[0] < 0.6
    assert values(scores, "height_rms", track="none")[0] > 2.0
    assert values(scores, "floors", track="pressure")[0] == 1.0
    assert "pressure" in heights_table(scores)
    with pytest.raises(InputError, match="recording"):
        score_heights(level_oracle, replace(house.sequence, barometer=None), CONFIG)


def test_the_report_draws_floors_along_the_height(house_track):
    series = track_series(house_track.trajectory, 0.0)
    panels = motion_panels({"track": series}, None, house_track.health.floors)
    labels = [trace.text[0] for trace in panels[0].traces if trace.text]
    assert labels == ["floor 0", "1", "4"]


@pytest.mark.parametrize("backend", ["ekf", pytest.param("graph", marks=pytest.mark.slow)])
def test_a_stream_has_the_heights_of_the_recording(house, level_oracle, house_track, backend):
    sequence, states = house.sequence.slice(45.0, 72.0), []
    waiting = list(zip(sequence.barometer.time, sequence.barometer.pressure_hPa, strict=True))
    stream = Navigator(level_oracle, CONFIG, backend=backend)
    for k, row in enumerate(samples(sequence)):
        while waiting and waiting[0][0] <= row[0]:
            stream.push_pressure(*waiting.pop(0))
        if k == len(sequence) // 2:
            restored = Navigator(level_oracle, CONFIG, backend=backend)
            restored.restore(stream.snapshot())
            stream = restored
        if (state := stream.push(*row)) is not None:
            states.append(state)
    heights = np.array([state.p_W[2] for state in states])
    expected = house_track.filtered
    same = np.interp([s.time for s in states], expected.time, expected.trajectory.position_W[:, 2])
    tolerance = 1e-6 if backend == "ekf" else 0.6
    np.testing.assert_allclose(heights, same, atol=tolerance)
    assert stream.health.pressures["applied"] > 45


def test_weather_and_doors_on_a_level_floor_are_worth_their_sigma(make_walk):
    walk = make_walk(seed=4, seconds=60.0, rate=50.0)
    doors = np.array([20.0, 40.0])
    air = simulate_barometer(walk.truth, doors, 1, weather=0.03, door=0.5)
    with_air = replace(walk, barometer=air)
    track = Navigator(Still(variance=(4.0, 4.0, 1e-3)), CONFIG).run(with_air)
    assert climb_error(track, with_air) < 1.0


@pytest.mark.parametrize(
    ("pressure", "unit"), [(101_325.0, "Pa"), (101.325, "kPa"), (29.92, "inHg")]
)
def test_pressures_in_other_units_are_refused(pressure, unit, still_model):
    with pytest.raises(InputError, match=f"from {unit} to hPa"):
        Navigator(still_model).push_pressure(0.0, pressure)


def test_late_and_broken_pressures_are_counted(make_walk, still_model):
    stream = Navigator(still_model)
    states_of(stream, make_walk(seconds=5.0).select(slice(400)))
    stream.push_pressure(3.9, 1000.0)
    wrong = (np.nan, 1000.0), (3.95, np.nan), (1.0, 1000.0), (3.9, 1000.0)
    for time, pressure in wrong:
        stream.push_pressure(time, pressure)
    assert stream.health.pressures_dropped == len(wrong)
    with pytest.raises(InputError, match="a number of hPa"):
        stream.push_pressure(4.0, "1000")


def test_a_barometer_on_another_clock_is_said_to_be_unused(make_walk, still_model):
    walk = make_walk(seconds=5.0)
    time = walk.time[::20] + 1.7e9
    other = Barometer(time, standard_pressure(np.zeros(len(time))))
    health = Navigator(still_model).run(replace(walk, barometer=other)).health
    assert health.pressures_dropped == len(time)
    assert not health.pressures


@pytest.mark.parametrize(
    ("rate", "speed", "share"),
    [
        (0.0, 1.2, 1.0),  # a floor
        (0.3, 1.2, 0.3 / 0.6 / 1.2),  # stairs, on which the network walks as on a floor
        (-0.3, 1.2, 0.3 / 0.6 / 1.2),
        (0.5, 0.7, 1.0),  # an escalator
        (1.5, 0.1, 1.0),  # a lift
        (0.09, 1.2, 1.0),  # a ramp
    ],
)
def test_on_stairs_a_displacement_is_as_long_as_the_climb_allows(rate, speed, share):
    network = WindowDisplacement(np.array([0.6, 0.8, 0.0]) * speed, 0.01 * np.eye(3), np.eye(3))
    found = yielding(network, rate)
    np.testing.assert_allclose(found.d_N, share * network.d_N, atol=1e-12)
    assert found.covariance_N[2, 2] > network.covariance_N[2, 2]
    np.testing.assert_array_equal(found.covariance_N[:2, :2], network.covariance_N[:2, :2])
