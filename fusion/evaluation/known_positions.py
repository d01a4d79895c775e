"""A track against positions known without attitude: waypoints, or a track of satellites."""

from __future__ import annotations

import numpy as np

from stario.fusion.evaluation.displacement_error import fit_yaw_and_position
from stario.fusion.state import Track
from stario.sequences.sequence import PositionTrack

LEAST = 2
"""One position is met by a shift alone; of two the distance is compared."""


def position_error(track: Track, known: PositionTrack) -> tuple[float, int]:
    """Horizontal error at the known positions, after a fit of yaw and position.

    Args:
        track: of the same recording.
        known: positions or waypoints.

    Returns:
        Root mean square [m], NaN where fewer than `LEAST` lie within the track; and how many do.
    """
    inside = known.valid & (known.time >= track.time[0]) & (known.time <= track.time[-1])
    time, truth = known.time[inside], known.position_W[inside]
    if len(time) < LEAST:
        return float("nan"), len(time)
    x, y = (np.interp(time, track.time, track.trajectory.position_W[:, k]) for k in (0, 1))
    truth_xy = truth[:, 0] + 1j * truth[:, 1]
    away = fit_yaw_and_position(x + 1j * y, truth_xy) - truth_xy
    return float(np.sqrt(np.mean(np.abs(away) ** 2))), len(time)


def position_error_words(track: Track, known: PositionTrack) -> str:
    """The same for a person."""
    error, count = position_error(track, known)
    of = f"{count} of {int(known.valid.sum())} {known.kind} lie within the track"
    if np.isnan(error):
        return f"{of}: too few to compare with"
    return f"{of}: {error:.2f} m rms off them, after a fit of yaw and position"
