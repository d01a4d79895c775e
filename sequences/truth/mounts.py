"""The mount of a tracked body on the IMU, piece by piece between its flips.

Frames and equation: `stario.sequences.truth.alignment`.
"""

from __future__ import annotations

import itertools
import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import samples_in
from stario.sequences.attitude.rotations import GyroIntegral
from stario.sequences.attitude.stacks import composed
from stario.sequences.sequence import BoolArray, FloatArray

MIN_FIT_S = 10.0
"""Minimum length of a piece whose mount can be fitted [s]."""

_STRIDES_S = (0.03, 0.1, 0.25, 0.5)
_FLIP_RAD = np.deg2rad(15.0)
_GLITCH_RAD = np.deg2rad(6.0)
_SAME_MOUNT_RAD = np.deg2rad(30.0)
_MIN_PIECE_S, _GAP_S = 1.0, 0.5

_MIN_OWN_S, _OWN_BETTER = 3.0, 0.5
"""Length of a piece [s] that can tell that it was mounted anew, and the share of the carried
mount's residual that its own fit must leave."""

_SECOND_AXIS_RAD_S = 0.005
"""Rate about a second axis (root mean square) that both must have measured. On a trolley it is
0.009; noise of both, which is independent, leaves less."""


def disagreeing(time: FloatArray, attitude_WV: Rotation, attitude_B: Rotation) -> BoolArray:
    """Return whether each sample's rotation to most neighbours contradicts the gyroscope."""
    n = len(time)
    ahead, behind = np.zeros(n), np.zeros(n)
    for stride in sorted({samples_in(span, time) for span in _STRIDES_S}):
        error = _angle_error(attitude_WV, attitude_B, stride) > _GLITCH_RAD
        ahead[: n - stride] += error
        behind[stride:] += error
    enough = len(_STRIDES_S) / 2
    return (ahead > enough) & (behind > enough)


def _angle_error(attitude_WV: Rotation, attitude_B: Rotation, stride: int) -> FloatArray:
    """Return the difference of rotation angles over `stride` samples; the mount cancels out."""
    half_V, half_B = (
        np.arccos(np.clip(np.abs(np.sum(quat[:-stride] * quat[stride:], axis=1)), 0.0, 1.0))
        for quat in (attitude_WV.as_quat(), attitude_B.as_quat())
    )
    return np.asarray(2.0 * np.abs(half_V - half_B), dtype=np.float64)


def pieces_between_jumps(
    time: FloatArray, attitude_WV: Rotation, attitude_B: Rotation, valid: BoolArray
) -> list[tuple[int, int]]:
    """Return runs of samples [start, stop) between attitude jumps, if long enough to be useful.

    A gap of the capture in which the body was mounted anew also ends a run: the angle of that turn
    may happen to be the gyroscope's.
    """
    known = np.flatnonzero(valid)
    if len(known) < 2:
        return []
    jump = _angle_error(attitude_WV[known], attitude_B[known], 1) > _FLIP_RAD
    gaps = np.flatnonzero((np.diff(time[known]) > _GAP_S) & ~jump)
    jump[gaps] = [_remounted(time, attitude_WV, attitude_B, known, int(gap)) for gap in gaps]
    edges = np.concatenate([[0], np.flatnonzero(jump) + 1, [len(known)]])
    runs = [(known[a], known[b - 1] + 1) for a, b in itertools.pairwise(edges)]
    return [(a, b) for a, b in runs if time[b - 1] - time[a] >= _MIN_PIECE_S]


def _remounted(
    time: FloatArray,
    attitude_WV: Rotation,
    attitude_B: Rotation,
    known: NDArray[np.intp],
    gap: int,
) -> bool:
    """Return whether the mounts fitted to up to 10 s before and after a gap contradict."""
    longest = samples_in(MIN_FIT_S, time)
    breaks = np.concatenate([[-1], np.flatnonzero(np.diff(known) > 1), [len(known) - 1]])
    k = int(np.searchsorted(breaks, gap))
    before = known[max(breaks[k - 1] + 1, gap - longest) : gap + 1]
    after = known[gap + 1 : min(breaks[k + 1], gap + longest) + 1]
    sides = []
    for part in (before, after):
        piece = int(part[0]), int(part[-1]) + 1
        own = _fit(time, attitude_WV, attitude_B, piece, _MIN_OWN_S)
        if own is None:  # too short to tell
            return False
        sides.append((own, _turns(time, attitude_WV, attitude_B, piece)))
    (before_gap, _), (own, phi) = sides
    return not _same_mount(before_gap, own) and (
        _residual(own, *phi) < _OWN_BETTER * _residual(before_gap, *phi)
    )


