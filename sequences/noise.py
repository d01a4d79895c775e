"""Noise densities of an inertial sensor, with one definition for simulation, filter and graph."""

from __future__ import annotations

from dataclasses import dataclass, fields

from stario.sequences.settings import check_number


@dataclass(frozen=True)
class ImuNoise:
    """Continuous noise densities, independent of the sensor's rate.

    A sample at rate f has white noise of standard deviation density * sqrt(f).

    Attributes:
        gyro_noise: white noise of the gyroscope [rad/s/sqrt(Hz)].
        accel_noise: white noise of the accelerometer [m/s^2/sqrt(Hz)].
        gyro_walk: random walk of the gyroscope's bias [rad/s^2/sqrt(Hz)].
        accel_walk: random walk of the accelerometer's bias [m/s^3/sqrt(Hz)].
        gyro_scale: errors of the gyroscope in proportion to the rate (scale, alignment), as a
            fraction; independent from one tenth of a second to the next.
    """

    gyro_noise: float = 1e-3
    accel_noise: float = 1e-2
    gyro_walk: float = 3e-5
    accel_walk: float = 1e-3
    gyro_scale: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            check_number(self, item.name)


PHONE_NOISE = ImuNoise(gyro_noise=2e-4, accel_noise=2e-3, gyro_walk=2e-5, accel_walk=2e-4)
"""Noise of a phone's sensors; a filter assumes more, since it treats scale errors as noise."""

GYRO_SCALE_ERROR = 0.02
"""Error of a phone's gyroscope as a fraction of its rate: by the true attitudes of the archives the
scale of RIDI's phone is off by 2.3 %, rfbr's by 2.0, KIPD's by -0.9 to 1.2, tyrex' iPhone 4S by -1
to -2 (README.md of fusion, "Errors in proportion to the rate")."""
