"""The mount of a tracked body on the IMU, piece by piece between its flips, and about the vertical.

Frames and equation: `stario.sequences.attitude.alignment`.

On a trolley a device rotates about the vertical only, and rotation vectors along one axis do not
determine the mount's rotation about that axis. The accelerometer does: the horizontal acceleration
must be the second derivative of the captured path. With the second difference over h, which is the
mean of the acceleration under a triangle,

    (p(t + h) - 2 p(t) + p(t - h)) / h^2  =  mean of  R_WB (f - b_a) + g + R_WB ([w']x + [w]x^2) s

is linear in a small rotation about the vertical, in the accelerometer bias b_a and in the lever arm
s from the sensor to the tracked point (0.1 m in OxIOD), so that neither is mistaken for a rotation.
The estimates of gyroscope and accelerometer are weighted by their information.
"""

from __future__ import annotations

import itertools
import warnings
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d, uniform_filter1d
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import integral, samples_in
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

_H_S, _TURN_S = 0.3, 0.1
"""Half width of the second difference, and interval over which rotations are compared [s]."""

_LEVER_M = 0.3
_BIAS_M_S2 = 0.3
"""Prior sigmas of lever arm and bias, which bound them where a track determines them poorly."""

_CAUTION = 2.5
"""Factor by which the accelerometer's deviation is taken to exceed that of its residuals: results
of recordings of one session, and of halves of one recording, differ by that much."""

_MIN_ROWS = 100
_PASSES = 5


Piece = tuple[int, int]
"""Samples [start, stop)."""


