from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import support

from stario.fusion import Navigator, PlaceConfig, Track, position_fix
from stario.fusion.values.satellites import satellite_fixes
from stario.sequences.errors import ConfigError, InputError
from stario.sequences.geodesy import Georeference
from stario.sequences.readers.checked import RADIUS_PER_SIGMA
from stario.sequences.sequence import FloatArray, ImuSequence, PositionTrack, Satellites

TIME = np.arange(0.0, 60.0)
PLACE = Georeference(48.1, 11.5)
USED = replace(support.GRAPH, place=PlaceConfig(satellites="use"))


def reported(xy: FloatArray, time: FloatArray = TIME, **columns: Any) -> Satellites:
    return Satellites(time, PLACE.latlon_deg(xy), **columns)


def straight(speed: float = 1.3) -> FloatArray:
    """A walk eastwards (60, 2) [m]."""
    return np.column_stack([speed * TIME, 0.0 * TIME])


def information(found: Any, axis: int = 0) -> float:
    """How much all positions tell together about a coordinate that does not change [1/m^2]."""
    positions = [fix for fix in found.fixes if fix.kind == "position"]
    return float(sum(1.0 / fix.covariance[axis, axis] for fix in positions))


def test_positions_are_metres_east_and_north_of_the_first():
    found = satellite_fixes(reported(straight(), altitude_m=np.full(60, 520.0)))
    xy = np.array([fix.value[:2] for fix in found.fixes])
    np.testing.assert_allclose(xy, straight(), atol=1e-3)
    np.testing.assert_allclose(found.origin.latlon_deg(np.zeros((1, 2))), [[48.1, 11.5]])
    assert found.origin.altitude_m == 520.0


def test_a_minute_of_positions_tells_as_much_at_any_rate():
    """They share their error: ten a second are not ten times as much."""
    radius = 6.0
    once = satellite_fixes(reported(straight(), radius_m=np.full(60, radius)))
    fast = np.arange(0.0, 60.0, 0.1)
    xy = np.column_stack([1.3 * fast, 0.0 * fast])
    often = satellite_fixes(reported(xy, fast, radius_m=np.full(600, radius)))
    assert information(often) == pytest.approx(information(once), rel=0.01)
    assert information(once) < 3.0 / (radius / RADIUS_PER_SIGMA) ** 2


def test_a_position_that_is_held_is_none():
    """Indoors phones repeat the last one, with a small radius."""
    xy = straight()
    xy[20:50] = xy[20]
    found = satellite_fixes(reported(xy, radius_m=np.full(60, 4.0)))
    times = {fix.time for fix in found.fixes}
    assert times == {*range(20), *range(50, 60)}
    assert satellite_fixes(reported(np.tile(xy[20], (60, 1)))) is None


def test_positions_without_a_radius_count_little_and_those_of_cells_not_at_all():
    radius = np.full(60, 4.0)
    radius[10:20], radius[20], radius[40] = 200.0, -1.0, 0.0
    found = satellite_fixes(reported(straight(), radius_m=radius))
    times = [fix.time for fix in found.fixes]
    assert not {*range(10, 21)} & {*times}
    unknown, good = (found.fixes[times.index(t)].covariance[0, 0] for t in (40.0, 41.0))
    assert unknown > 5.0 * good


def test_doppler_velocities_turn_with_the_map():
    """North-east at 2 m/s; the map's x axis points north."""
    columns = {"speed_m_s": np.full(60, 2.0), "bearing_deg": np.full(60, 45.0)}
    found = satellite_fixes(reported(straight(), **columns), Georeference(48.1, 11.5, np.pi / 2))
    velocities = [fix for fix in found.fixes if fix.kind == "velocity"]
    assert 5 <= len(velocities) <= 15
    for fix in velocities:
        np.testing.assert_allclose(fix.value[:2], [np.sqrt(2.0), -np.sqrt(2.0)], atol=1e-9)
    assert min(fix.time for fix in velocities) >= 3.0  # receivers smooth them


@pytest.mark.parametrize(("speed", "bearing"), [(0.2, 45.0), (2.0, 0.0), (2.0, np.nan)])
def test_a_velocity_without_a_direction_is_none(speed, bearing):
    columns = {"speed_m_s": np.full(60, speed), "bearing_deg": np.full(60, bearing)}
    found = satellite_fixes(reported(straight(), **columns))
    assert {fix.kind for fix in found.fixes} == {"position"}


