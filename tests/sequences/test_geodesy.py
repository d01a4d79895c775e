"""Maps on the earth: metres and degrees are each other's inverse, and as long as they are."""

import numpy as np
import pytest

from stario.sequences.errors import InputError
from stario.sequences.geodesy import Georeference, east_north


def test_a_degree_has_its_length_on_the_ellipsoid():
    at_equator = east_north(np.array([[0.0, 7.0], [0.01, 7.0], [0.0, 7.01]]))[1:]
    np.testing.assert_allclose(at_equator, [[0.0, 1105.743], [1113.195, 0.0]], atol=0.01)


@pytest.mark.parametrize("latitude", [-78.0, 0.0, 48.1, 69.9])
@pytest.mark.parametrize("yaw", [0.0, 2.1])
def test_positions_come_back_from_latitude_and_longitude(latitude, yaw):
    xy = np.array([[0.0, 0.0], [1500.0, -300.0], [-20.0, 900.0]])
    place = Georeference(latitude, 179.999, yaw)
    latlon = place.latlon_deg(np.column_stack([xy, [0.0, 12.0, -3.0]]))
    assert (np.abs(latlon[:, 1]) <= 180.0).all()
    np.testing.assert_allclose(place.xy(latlon), xy, atol=1e-3)


def test_yaw_turns_the_x_axis_counter_clockwise_from_east():
    north = Georeference(48.0, 11.0, np.radians(90.0)).latlon_deg(np.array([[100.0, 0.0]]))[0]
    assert north[0] > 48.0005
    assert north[1] == pytest.approx(11.0, abs=1e-9)


@pytest.mark.parametrize("wrong", [(91.0, 0.0), (0.0, 361.0), (np.nan, 0.0), (0.0, 0.0, 500.0)])
def test_what_is_no_place_is_refused(wrong):
    with pytest.raises(InputError, match="georeference"):
        Georeference(*wrong)
