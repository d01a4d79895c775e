"""Tiles of a map server lie where they belong, and cover what a window shows."""

import plotly.graph_objects as go
import pytest

from stario.fusion.report.background import add_place, check_tiles
from stario.sequences.errors import InputError
from stario.sequences.geodesy import Georeference

URL = "https://tiles.example/{z}/{x}/{y}.png"


@pytest.mark.parametrize("size", [30.0, 400.0, 3000.0])
def test_tiles_lie_side_by_side_and_cover_the_drawn_part(size: float) -> None:
    """A tile's address tells its place: columns count eastwards from 180 degrees west."""
    figure = go.Figure()
    figure.update_xaxes(range=[-size, size])
    figure.update_yaxes(range=[-0.2 * size, 0.2 * size])
    add_place(figure, Georeference(51.4779, 0.001), URL)
    images = figure.layout.images
    assert 4 <= len(images) <= 100
    left, top = min(i.x for i in images), max(i.y for i in images)
    right, bottom = max(i.x + i.sizex for i in images), min(i.y - i.sizey for i in images)
    assert left < -size
    assert right > size
    assert bottom < -size
    assert top > size
    area = sum(i.sizex * i.sizey for i in images)
    assert area == pytest.approx((right - left) * (top - bottom), rel=0.03)
    zoom, x, _ = map(int, images[0].source.removesuffix(".png").split("/")[-3:])
    west = 360.0 * x / 2**zoom - 180.0
    assert images[0].x == pytest.approx((west - 0.001) * 69_500.0, rel=0.01, abs=2.0)


@pytest.mark.parametrize("url", ["tiles", "https://tiles.example/{z}/{x}.png", "file:///{z}{x}{y}"])
def test_what_is_no_map_server_is_refused(url: str) -> None:
    with pytest.raises(InputError, match="--tiles"):
        check_tiles(url)
