"""Motion-captured walks to drive the simulator with: OxIOD's Vicon tracks without an IMU file.

The capture is at 100 Hz. It loses markers for a few frames now and then, takes the body for its
mirror image for a while (a flip of about 180 degrees) and carries noise of about 0.1 mm, which
differentiated twice at 100 Hz would be many m/s^2. So rows between implausible steps are dropped,
short losses are bridged, the track is cut where it does not continue, and what remains is
smoothed. The body's attitude is that of an arbitrary mount, which
serves the simulator as well as any other; each piece has its own.
"""

from __future__ import annotations

import itertools
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.sequence import FloatArray, Trajectory
from stario.sequences.simulation.imu import sign_continuous

IntArray = NDArray[np.int64]

RATE = 100.0
"""Rows per second of the capture [Hz]."""

MIN_DURATION = 5.0
"""Shorter pieces are dropped [s]."""

_MAX_STEP_M = 0.05
_MAX_STEP_RAD = 0.15
"""A body moves or turns less than this from row to row (5 m/s, 15 rad/s)."""

_MIN_RUN = 0.3
"""Rows between two implausible steps are trusted if they last at least this long [s]."""

_MAX_BRIDGE = 0.3
"""Longest loss that the smoothing fills [s]; a stride takes about one second."""

_BRIDGED_SPEED = 2.5
_BRIDGED_RATE = 3.0
"""A loss is bridged if the body moved and turned slower than this across it [m/s, rad/s]."""

_POSITION_CUTOFF = 6.0
_ATTITUDE_CUTOFF = 8.0
"""Half-amplitude frequency of the smoothing [Hz]: above it the capture's noise, differentiated,
exceeds what the accelerometer or the gyroscope of the same walks shows."""

_MAX_RESIDUAL_M = 0.0025
_MAX_RESIDUAL_RAD = 0.03
"""Rows further than this from the smoothed track are small glitches: ten times the median."""

_PASSES = (4.0, 2.0, 1.0)
"""The limits are approached from above, because glitches pull the track towards them."""

_WIDEN = 2
"""Neighbours of a glitch that go with it [rows]."""

_EDGE = 0.15
"""Cut at both ends of a piece [s]: smoothing is one-sided there."""


def read_vicon_walks(path: Path | str) -> dict[str, list[Trajectory]]:
    """Read, clean and smooth the captured walks.

    Args:
        path: an npz archive, name -> (N, 8): time [s], position xyz [m], quaternion xyzw body to
            world, 100 Hz.

    Returns:
        For each name in the archive its pieces of at least 5 s, at 100 Hz without gaps, times
        as recorded; the list is empty where no piece is long enough.

    Raises:
        ReadError: the file is missing, is no npz archive, or an array has the wrong shape.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            tables = {name: np.asarray(archive[name], dtype=np.float64) for name in archive.files}
    except (OSError, ValueError, zipfile.BadZipFile, AttributeError) as error:
        raise ReadError(path, "file", str(error), "an npz archive of numeric arrays") from error
    for name, table in tables.items():
        if table.ndim != 2 or table.shape[1] != 8:
            raise ReadError(path, name, f"shape {table.shape}", "(N, 8): t, position, quaternion")
    return {name: clean_capture(table) for name, table in tables.items()}


def clean_capture(table: FloatArray) -> list[Trajectory]:
    """The usable pieces of one captured walk (N, 8): time [s], position [m], quaternion xyzw."""
    norm = np.linalg.norm(table[:, 4:8], axis=1)
    table = table[np.isfinite(table).all(axis=1) & (np.abs(norm - 1.0) < 0.05)]
    # Single precision blurs the times of a long walk: rows lie on a 100 Hz grid, count them.
    rows = np.rint((table[:, 0] - table[:1, 0]) * RATE).astype(np.int64)
    table, rows = table[np.unique(rows, return_index=True)[1]], np.unique(rows)
    start = float(table[0, 0]) if len(table) else 0.0
    return [
        piece
        for part in _continuous_parts(table, rows)
        for piece in _smoothed(start, rows[part], table[part, 1:4], table[part, 4:8])
    ]


def _continuous_parts(table: FloatArray, rows: IntArray) -> list[IntArray]:
    """Indices of the rows of each piece: plausible runs, joined where one continues the other."""
    if len(rows) < 2:
        return []
    moved, turned = _distance(table[:-1], table[1:])
    steps = (moved > _MAX_STEP_M) | (turned > _MAX_STEP_RAD) | (np.diff(rows) > 1)
    bounds = np.concatenate([[0], np.flatnonzero(steps) + 1, [len(rows)]])
    runs = [
        np.arange(a, b)
        for a, b in itertools.pairwise(bounds)
        if rows[b - 1] - rows[a] >= _MIN_RUN * RATE
    ]
    parts: list[IntArray] = []
    for run in runs:
        if parts and _continues(table, rows, parts[-1][-1], run[0]):
            parts[-1] = np.concatenate([parts[-1], run])
        else:
            parts.append(run)
    return parts


def _continues(table: FloatArray, rows: IntArray, last: int, first: int) -> bool:
    gap = (rows[first] - rows[last]) / RATE
    moved, turned = _distance(table[last : last + 1], table[first : first + 1])
    return bool(
        gap <= _MAX_BRIDGE and moved[0] <= _BRIDGED_SPEED * gap and turned[0] <= _BRIDGED_RATE * gap
    )


def _distance(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distance [m] and angle [rad] between poses of two tables, row by row."""
    dots = np.abs(np.sum(a[:, 4:8] * b[:, 4:8], axis=1))
    norms = np.linalg.norm(a[:, 4:8], axis=1) * np.linalg.norm(b[:, 4:8], axis=1)
    moved = np.linalg.norm(b[:, 1:4] - a[:, 1:4], axis=1)
    return moved, 2.0 * np.arccos(np.clip(dots / norms, 0.0, 1.0))