def fitted_mounts(
    time: FloatArray,
    attitude_WV: Rotation,
    gyro_B: GyroIntegral,
    pieces: list[tuple[int, int]],
) -> list[Rotation]:
    """Return R_VB of each piece: fitted if it is long, else carried over by the gyroscope.

    A rotation within a gap of the gyroscope is not a flip: nothing is carried across such a gap.
    A short piece whose rotations the carried mount leaves unexplained was mounted anew in a gap of
    the capture: its own fit is used.
    """
    attitude_B = gyro_B.attitude(time)
    fitted = [_fit(time, attitude_WV, attitude_B, piece) for piece in pieces]
    longest = int(np.argmax([stop - start for start, stop in pieces]))
    mounts: dict[int, Rotation] = {longest: fitted[longest] or Rotation.identity()}
    count = len(pieces)
    # Pieces after and before the longest, their neighbours towards it, and the facing ends of both.
    order = [(k, k - 1, pieces[k][0], pieces[k - 1][1] - 1) for k in range(longest + 1, count)]
    order += [(k, k + 1, pieces[k][1] - 1, pieces[k + 1][0]) for k in range(longest - 1, -1, -1)]
    for k, neighbour, here, there in order:
        mount, fit = mounts[neighbour], fitted[k]
        carried = fit or mount
        if not gyro_B.has_long_gap(*sorted((time[here], time[there]))):
            across = attitude_B[there].inv() * attitude_B[here]
            carried = attitude_WV[here].inv() * attitude_WV[there] * mount * across
        if _same_mount(mount, carried) or (fit and _same_mount(mount, fit)):
            mounts[k] = mount
        elif fit and _same_mount(fit, carried):
            mounts[k] = fit
        else:
            own = _fit(time, attitude_WV, attitude_B, pieces[k], _MIN_OWN_S)
            phi = _turns(time, attitude_WV, attitude_B, pieces[k])
            better = own and _residual(own, *phi) < _OWN_BETTER * _residual(carried, *phi)
            mounts[k] = own if own and better else carried
    return [mounts[k] for k in range(count)]


def _same_mount(mount: Rotation, other: Rotation) -> bool:
    return bool((mount.inv() * other).magnitude() < _SAME_MOUNT_RAD)


def _turns(
    time: FloatArray, attitude_WV: Rotation, attitude_B: Rotation, piece: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """Return rotation vectors (M, 3) over 0.1 s in V and in B [rad]."""
    start, stop = piece
    stride = samples_in(0.1, time)
    # Rotations that overlap by more than two thirds add little information.
    before = np.arange(start, stop - stride, max(1, stride // 3))
    phi_V = composed(attitude_WV[before].inv(), attitude_WV[before + stride]).as_rotvec()
    phi_B = composed(attitude_B[before].inv(), attitude_B[before + stride]).as_rotvec()
    return phi_V, phi_B


def _residual(mount: Rotation, phi_V: FloatArray, phi_B: FloatArray) -> float:
    return float(np.median(np.linalg.norm(phi_V - mount.apply(phi_B), axis=1)))


def turns_about_one_axis(
    time: FloatArray, attitude_WV: Rotation, gyro_B: GyroIntegral, piece: tuple[int, int]
) -> bool:
    """Return whether both measured rotation about a single axis, which leaves the mount open."""
    phi_V, phi_B = _turns(time, attitude_WV, gyro_B.attitude(time), piece)
    common = np.linalg.svd(phi_V.T @ phi_B / len(phi_V), compute_uv=False)
    first, second = np.sqrt(common[:2]) / 0.1
    return bool(second < _SECOND_AXIS_RAD_S < 0.2 * first)


def _fit(
    time: FloatArray,
    attitude_WV: Rotation,
    attitude_B: Rotation,
    piece: tuple[int, int],
    shortest: float = MIN_FIT_S,
) -> Rotation | None:
    """Fit R_VB, which takes rotation vectors of B to those of V, with outliers weighted down."""
    start, stop = piece
    if time[stop - 1] - time[start] < shortest:
        return None
    phi_V, phi_B = _turns(time, attitude_WV, attitude_B, piece)
    weights = np.ones(len(phi_V))
    mount = Rotation.identity()
    for _ in range(5):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # one axis: see `turns_about_one_axis`
            mount, _ = Rotation.align_vectors(phi_V, phi_B, weights=weights)
        residual = np.linalg.norm(phi_V - mount.apply(phi_B), axis=1)
        scale = max(float(np.median(residual)), 1e-4)
        weights = 1.0 / (1.0 + (residual / (2 * scale)) ** 2)
    return mount
