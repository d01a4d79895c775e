"""Sensors that have stopped: values that repeat exactly while the other sensor shows motion."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.errors import InputError
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import MIN_RATE, runs

_STUCK_S = 1.0
"""Time [s] for which a stuck sensor's values repeat exactly; those of others repeat for 0.1 s."""

_SHAKEN_M_S2 = 0.5
_TILTING_RAD_S = 0.1
"""Scatter of the force, and of the rate perpendicular to it, above which a device moves."""


def stuck_problems(name: str, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> list[str]:
    """Report a sensor that repeats while the other moves; `check_units` refuses a dead one."""
    problems = []
    for sensor, values, other, moves in (
        ("gyroscope", gyro, "accelerometer", shaken),
        ("accelerometer", accel, "gyroscope", tilting),
    ):
        repeated = np.asarray(~np.diff(values, axis=0).any(axis=1))
        stuck = [
            (float(time[a] - time[0]), float(time[b] - time[0]))
            for a, b in runs(repeated)
            if time[b] - time[a] >= _STUCK_S
            and b - a >= MIN_RATE * _STUCK_S  # in another unit two samples make a second
            and moves(time[a : b + 1], gyro[a : b + 1], accel[a : b + 1])
        ]
        if stuck and not repeated.all():
            start, stop = max(stuck, key=lambda stretch: stretch[1] - stretch[0])
            problems.append(
                f"{name}: {sensor}: its values repeat exactly for "
                f"{sum(b - a for a, b in stuck):.1f} s while the {other} shows motion, "
                f"longest from {start:.1f} to {stop:.1f} s"
            )
    return problems


def check_not_dead(name: str, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> None:
    """Check that no sensor's values, (n, 3), are constant while the other shows motion.

    Raises:
        InputError: one's are.
    """
    remedy = "is another column meant, or is the sensor broken?"
    if not np.diff(gyro, axis=0).any() and shaken(time, gyro, accel):
        found = "values that never change while the accelerometer's do"
        raise InputError(f"{name}: gyroscope", found, "angular rates", remedy)
    if not np.diff(accel, axis=0).any() and tilting(time, gyro, accel):
        found = "values that never change while the gyroscope tilts them"
        raise InputError(f"{name}: accelerometer", found, "specific forces", remedy)


def shaken(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Return whether a force (n, 3) contradicts both rest and steady rotation at the first rate.

    In steady rotation the force is constant, in the device's axes (moving in a circle) or in the
    world's (turning in place).
    """
    turned = Rotation.from_rotvec(np.outer(time - time[0], gyro[0])).apply(accel)
    scatter = min(float(np.linalg.norm(force.std(axis=0))) for force in (accel, turned))
    return scatter > _SHAKEN_M_S2


def tilting(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Return whether the rate (n, 3) perpendicular to the force varies.

    A constant force rules that out; one of zero, which has no direction, any rate that varies.
    """
    size = float(np.linalg.norm(accel[0]))
    across = np.cross(gyro, accel[0] / size) if size > 0.0 else gyro
    return float(np.linalg.norm(across.std(axis=0))) > _TILTING_RAD_S