@pytest.fixture(scope="module")
def walk(make_walk):
    """A walk whose receiver is wrong by the same 4 m, and gives velocities in its second half."""
    walk = make_walk(3, 40.0, 50.0)
    there = walk.truth.at(np.arange(1.0, 39.0))
    xy = there.position_W[:, :2] + [4.0, 0.0]
    speed = np.where(there.time < 20.0, np.nan, np.linalg.norm(there.velocity_W[:, :2], axis=1))
    columns = {
        "radius_m": np.full(len(xy), 4.0),
        "speed_m_s": speed,
        "bearing_deg": np.degrees(np.arctan2(there.velocity_W[:, 0], there.velocity_W[:, 1])),
    }
    return replace(walk, satellites=reported(xy, there.time, **columns))


@pytest.fixture(scope="module")
def model(walk, make_oracle):
    return make_oracle(walk, walk.truth, USED)


def error(track: Track, walk: ImuSequence) -> FloatArray:
    """Horizontal error (N,) [m] in the map, in which the walk's own origin is the place's."""
    there = PLACE.xy(track.georeference.latlon_deg(track.trajectory.position_W))
    return np.linalg.norm(there - walk.truth.at(track.time).position_W[:, :2], axis=1)


def test_a_track_with_satellites_lies_on_the_map_from_its_start(walk, model):
    track = Navigator(model, USED).run(walk)
    assert error(track, walk).max() < 6.0
    sigma = np.sqrt(np.trace(track.trajectory.position_covariance_W[:, :2, :2], axis1=1, axis2=2))
    assert (error(track, walk) < 3.0 * sigma).all()
    # The smoother uses positions from before the direction was known.
    assert track.health.fixes["applied"] >= 38
    # They have no height: the track's own is still that above the start.
    assert track.health.final_sigma["height_m"] < 5.0


def test_satellites_that_are_not_used_change_nothing(walk, model):
    short = walk.slice(0.0, 10.0)
    navigator, blind = Navigator(model, support.GRAPH), replace(short, satellites=None)
    plain, without = (navigator.run(each) for each in (short, blind))
    np.testing.assert_array_equal(plain.trajectory.position_W, without.trajectory.position_W)
    assert plain.georeference is None


def test_positions_that_never_tell_a_direction_do_not_bend_the_track(walk, model):
    """A receiver in a basement, whose position creeps through the house above."""
    creeping = np.column_stack([0.05 * TIME, 0.1 * TIME])[1:38]
    satellites = reported(creeping, TIME[1:38], radius_m=np.full(37, 15.0))
    plain = Navigator(model, support.GRAPH).run(walk)
    track = Navigator(model, USED).run(replace(walk, satellites=satellites))
    assert support.ate(track, walk, "yaw") < 1.02 * support.ate(plain, walk, "yaw") + 0.01


def test_waypoints_are_fixes_where_they_are_used(walk, model):
    there = walk.truth.at(np.array([5.0, 15.0, 27.0, 37.0]))
    xy = there.position_W[:, :2]
    waypoints = PositionTrack(there.time, xy, "waypoints", latlon_deg=PLACE.latlon_deg(xy))
    config = replace(support.GRAPH, place=PlaceConfig(waypoints="use"))
    track = Navigator(model, config).run(replace(walk, satellites=None, positions=waypoints))
    assert error(track, walk).max() < 2.0


def test_metres_beside_degrees_need_an_origin(walk, model):
    fix = [position_fix(10.0, [1.0, 2.0, 0.0], np.eye(3))]
    with pytest.raises(InputError, match="origin"):
        Navigator(model, USED).run(walk, fixes=fix)
    placed = replace(USED, place=replace(USED.place, origin=(48.1, 11.5)))
    track = Navigator(model, placed, backend="ekf").run(walk.slice(0.0, 12.0), fixes=fix)
    assert track.georeference == PLACE


WRONG = {"satellites": "always", "waypoints": "ignore", "origin": (48.1,), "closed": "yes"}


@pytest.mark.parametrize(
    ("name", "value"), [*WRONG.items(), ("origin", (11.5, 948.1)), ("origin", (0.0, -181.0))]
)
def test_an_unknown_use_or_place_is_refused(name, value):
    with pytest.raises(ConfigError, match=name):
        PlaceConfig(**{name: value})
