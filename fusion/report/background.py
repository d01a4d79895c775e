"""The map's place on the earth: north arrow, and tiles of a map server as a background."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import plotly.graph_objects as go

from stario.sequences.errors import InputError
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import FloatArray

INK = "#222222"
_EQUATOR_M = 40_075_016.7
_TILES_ACROSS = 4
"""Largest number of tiles across the drawn part."""

_LARGEST_ZOOM = 19
"""Zoom up to which public servers have tiles."""

_MARGIN = 0.5
"""Width of the background beyond the drawn part, relative to that: what a wide window shows."""


def check_tiles(url: str) -> str:
    """Return the address of a tile server.

    Raises:
        InputError: it is not one of HTTP, or lacks a place for zoom, column or row.
    """
    complete = all(f"{{{name}}}" in url for name in "zxy")
    if not complete or urlsplit(url).scheme not in ("http", "https"):
        expected = "an address such as https://tile.openstreetmap.org/{z}/{x}/{y}.png"
        raise InputError("--tiles", repr(url), expected)
    return url


def add_place(figure: go.Figure, place: Georeference, tiles: str) -> None:
    """Draw an arrow to the north, which is upwards, and the tiles of a map server if asked for.

    The browser asks the server when it opens the report.

    Args:
        figure: the figure, with the limits of its axes [m].
        place: where its origin lies.
        tiles: address of a tile, with {z}, {x} and {y}; empty for none.
    """
    note = {"xref": "paper", "yref": "paper"}
    arrow = {"ax": 0, "ay": -34, "arrowside": "start", "arrowwidth": 2, "arrowcolor": INK}
    figure.add_annotation(text="N", x=0.98, y=0.9, bgcolor="white", **arrow, **note)
    if tiles:
        limits = np.array([figure.layout.xaxis.range, figure.layout.yaxis.range], dtype=np.float64)
        figure.update_layout(images=[*tile_images(place, limits, tiles)])
        look = {"showarrow": False, "bgcolor": "rgba(255,255,255,0.8)", "font": {"size": 11}}
        figure.add_annotation(text=f"map: {urlsplit(tiles).hostname}", x=1.0, y=0.0, **look, **note)


def tile_images(place: Georeference, limits: FloatArray, url: str) -> Iterator[dict[str, Any]]:
    """Yield a map's tiles as images of a plotly figure with x east and y north.

    Args:
        place: where the figure's origin lies.
        limits: (2, 2) lower and upper limit of its x axis and of its y axis [m]; the tiles reach
            beyond them by half of their width.
        url: address of a tile, with {z}, {x} and {y}.
    """
    span = float(np.ptp(limits, axis=1).max())
    middle, half = limits.mean(axis=1), (0.5 + _MARGIN) * span
    corners = np.stack([middle - half, middle + half])
    width = _EQUATOR_M * math.cos(math.radians(place.latitude_deg))
    zoom = min(_LARGEST_ZOOM, math.floor(math.log2(_TILES_ACROSS * width / span)))
    (left, bottom), (right, top) = _tile_of(place.latlon_deg(corners), zoom)
    for x, y in product(range(int(left), int(right) + 1), range(int(top), int(bottom) + 1)):
        ends = place.xy(_latlon_of(np.array([[x, y], [x + 1, y + 1]]), zoom))
        address = url.replace("{z}", str(zoom)).replace("{x}", str(x)).replace("{y}", str(y))
        (west, north), (wide, high) = ends[0], abs(ends[1] - ends[0])
        fixed = {"xref": "x", "yref": "y", "sizing": "stretch", "layer": "below"}
        yield {"source": address, "x": west, "y": north, "sizex": wide, "sizey": high, **fixed}


def _tile_of(latlon_deg: FloatArray, zoom: int) -> FloatArray:
    """Return column and row (N, 2) of places (N, 2) [deg] in the tiles of a zoom (Web Mercator)."""
    latitude, longitude = np.radians(latlon_deg).T
    x = 0.5 * (1.0 + longitude / math.pi)
    y = 0.5 * (1.0 - np.arcsinh(np.tan(latitude)) / math.pi)
    return np.asarray(2.0**zoom * np.column_stack([x, y]))


def _latlon_of(tile: FloatArray, zoom: int) -> FloatArray:
    """Return the place (N, 2) [deg] of the upper left corner of tiles (N, 2): the inverse."""
    x, y = (tile / 2.0**zoom).T
    latitude = np.arctan(np.sinh(math.pi * (1.0 - 2.0 * y)))
    return np.asarray(np.degrees(np.column_stack([latitude, math.pi * (2.0 * x - 1.0)])))
