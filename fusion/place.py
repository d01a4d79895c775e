"""Fixes from what a recording holds beside its IMU, and where on the earth they place its track."""

from __future__ import annotations

import logging

import numpy as np

from stario.fusion.recording import PreprocessedRecording
from stario.fusion.values.config import PlaceConfig
from stario.fusion.values.fixes import UNKNOWN_HEIGHT, Fix, position_fix
from stario.fusion.values.satellites import satellite_fixes
from stario.sequences.errors import InputError
from stario.sequences.geodesy import Georeference
from stario.sequences.sequence import FloatArray, ImuSequence, PositionTrack

log = logging.getLogger(__name__)

_WAYPOINT_SIGMA = 1.0
"""Standard deviation per axis [m] of a waypoint that states none: where one stood and tapped."""


def known_fixes(
    recording: PreprocessedRecording, place: PlaceConfig, fixes: list[Fix]
) -> tuple[list[Fix], Georeference | None]:
    """Return the fixes of a recording, with those of its own that are to be used, and their map.

    Raises:
        InputError: there are positions in metres and others in degrees, but no origin.
    """
    origin, found = place.georeference, list(fixes)
    metres = origin is None and any(fix.kind == "position" for fix in fixes)
    positions = used_positions(recording, place)
    if place.waypoints == "use" and positions is None:
        log.warning("no waypoint is used: the recording has none")
    if positions is not None:
        xy, origin = _in_map(positions, origin)
        found += _waypoint_fixes(positions, xy)
        metres |= origin is None
    if place.satellites == "use":
        reported = recording.satellites
        satellites = None if reported is None else satellite_fixes(reported, origin)
        if satellites is None:
            log.warning("no satellite position is used: the recording has none to rely on")
        else:
            found, origin = found + satellites.fixes, satellites.origin
    if metres and origin is not None:
        raise InputError(
            "fixes",
            "positions in metres, and others in degrees",
            "the latitude and longitude of the metres' zero",
            "give the origin",
        )
    return found, origin


def used_positions(
    known: ImuSequence | PreprocessedRecording, place: PlaceConfig
) -> PositionTrack | None:
    """Return a recording's known positions that are fixes, but not those of its satellites."""
    return None if place.waypoints != "use" or _of_satellites(known) else known.positions


def compared_with(sequence: ImuSequence, place: PlaceConfig) -> PositionTrack | None:
    """Return the known positions that a track may be compared with: those that it did not use."""
    if used_positions(sequence, place) is not None:
        return None
    unused = not _of_satellites(sequence) or place.satellites == "compare"
    return sequence.positions if unused else None


def _of_satellites(known: ImuSequence | PreprocessedRecording) -> bool:
    """Return whether known positions are those of the recording's satellites, if it has any."""
    positions, satellites = known.positions, known.satellites
    return satellites is not None and positions is not None and positions.kind == "positions"


def used_words(sequence: ImuSequence, place: PlaceConfig) -> tuple[str, ...]:
    """Return which of a recording's own positions are used as fixes, in words."""
    used = place.satellites == "use" and sequence.satellites is not None
    positions = used_positions(sequence, place)
    words = ("satellite positions",) if used else ()
    return words if positions is None else (*words, positions.kind)


def _in_map(
    positions: PositionTrack, origin: Georeference | None
) -> tuple[FloatArray, Georeference | None]:
    """Return known positions (N, 2) [m] in the map, and where it lies if they have coordinates."""
    latlon = positions.latlon_deg
    known = positions.valid & (latlon is not None and np.isfinite(latlon).all(axis=1))
    if latlon is None or not known[positions.valid].all():
        return positions.position_W[:, :2], origin
    origin = origin or Georeference(*latlon[known][0].tolist())
    return origin.xy(latlon), origin


def _waypoint_fixes(positions: PositionTrack, xy: FloatArray) -> list[Fix]:
    """Return the fixes of positions at (N, 2) [m]; their heights, if any, are not used."""
    usual = np.full(len(positions), _WAYPOINT_SIGMA)
    sigma = usual if positions.sigma is None else positions.sigma
    return [
        position_fix(time, [x, y, 0.0], np.diag(np.square([s, s, UNKNOWN_HEIGHT])))
        for time, (x, y), s, valid in zip(positions.time, xy, sigma, positions.valid, strict=True)
        if valid
    ]