def _smoothed(
    start: float, rows: IntArray, position: FloatArray, quat_xyzw: FloatArray
) -> list[Trajectory]:
    """Smooth one part, and cut it where more was lost than can be bridged."""
    grid = np.arange(rows[0], rows[-1] + 1)
    captured = rows - rows[0]
    poses = np.zeros((len(grid), 7))
    poses[captured] = np.hstack([position, sign_continuous(quat_xyzw)])
    weight = np.zeros(len(grid))
    weight[captured] = 1.0
    smooth = _smooth_poses(poses, weight)
    for scale in _PASSES:
        off = np.linalg.norm((poses - smooth)[:, :3], axis=1) > scale * _MAX_RESIDUAL_M
        # Half the angle between two close attitudes is the distance of their quaternions.
        off |= np.linalg.norm((poses - smooth)[:, 3:], axis=1) > scale * _MAX_RESIDUAL_RAD / 2
        weight[captured] = ~binary_dilation(off, iterations=_WIDEN)[captured]
        if weight.mean() < 0.5:
            return []  # no track to speak of
        smooth = _smooth_poses(poses, weight)
    edge = round(_EDGE * RATE)
    trusted = np.flatnonzero(weight)
    ends = np.flatnonzero(np.diff(trusted) > _MAX_BRIDGE * RATE)
    pieces = []
    for stretch in np.split(trusted, ends + 1):
        inner = slice(stretch[0] + edge, stretch[-1] - edge + 1) if len(stretch) else slice(0)
        if len(grid[inner]) > MIN_DURATION * RATE:
            attitude_WB = Rotation.from_quat(smooth[inner, 3:])
            time = start + grid[inner] / RATE
            pieces.append(Trajectory(time, smooth[inner, :3], attitude_WB))
    return pieces


def _smooth_poses(poses: FloatArray, weight: FloatArray) -> FloatArray:
    position = smooth_rows(poses[:, :3], weight, _POSITION_CUTOFF)
    return np.hstack([position, smooth_rows(poses[:, 3:], weight, _ATTITUDE_CUTOFF)])


def smooth_rows(values: FloatArray, weight: FloatArray, cutoff: float) -> FloatArray:
    """Smooth the columns of `values` (N, K), filling rows of weight 0 (Whittaker, 1923).

    Minimising sum w (y - z)^2 + lam sum (second difference of z)^2 has, where w is 1, the transfer
    function 1 / (1 + lam (2 sin(u / 2))^4), u in radians per row, without phase: `lam` follows
    from the frequency where it is a half. Across a loss it draws a cubic.

    Args:
        values: rows at `RATE`; what stands where the weight is 0 does not matter.
        weight: (N,) 1 where the row is trusted, 0 where not.
        cutoff: half-amplitude frequency [Hz].
    """
    n = len(values)
    lam = (2.0 * np.sin(np.pi * cutoff / RATE)) ** -4
    bands = np.zeros((3, n))  # of lam D'D + diag(w), symmetric, upper form
    for offset in range(3):
        products = [1.0, -2.0, 1.0][: 3 - offset], [1.0, -2.0, 1.0][offset:]
        for k, (left, right) in enumerate(zip(*products, strict=True)):
            bands[2 - offset, k + offset : n - 2 + k + offset] += lam * left * right
    bands[2] += weight
    return np.asarray(solveh_banded(bands, values * weight[:, None]), dtype=np.float64)
