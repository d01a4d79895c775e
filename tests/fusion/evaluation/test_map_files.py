import re
from dataclasses import replace
from datetime import UTC, datetime

import geojson
import gpxpy
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.known_positions import fitted_georeference
from stario.fusion.evaluation.map_files import on_map, write_geojson, write_gpx
from stario.fusion.values.state import Track
from stario.sequences import Georeference, PositionTrack, Trajectory

PLACE = Georeference(48.1, 11.5, altitude_m=520.0)


def straight(start: float = 0.0, gap: bool = False) -> Track:
    """Twenty seconds eastwards at 2 m/s, climbing 0.1 m/s, perhaps with a gap from 10 to 14 s."""
    time = np.arange(0.0, 20.05, 0.1)
    if gap:
        time = time[(time < 10.0) | (time > 14.0)]
    position = np.column_stack([2.0 * time, 0.0 * time, 0.1 * time])
    covariance = np.tile(np.diag([9.0, 4.0, 1.0]), (len(time), 1, 1))
    attitude = Rotation.identity(len(time))
    return Track(Trajectory(start + time, position, attitude, position_covariance_W=covariance))


def test_geojson_is_valid_and_holds_the_track(tmp_path):
    path = write_geojson(tmp_path / "t.geojson", "walk", on_map(straight(), PLACE))
    found = geojson.loads(path.read_text())
    assert found.is_valid, found.errors()
    line, start, end = found.features
    assert line.geometry.type == "LineString"
    coordinates = np.array(line.geometry.coordinates)
    np.testing.assert_allclose(PLACE.xy(coordinates[:, [1, 0]])[-1], [40.0, 0.0], atol=0.01)
    np.testing.assert_allclose(coordinates[[0, -1], 2], [520.0, 522.0], atol=0.01)
    properties = line.properties
    assert properties["name"] == "walk"
    assert properties["time_s"] == list(range(21))
    assert set(properties["sigma_m"]) == {3.0}
    assert start.properties["name"] == "start"
    assert list(end.geometry.coordinates) == coordinates[-1].tolist()


@pytest.mark.parametrize("start", [0.0, 1_700_000_000.0])
def test_gpx_is_read_with_heights_and_with_times_where_they_are_known(tmp_path, start):
    path = write_gpx(tmp_path / "t.gpx", "walk & talk", on_map(straight(start), PLACE))
    gpx = gpxpy.parse(path.read_text())
    assert gpx.tracks[0].name == "walk & talk"
    (segment,) = gpx.tracks[0].segments
    assert segment.length_2d() == pytest.approx(40.0, abs=0.3)
    last = segment.points[-1]
    assert last.elevation == pytest.approx(522.0)
    expected = datetime.fromtimestamp(start + 20.0, UTC) if start else None
    assert last.time == expected
    assert [element.text for element in last.extensions] == ["3.00", "1.00"]


def test_no_number_is_minus_zero(tmp_path):
    """As of a track just below and west of the zero of map and coordinates."""
    shifted = straight()
    place = shifted.trajectory.position_W * 1e-5 - np.array([1e-5, 1e-5, 1e-3])
    below = Track(replace(shifted.trajectory, position_W=place))
    for write in (write_geojson, write_gpx):
        path = write(tmp_path / "t", "walk", on_map(below, Georeference(0.0, 0.0, altitude_m=0.0)))
        assert not re.search(r"-0\.0+(?!\d)", path.read_text())


def test_a_gap_parts_the_line(tmp_path):
    found = on_map(straight(gap=True), Georeference(48.1, 11.5))
    gpx = gpxpy.parse(write_gpx(tmp_path / "t.gpx", "walk", found).read_text())
    assert [s.length_2d() < 20.0 for s in gpx.tracks[0].segments] == [True, True]
    line = geojson.loads(write_geojson(tmp_path / "t.geojson", "walk", found).read_text())[0]
    assert line.geometry.type == "MultiLineString"
    assert line.geometry.is_valid
    assert len(line.geometry.coordinates[0][0]) == 2  # no altitude is known
    assert len(line.properties["time_s"]) == sum(map(len, line.geometry.coordinates))


def test_waypoints_with_coordinates_place_a_track_that_did_not_use_them():
    place = Georeference(48.1, 11.5, np.radians(90.0))
    xy = np.array([[2.0, 0.0], [20.0, 0.0], [38.0, 0.0]])
    time = np.array([1.0, 10.0, 19.0])
    known = PositionTrack(time, xy + 7.0, "waypoints", latlon_deg=place.latlon_deg(xy))
    found = fitted_georeference(straight(), known)
    assert found.yaw == pytest.approx(np.radians(90.0), abs=1e-4)
    np.testing.assert_allclose([found.latitude_deg, found.longitude_deg], [48.1, 11.5], atol=1e-7)


def test_waypoints_at_one_place_do_not_tell_a_direction():
    xy = np.array([[0.0, 0.0], [1.0, 0.0]])
    known = PositionTrack(np.array([1.0, 19.0]), xy, "waypoints", latlon_deg=PLACE.latlon_deg(xy))
    assert fitted_georeference(straight(), known) is None
