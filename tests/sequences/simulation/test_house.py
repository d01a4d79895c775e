import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.sequences.geodesy import Georeference, east_north, turned
from stario.sequences.sequence import FloatArray, Trajectory
from stario.sequences.simulation.house import SHORTEST, simulate_house
from stario.sequences.simulation.outside_sensors import (
    LASTING_S,
    STREET,
    simulate_barometer,
    simulate_satellites,
)
from stario.sequences.units import standard_pressure

METRES_PER_HPA = 8.43
STILL_AIR = {"weather": 0.0, "door": 0.0, "noise": 0.0}


@pytest.fixture(scope="module")
def walk():
    return simulate_house(2, 120.0, rate=50.0)


def standing(seconds: float) -> Trajectory:
    time = np.arange(0.0, seconds, 0.1)
    return Trajectory(time, np.zeros((len(time), 3)), Rotation.identity(len(time)))


def height(pressure_hPa: FloatArray) -> FloatArray:
    return METRES_PER_HPA * (pressure_hPa[0] - pressure_hPa)


def test_each_stay_is_on_the_level_of_its_floor_which_its_waypoints_name(walk):
    truth = walk.sequence.truth
    assert len({stay.floor for stay in walk.stays}) > 1
    ground = truth.slice(0.0, walk.stays[0].stop).position_W[:, 2].mean()
    for stay in walk.stays:
        level = truth.slice(stay.start + 1.0, stay.stop - 1.0).position_W[:, 2]
        assert level.mean() - ground == pytest.approx(3.0 * stay.floor, abs=0.1)
        assert level.std() < 0.05
    known = walk.sequence.positions
    np.testing.assert_array_equal(known.floor, np.repeat([s.floor for s in walk.stays[1:]], 2))
    np.testing.assert_allclose(known.time, [t for s in walk.stays[1:] for t in (s.start, s.stop)])


def test_the_shortest_walk_changes_floors():
    for seed in range(5):
        stays = simulate_house(seed, SHORTEST, rate=20.0).stays
        assert any(one.floor != stays[0].floor for one in stays)
        assert stays[-1].stop == SHORTEST


@pytest.mark.parametrize("way", ["stairs", "lift"])
def test_stairs_are_climbed_step_by_step_and_a_lift_stands(way):
    """On stairs the trunk bounces at every step; in a lift the accelerometer shows its start."""
    walk = next(w for k in range(9) if (w := simulate_house(k, 120.0, 50.0)).stays[2].way == way)
    sequence, ride = walk.sequence, slice(walk.stays[1].stop + 7.0, walk.stays[2].start - 4.0)
    inside = sequence.truth.slice(ride.start, ride.stop)
    climb = abs(np.polyfit(inside.time, inside.position_W[:, 2], 1)[0])
    force = np.linalg.norm(sequence.slice(ride.start, ride.stop).accel, axis=1)
    assert (0.15 < climb < 0.4) if way == "stairs" else (0.5 < climb < 1.7)
    assert (force.std() > 0.5) == (way == "stairs")


def test_pressure_falls_with_height_as_in_the_standard_atmosphere(walk):
    truth = walk.sequence.truth
    found = simulate_barometer(truth, np.array([30.0]), **STILL_AIR)
    true = truth.at(found.time).position_W[:, 2]
    np.testing.assert_allclose(height(found.pressure_hPa), true - true[0], atol=0.2)
    np.testing.assert_allclose(standard_pressure(np.array([0.0, 1000.0])), [1013.25, 898.75], 1e-4)


def test_weather_doors_and_noise_have_the_stated_sizes():
    trajectory = standing(6000.0)
    wandered = height(simulate_barometer(trajectory, door=0.0, noise=0.0).pressure_hPa)[:: 60 * 8]
    assert np.diff(wandered).std() == pytest.approx(0.02 * np.sqrt(60.0), rel=0.3)
    doors = np.arange(30.0, 6000.0, 60.0)
    stepped = simulate_barometer(trajectory, doors, weather=0.0, noise=0.0)
    levels = height(stepped.pressure_hPa)[:: 60 * 8]
    assert np.diff(levels).std() == pytest.approx(0.35 * np.sqrt(2.0), rel=0.3)
    noisy = height(simulate_barometer(trajectory, weather=0.0, door=0.0).pressure_hPa)
    assert noisy.std() == pytest.approx(0.1, rel=0.1)


def test_errors_of_satellites_last_and_are_larger_between_houses():
    trajectory = standing(20_000.0)
    place = Georeference(48.0, 11.0)
    between = trajectory.time > 10_000.0
    found = simulate_satellites(trajectory, place, between)
    error = east_north(np.vstack([[48.0, 11.0], found.latlon_deg]))[1:]
    early, late = error[found.time < 10_000.0], error[found.time > 10_000.0]
    np.testing.assert_allclose(early.std(axis=0), 2.5, rtol=0.15)
    np.testing.assert_allclose(late.std(axis=0), 2.5 * STREET, rtol=0.15)
    for lag, share in ((round(LASTING_S), np.exp(-1.0)), (200, 0.0)):
        kept = np.mean(early[lag:] * early[:-lag]) / np.mean(early**2)
        assert kept == pytest.approx(share, abs=0.15)


def test_a_receiver_agrees_on_where_north_is_and_repeats_its_last_position_indoors(walk):
    found, entered = walk.sequence.satellites, walk.stays[0].stop
    indoors = found.time > entered
    assert 30 < indoors.sum() < len(found) - 20
    assert (found.latlon_deg[indoors] == found.latlon_deg[~indoors][-1]).all()
    assert (found.radius_m[indoors] == 9.0).all()
    assert (np.diff(found.latlon_deg[~indoors], axis=0) != 0.0).all()
    truth, entered = walk.sequence.truth, walk.stays[0].stop
    there = Georeference(48.0, 11.0, yaw=-0.4)
    found = simulate_satellites(truth, there, sigma=0.0).slice(1.0, entered - 1.0)
    bearing = np.radians(found.bearing_deg)
    velocity = found.speed_m_s[:, None] * np.stack([np.sin(bearing), np.cos(bearing)], axis=1)
    place = east_north(found.latlon_deg)
    moved = (place[2:] - place[:-2]) / 2.0
    assert np.sqrt(np.mean(np.square(moved - velocity[1:-1]))) < 0.25
    assert np.sqrt(np.mean(np.square(moved))) > 0.5
    true = truth.at(found.time).position_W
    np.testing.assert_allclose(place, turned((true - true[0])[:, :2], there.yaw), atol=0.02)
