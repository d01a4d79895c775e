"""Sensors and axes whose values repeat exactly although the device moves: stopped, or broken.

Data simulated in a plane have constant axes too. So an axis of the gyroscope counts as dead only if
the rates about both others vary, and one of the accelerometer only if the gyroscope turns gravity
into it.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from stario.sequences.arrays import runs, scatter
from stario.sequences.clean_samples import MIN_RATE, usable
from stario.sequences.errors import InputError
from stario.sequences.findings import Finding
from stario.sequences.sequence import STANDARD_GRAVITY, BoolArray, FloatArray, ImuSequence

_STUCK_S = 1.0
"""Time [s] for which a stuck sensor's values repeat exactly; those of others repeat for 0.1 s."""

_SHAKEN_M_S2 = 0.5
_TILTING_RAD_S = 0.1
"""Scatter of the force, and of the rate that turns it in the device's axes, above which a device
moves."""

_VARIES_RAD_S = 0.01
"""Scatter of a rate above which it varies: far above rounding, below any hand or vehicle."""

_REMEDY = "is another column meant, or is the sensor broken?"


def dead_axes(sequence: ImuSequence) -> list[Finding]:
    """Return a finding for each sensor with dead axes: data simulated in a plane may be meant."""
    given = usable(sequence)
    gyro, accel = sequence.gyro[given], sequence.accel[given]
    if len(gyro) < 2:
        return []
    varies = gyro.std(axis=0) > _VARIES_RAD_S
    turned = np.cross(accel.mean(axis=0), gyro).std(axis=0)  # the force's rate of change
    constant = _constant(accel)
    alone = constant.sum() < 3  # otherwise the whole sensor is dead
    dead = {
        "gyroscope": _constant(gyro) & (varies.sum() == 2),
        "accelerometer": constant & alone & (turned > _TILTING_RAD_S * STANDARD_GRAVITY),
    }
    found = {sensor: " and ".join(np.array(["x", "y", "z"])[axes]) for sensor, axes in dead.items()}
    return [
        Finding(
            f"{sensor}_dead_axis",
            f"{sensor}: its {axes} axis never changes, although the device turns",
            _REMEDY,
            values={"axes": axes},
        )
        for sensor, axes in found.items()
        if axes
    ]


def _constant(values: FloatArray) -> BoolArray:
    return np.asarray((values == values[0]).all(axis=0))


def stuck_findings(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> list[Finding]:
    """Report a sensor that repeats while the other moves; `check_units` refuses a dead one."""
    found = []
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
            seconds = sum(b - a for a, b in stuck)
            found.append(
                Finding(
                    f"{sensor}_stopped",
                    f"{sensor}: its values repeat exactly for {seconds:.1f} s while the {other} "
                    f"shows motion, longest from {start:.1f} to {stop:.1f} s",
                    "restart the device and record again; if it recurs, the sensor or app is "
                    "faulty",
                    values={"seconds": seconds, "start_s": start, "stop_s": stop},
                )
            )
    return found


def check_not_dead(name: str, time: FloatArray, gyro: FloatArray, accel: FloatArray) -> None:
    """Raise InputError if a sensor's values (n, 3) are constant while the other shows motion."""
    if not np.diff(gyro, axis=0).any() and shaken(time, gyro, accel):
        found = "values that never change while the accelerometer's do"
        raise InputError(f"{name}: gyroscope", found, "angular rates", _REMEDY)
    if not np.diff(accel, axis=0).any() and tilting(time, gyro, accel):
        found = "values that never change while the gyroscope tilts them"
        raise InputError(f"{name}: accelerometer", found, "specific forces", _REMEDY)


def shaken(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Return whether a force (n, 3) contradicts both rest and steady rotation at the first rate.

    In steady rotation the force is constant, in the device's axes (moving in a circle) or in the
    world's (turning in place).
    """
    turned = Rotation.from_rotvec(np.outer(time - time[0], gyro[0])).apply(accel)
    return min(scatter(accel), scatter(turned)) > _SHAKEN_M_S2


def tilting(time: FloatArray, gyro: FloatArray, accel: FloatArray) -> bool:
    """Return whether the rate (n, 3) perpendicular to the force varies.

    A constant force rules that out; one of zero, which has no direction, any rate that varies.
    """
    size = float(np.linalg.norm(accel[0]))
    across = np.cross(gyro, accel[0] / size) if size > 0.0 else gyro
    return scatter(across) > _TILTING_RAD_S
