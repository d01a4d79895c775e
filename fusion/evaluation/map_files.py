"""A track as files for maps: GeoJSON (RFC 7946) and GPX 1.1, in latitude and longitude."""

from __future__ import annotations

import json
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from stario.fusion.values.state import Track
from stario.sequences.drawing.figures import split_at_gaps, split_at_nan
from stario.sequences.files import atomic_write
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import FloatArray, whole_seconds

_UNIX_TIME = (3e8, 4e9)
"""Times [s] that are taken for seconds since 1970: from 1979 to 2096."""

_NAMESPACE = "https://github.com/stario-nav/stario"


def on_map(track: Track, georeference: Georeference) -> list[FloatArray]:
    """Place a track on the map, whose frame lies at `georeference`, about a point per second.

    Returns:
        Stretches (n, 7) between gaps: time [s], latitude and longitude [deg], height above the
        map's zero [m], altitude [m], NaN where unknown, and standard deviations of position (in the
        direction of the largest) and height [m], zero where unknown.
    """
    trajectory = track.trajectory
    latlon = georeference.latlon_deg(trajectory.position_W)
    sigma = np.zeros((len(trajectory), 2))
    if trajectory.position_covariance_W is not None:
        P = trajectory.position_covariance_W
        horizontal = np.linalg.eigvalsh(P[:, :2, :2])[:, 1]
        sigma = np.sqrt(np.maximum(np.column_stack([horizontal, P[:, 2, 2]]), 0.0))
    columns = np.column_stack([trajectory.time, latlon, trajectory.position_W[:, 2], sigma])
    ticks = np.append(whole_seconds(trajectory.time), trajectory.time[-1])
    rows = np.unique(np.searchsorted(trajectory.time, ticks))
    rows = rows[trajectory.valid[rows]]
    _, split = split_at_gaps(trajectory.time[rows], columns[rows], max_gap=2.0)
    zero = georeference.altitude_m
    return [np.insert(part, 4, zero + part[:, 3], axis=1) for part in split_at_nan(split)]


def write_geojson(path: Path, name: str, parts: list[FloatArray]) -> Path:
    """Write a track, as of `on_map`, as GeoJSON: the line, its start and its end.

    The line's properties hold lists, one value per point: seconds of the recording's clock, height
    above the map's zero and standard deviations [m].
    """
    lines = [_coordinates(part) for part in parts]
    columns = np.vstack(parts).T
    properties: dict[str, object] = {"name": name}
    names = {"time_s": 0, "height_m": 3, "sigma_m": 5, "height_sigma_m": 6}
    # Zero is added to what is rounded, here and below, so that none becomes -0.0.
    properties |= {key: (columns[k].round(3) + 0.0).tolist() for key, k in names.items()}
    line: dict[str, Any] = {"type": "MultiLineString", "coordinates": lines}
    if len(lines) == 1:
        line = {"type": "LineString", "coordinates": lines[0]}
    ends = {"start": lines[0][0], "end": lines[-1][-1]}
    features = [
        _feature(line, properties),
        *(_feature({"type": "Point", "coordinates": c}, {"name": k}) for k, c in ends.items()),
    ]
    with atomic_write(path) as file:
        json.dump({"type": "FeatureCollection", "features": features}, file, separators=(",", ":"))
    return path


def _feature(geometry: dict[str, Any], properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def _coordinates(part: FloatArray) -> list[list[float]]:
    """Return longitude, latitude and, if known, altitude; a line has two points at least."""
    digits = np.column_stack([part[:, [2, 1]].round(8), part[:, 4].round(2)]) + 0.0
    listed: list[list[float]] = digits[:, : 2 if np.isnan(part[0, 4]) else 3].tolist()
    return listed if len(listed) > 1 else 2 * listed


def write_gpx(path: Path, name: str, parts: list[FloatArray]) -> Path:
    """Write a track, as of `on_map`, as GPX, with a segment for each stretch between gaps.

    Points have times if the recording's clock counts seconds since 1970. Their elevation is above
    the map's zero if its altitude is unknown; standard deviations [m] are in `extensions`.
    """
    from gpxpy.gpx import GPX, GPXTrack, GPXTrackSegment

    above = "above the start" if np.isnan(parts[0][0, 4]) else "as the receiver counts altitudes"
    gpx, track = GPX(), GPXTrack(name, f"Estimated by StarIO; elevation {above}.")
    gpx.creator = "StarIO"
    gpx.nsmap["stario"] = _NAMESPACE
    track.segments = [GPXTrackSegment(list(_points(part))) for part in parts]
    gpx.tracks.append(track)
    with atomic_write(path) as file:
        file.write(gpx.to_xml(version="1.1"))
    return path


def _points(part: FloatArray) -> Iterator[Any]:
    from gpxpy.gpx import GPXTrackPoint

    for time, latitude, longitude, height, altitude, *sigmas in part.tolist():
        known = _UNIX_TIME[0] < time < _UNIX_TIME[1]
        point = GPXTrackPoint(
            round(latitude, 8) + 0.0,
            round(longitude, 8) + 0.0,
            round(height if np.isnan(altitude) else altitude, 2) + 0.0,
            datetime.fromtimestamp(time, UTC) if known else None,
        )
        for tag, sigma in zip(("sigma", "height_sigma"), sigmas, strict=True):
            element = ElementTree.Element(f"{{{_NAMESPACE}}}{tag}")
            element.text = f"{sigma:.2f}"
            point.extensions.append(element)
        yield point