@dataclass(frozen=True, eq=False)
class Rotations:
    """What both measured at the same times.

    Attributes:
        time: (N,) [s], on the IMU's clock.
        attitude_WV: N attitudes of the tracked body.
        attitude_B: N attitudes of the IMU by the gyroscope, relative to its start.
    """

    time: FloatArray
    attitude_WV: Rotation
    attitude_B: Rotation

    def angle_error(self, stride: int) -> FloatArray:
        """Return the difference of the angles turned over `stride` samples: no mount changes it."""
        half_V, half_B = (
            np.arccos(np.clip(np.abs(np.sum(quat[:-stride] * quat[stride:], axis=1)), 0.0, 1.0))
            for quat in (self.attitude_WV.as_quat(), self.attitude_B.as_quat())
        )
        return np.asarray(2.0 * np.abs(half_V - half_B), dtype=np.float64)

    def turns(self, piece: Piece) -> tuple[FloatArray, FloatArray]:
        """Return rotation vectors (M, 3) over 0.1 s in V and in B [rad]."""
        start, stop = piece
        stride = samples_in(_TURN_S, self.time)
        # Rotations that overlap by more than two thirds add little information.
        before = np.arange(start, stop - stride, max(1, stride // 3))
        phi_V, phi_B = (
            composed(attitude[before].inv(), attitude[before + stride]).as_rotvec()
            for attitude in (self.attitude_WV, self.attitude_B)
        )
        return phi_V, phi_B

    def residual(self, mount: Rotation, piece: Piece) -> float:
        """Return the rotation [rad] that a mount typically leaves unexplained in a piece."""
        phi_V, phi_B = self.turns(piece)
        return float(np.median(np.linalg.norm(phi_V - mount.apply(phi_B), axis=1)))

    def mount(self, piece: Piece, shortest: float = MIN_FIT_S) -> Rotation | None:
        """Fit R_VB with outliers weighted down; None if the piece is too short."""
        start, stop = piece
        if self.time[stop - 1] - self.time[start] < shortest:
            return None
        phi_V, phi_B = self.turns(piece)
        weights = np.ones(len(phi_V))
        mount = Rotation.identity()
        for _ in range(_PASSES):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # one axis: see `about_one_axis`
                mount, _ = Rotation.align_vectors(phi_V, phi_B, weights=weights)
            residual = np.linalg.norm(phi_V - mount.apply(phi_B), axis=1)
            scale = max(float(np.median(residual)), 1e-4)
            weights = 1.0 / (1.0 + (residual / (2 * scale)) ** 2)
        return mount

    def about_one_axis(self, piece: Piece) -> bool:
        """Return whether both turned about a single axis, which leaves the mount open."""
        phi_V, phi_B = self.turns(piece)
        common = np.linalg.svd(phi_V.T @ phi_B / len(phi_V), compute_uv=False)
        first, second = np.sqrt(common[:2]) / _TURN_S
        return bool(second < _SECOND_AXIS_RAD_S < 0.2 * first)


def disagreeing(both: Rotations) -> BoolArray:
    """Return whether each sample's rotation to most neighbours contradicts the gyroscope."""
    n = len(both.time)
    ahead, behind = np.zeros(n), np.zeros(n)
    for stride in sorted({samples_in(span, both.time) for span in _STRIDES_S}):
        error = both.angle_error(stride) > _GLITCH_RAD
        ahead[: n - stride] += error
        behind[stride:] += error
    enough = len(_STRIDES_S) / 2
    return (ahead > enough) & (behind > enough)


def pieces_between_jumps(both: Rotations, valid: BoolArray) -> list[Piece]:
    """Return the pieces between attitude jumps, if long enough to be useful.

    A gap of the capture in which the body was mounted anew also ends a piece: the angle of that
    turn may happen to be the gyroscope's.
    """
    known, time = np.flatnonzero(valid), both.time
    if len(known) < 2:
        return []
    seen = Rotations(time[known], both.attitude_WV[known], both.attitude_B[known])
    jump = seen.angle_error(1) > _FLIP_RAD
    gaps = np.flatnonzero((np.diff(time[known]) > _GAP_S) & ~jump)
    jump[gaps] = [_remounted(both, known, int(gap)) for gap in gaps]
    edges = np.concatenate([[0], np.flatnonzero(jump) + 1, [len(known)]])
    pieces = [(known[a], known[b - 1] + 1) for a, b in itertools.pairwise(edges)]
    return [(a, b) for a, b in pieces if time[b - 1] - time[a] >= _MIN_PIECE_S]


def _remounted(both: Rotations, known: NDArray[np.intp], gap: int) -> bool:
    """Return whether the mounts fitted to up to 10 s before and after a gap contradict."""
    longest = samples_in(MIN_FIT_S, both.time)
    ends = (np.diff(known) > 1) | (np.diff(both.time[known]) > _GAP_S)  # or the capture has no rows
    breaks = np.concatenate([[-1], np.flatnonzero(ends), [len(known) - 1]])
    k = int(np.searchsorted(breaks, gap))
    sides = (
        known[max(breaks[k - 1] + 1, gap - longest) : gap + 1],
        known[gap + 1 : min(breaks[k + 1], gap + longest) + 1],
    )
    pieces = [(int(part[0]), int(part[-1]) + 1) for part in sides]
    before, after = (both.mount(piece, _MIN_OWN_S) for piece in pieces)
    if before is None or after is None or _same_mount(before, after):  # or too short to tell
        return False
    left = both.residual(after, pieces[1])
    return left < _OWN_BETTER * both.residual(before, pieces[1])


def fitted_mounts(both: Rotations, gyro_B: GyroIntegral, pieces: list[Piece]) -> list[Rotation]:
    """Return R_VB of each piece: fitted if it is long, else carried over by the gyroscope.

    A rotation within a gap of the gyroscope is not a flip: nothing is carried across such a gap.
    A short piece whose rotations the carried mount leaves unexplained was mounted anew in a gap of
    the capture: its own fit is used.
    """
    time, attitude_WV, attitude_B = both.time, both.attitude_WV, both.attitude_B
    fitted = [both.mount(piece) for piece in pieces]
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
            own, left = both.mount(pieces[k], _MIN_OWN_S), both.residual(carried, pieces[k])
            better = own and both.residual(own, pieces[k]) < _OWN_BETTER * left
            mounts[k] = own if own and better else carried
    return [mounts[k] for k in range(count)]


def _same_mount(mount: Rotation, other: Rotation) -> bool:
    return bool((mount.inv() * other).magnitude() < _SAME_MOUNT_RAD)


def heading_turn(
    time: FloatArray,
    gyro: FloatArray,
    force: FloatArray,
    position_W: FloatArray,
    attitude_WB: Rotation,
    valid: BoolArray,
) -> Rotation:
    """Return a mount correction R_BB' about the vertical; corrected attitudes are R_WB R_BB'.

    Args:
        time: (N,) times of the capture [s], evenly sampled, on the IMU's clock.
        gyro: (N, 3) angular rate in B [rad/s] at those times.
        force: (N, 3) specific force in B [m/s^2] at those times.
        position_W: (N, 3) positions of the tracked point in a level world [m].
        attitude_WB: N rotations, correct except for a few degrees about the vertical.
        valid: (N,) bool, whether a sample may be used.

    Returns:
        The rotation; identity if there are too few samples.
    """
    up_B = attitude_WB[valid].apply([0.0, 0.0, 1.0], inverse=True).mean(axis=0)
    up_B /= np.linalg.norm(up_B)
    rows = _rows(time, gyro, force, position_W, attitude_WB, valid, up_B)
    if len(rows) < _MIN_ROWS:
        return Rotation.identity()
    known = _gyro_information(time, gyro, attitude_WB, valid, up_B)
    turn = 0.0
    for _ in range(_PASSES):
        step, information = _robust_turn(_turned(rows, turn))
        information /= _CAUTION**2
        step = (information * step - known * turn) / (information + known)
        turn += step
        if abs(step) < 1e-5:
            break
    return Rotation.from_rotvec(turn * up_B)


def _gyro_information(
    time: FloatArray, gyro: FloatArray, attitude_WB: Rotation, valid: BoolArray, up_B: FloatArray
) -> float:
    """Return the inverse variance [1/rad^2] of the gyroscope's fit for rotation about `up_B`."""
    stride = samples_in(_TURN_S, time)
    angle = integral(time, gyro)
    use = valid[:-stride] & valid[stride:]
    use &= np.arange(len(use)) % stride == 0
    phi_B = (angle[stride:] - angle[:-stride])[use]
    starts = np.flatnonzero(use)
    phi_attitude = (attitude_WB[starts].inv() * attitude_WB[starts + stride]).as_rotvec()
    deviation = _deviation(phi_attitude - phi_B)
    return float(np.square(np.cross(phi_B, up_B)).sum() / deviation**2)


def _deviation(residual: FloatArray) -> float:
    """Return the standard deviation from the median, robust to outliers."""
    return max(1.4826 * float(np.median(np.abs(residual))), 1e-9)


def _rows(
    time: FloatArray,
    gyro: FloatArray,
    force: FloatArray,
    position_W: FloatArray,
    attitude_WB: Rotation,
    valid: BoolArray,
    up_B: FloatArray,
) -> FloatArray:
    """Return rows (M, 10), two for each instant, whose columns are means in W.

    Lever arm (3), bias (3), the force along `up_B`, the force perpendicular to it, the latter
    rotated by 90 degrees, and the second difference of the position.
    """
    dt = float(np.median(np.diff(time)))
    k = samples_in(_H_S, time)
    whole = minimum_filter1d(valid.astype(np.int8), 2 * k + 1, mode="constant") > 0
    moments = np.flatnonzero(whole)[:: max(1, k // 2)]
    if not len(moments):
        return np.empty((0, 10))
    spin = np.gradient(uniform_filter1d(gyro, 5, axis=0), dt, axis=0)
    along = np.outer(force @ up_B, up_B)
    columns = [np.cross(gyro, np.cross(gyro, axis)) + np.cross(spin, axis) for axis in np.eye(3)]
    columns += [np.tile(axis, (len(time), 1)) for axis in np.eye(3)]
    columns += [along, force - along, np.cross(up_B, force)]
    matrices = attitude_WB.as_matrix()[:, :2]  # only horizontal components are used
    level = np.matmul(matrices, np.stack(columns, axis=2)).reshape(len(time), 18)
    means = _triangle(level, k)[moments].reshape(-1, 9)
    second = position_W[moments + k] - 2.0 * position_W[moments] + position_W[moments - k]
    return np.column_stack([means, second[:, :2].reshape(-1) / (k * dt) ** 2])


def _turned(rows: FloatArray, turn: float) -> FloatArray:
    """Return the linear system (M, 8) at `turn`: further turn, lever, bias; right-hand side."""
    along, across, turned, second = rows[:, 6:].T
    sine, cosine = np.sin(turn), np.cos(turn)
    missing = second - along - cosine * across - sine * turned
    return np.column_stack([cosine * turned - sine * across, rows[:, :6], missing])


def _triangle(values: FloatArray, k: int) -> FloatArray:
    """Return the centred mean under a triangle of half width `k` rows."""
    once = uniform_filter1d(values, k, axis=0)
    return np.asarray(uniform_filter1d(once, k, axis=0, origin=-1 if k % 2 == 0 else 0))


def _robust_turn(rows: FloatArray) -> tuple[float, float]:
    """Return the turn [rad] and its inverse variance, estimated jointly with lever and bias."""
    A, b = rows[:, :7], rows[:, 7]
    weights = np.ones(len(rows))
    prior = np.array([0.0, *[1 / _LEVER_M**2] * 3, *[1 / _BIAS_M_S2**2] * 3])
    deviation = _deviation(b)
    for _ in range(_PASSES):
        normal = (A * weights[:, None]).T @ A / deviation**2 + np.diag(prior)
        x = np.linalg.solve(normal, (A * weights[:, None]).T @ b / deviation**2)
        residual = b - A @ x
        deviation = _deviation(residual)
        weights = 1.0 / (1.0 + np.square(residual / (2.0 * deviation))) ** 2
    # Rows are half a window apart: only every second one adds information.
    variance = 2.0 * np.linalg.inv(normal)[0, 0]
    return float(x[0]), float(1.0 / variance)
