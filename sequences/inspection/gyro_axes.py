"""Whether the gyroscope's axes and signs are the accelerometer's.

Specific force, rotated into one frame by the gyroscope and averaged over a second, hardly changes
within seconds. If it changes several times less with other axes or signs of the gyroscope, those
given are wrong. The comparison is relative: what no axes explain, as a ride's accelerations or a
saturated sensor, is no evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations, product

import numpy as np

from stario.sequences.arrays import samples_in
from stario.sequences.attitude.rotations import integrated_gyro
from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray

_AVERAGE_S, _SHORTEST_S = 1.0, 3.0
"""Length of the averages of the force, and of the shortest stretch that is used [s]."""

_BETTER = 3.0
"""Factor by which other axes leave less change that refuses those given: at most 2.0 in 1212
recordings. On 261 of seven sets it refuses two axes swapped on 80 %, a cycle of three on 95 % and
one sign changed on 44 %; the others hardly tilt."""

_LEAST_PIECES = 3
"""Number of pieces of 4 s below which nothing is judged: within 5 s of good walks other axes left
less than a third of the change."""

_NOTICEABLE = 0.1
"""Mean squared change [m^2/s^4] below which a device hardly tilts."""

_GIVEN = 0
_AXES: FloatArray = np.array(
    [
        np.eye(3)[list(order)] * np.array(signs)[:, None]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
    ]
)
"""(48, 3, 3) all assignments of axes and signs, as matrices that give the gyroscope's; those given
come first."""

_PROPER = np.linalg.det(_AXES) > 0.0


def check_gyro_axes(
    name: str, time: FloatArray, gyro: FloatArray, accel: FloatArray, pieces: list[slice]
) -> None:
    """Check the gyroscope's axes and signs (N, 3) against the accelerometer's over `pieces`.

    Raises:
        InputError: others explain how the force turns several times better.
    """
    changes = [
        force_changes(time[piece], gyro[piece], accel[piece])
        for piece in pieces
        if time[piece.stop - 1] - time[piece.start] > _SHORTEST_S
    ]
    check_changes(f"{name}: gyroscope", changes)


def check_changes(field: str, changes: Sequence[FloatArray]) -> None:
    """Check the changes (48,) of several pieces; fewer than three are no evidence.

    Raises:
        InputError: other axes and signs leave several times less than those given.
    """
    if len(changes) < _LEAST_PIECES:
        return
    change = np.mean(changes, axis=0)
    best = int(change.argmin())
    if change[_GIVEN] < max(_NOTICEABLE, _BETTER * change[best]):
        return
    found = "rotations that contradict the accelerometer"
    fix = "are its axes and signs the accelerometer's? "
    fix += f"The accelerometer's x, y, z seem to be its {_words(best)}"
    raise InputError(field, found, "rates about the accelerometer's axes", fix)


def force_changes(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> FloatArray:
    """Return the mean squared change of the averaged force with all axes (48,) [m^2/s^4].

    With other axes M the rotation R becomes M R M^T, and if M mirrors, that of the opposite rate:
    the force M^T f is rotated by R. With those given the gyroscope may have any constant bias,
    which for a device at rest would look like wrong axes.
    """
    change = np.empty(len(_AXES))
    change[_PROPER] = _change(time, gyro, accel, _AXES[_PROPER])
    change[~_PROPER] = _change(time, -gyro, accel, _AXES[~_PROPER])
    (unbiased,) = _change(time, gyro - gyro.mean(axis=0), accel, _AXES[:1])
    change[_GIVEN] = min(change[_GIVEN], unbiased)
    return change


def _change(time: FloatArray, gyro: FloatArray, accel: FloatArray, axes: FloatArray) -> FloatArray:
    length = samples_in(_AVERAGE_S, time)
    R_0B = integrated_gyro(time, gyro).as_matrix()
    total = np.cumsum(R_0B @ np.einsum("nj,pji->nip", accel, axes), axis=0)
    average = (total[length:] - total[:-length]) / length
    return np.asarray(average.var(axis=0).sum(axis=0))


def _words(best: int) -> str:
    """Return which of the gyroscope's axes are the accelerometer's x, y and z."""
    names = np.array(["x", "y", "z"])
    return ", ".join(
        f"{'-' if row.sum() < 0.0 else ''}{names[np.abs(row).argmax()]}" for row in _AXES[best]
    )
