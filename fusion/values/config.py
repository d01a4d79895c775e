"""Configuration: frozen groups of settings, each with its unit and default.

A TOML or JSON file may set any of them; unknown keys are refused. The configuration of a run is
saved with its results and can be passed to the next run unchanged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from numbers import Real
from pathlib import Path

import numpy as np

from stario.sequences.errors import ConfigError
from stario.sequences.geodesy import Georeference
from stario.sequences.noise import GYRO_SCALE_ERROR, ImuNoise
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.settings import check_number, naming, read_settings, with_settings
from stario.sequences.windows import WINDOW_SECONDS

UPDATE_RATES = (1, 2, 5, 10, 20)
"""Allowed numbers of network updates per second."""

MIN_PRIOR_SIGMA = 1e-6
"""Smallest standard deviation of a prior, which keeps the covariance positive definite."""

MIN_WALK = 1e-7
"""Smallest random walk of a bias, whose covariance the graph inverts; units as in `ImuNoise`."""

MIN_OUTPUT_RATE = 10
"""States per second if there are fewer network updates [Hz]."""

SATELLITES = ("use", "compare", "ignore")
"""What may become of a recording's satellite positions."""

_ORIGIN = ((-90.0, 90.0), (-180.0, 360.0), (-360.0, 360.0))
"""Ranges of latitude, longitude and yaw of an origin [deg]; some count longitudes to 360."""


def _check_flag(settings: object, name: str) -> None:
    if not isinstance(getattr(settings, name), bool | np.bool_):
        raise ConfigError(name, repr(getattr(settings, name)), "True or False")


@dataclass(frozen=True)
class FilterConfig:
    """Settings of the state-cloning EKF.

    Attributes:
        update_rate: network updates per second.
        covariance_scale: factor on the network's covariance, in addition to update_rate x window
            length, which accounts for overlapping windows; fitted to the tracks of the training
            recordings and of validation recordings unseen by the network.
        correlated_errors: whether covariances and NIS take the network's errors for correlated, as
            those of real networks are, and the accelerometer for better than the gains assume;
            False if all errors are white and as large as configured, as in a simulation.
        gate: probability of the chi-square test. The covariance of an outlier is inflated rather
            than the measurement rejected: without it the speed drifts, and the next correct
            measurement looks false.
        tilt_sigma: sigma of the initial tilt of a moving device [rad].
        yaw_sigma: sigma of the initial yaw [rad]; small, since the start defines the yaw.
        velocity_sigma: sigma of the initial velocity, taken as zero [m/s].
        gyro_bias_sigma: sigma of the gyroscope bias of a device that corrects it well [rad/s]. The
            network's information on the bias is weak and itself biased: its slow errors would turn
            the tracks of devices with a good gyroscope. The filter widens this prior where gravity,
            stillness or the magnetic field show a larger bias.
        accel_bias_sigma: sigma of the initial accelerometer bias [m/s^2].
        gap_gyro_noise: noise density of the tilt in a gap, and of a saturated gyroscope
            [rad/s/sqrt(Hz)].
        gap_accel_noise: noise density of the velocity in a gap, and of an accelerometer with spikes
            [m/s^2/sqrt(Hz)].
        stillness_noise: factor on a phone's white noise below which a second of samples counts as
            stationary; 0 disables zero-velocity updates.
        adaptive: whether innovations and gravity adapt the accelerometer's density and the prior of
            the gyroscope bias; False for a device whose noise is known.
        magnetometer: whether the magnetic field of a recording or stream is used.
        declination: angle from true to magnetic north, positive east [rad]. If given, a track of
            otherwise unknown direction is turned by its magnetic field so that x points east and
            y north; None leaves its initial yaw at zero.
    """

    update_rate: int = 2
    covariance_scale: float = 0.5
    correlated_errors: bool = True
    gate: float = 0.997
    tilt_sigma: float = 0.05
    yaw_sigma: float = 1e-3
    velocity_sigma: float = 1.0
    gyro_bias_sigma: float = 1e-3
    accel_bias_sigma: float = 0.1
    gap_gyro_noise: float = 0.3
    gap_accel_noise: float = 1.0
    stillness_noise: float = 2.0
    adaptive: bool = True
    magnetometer: bool = True
    declination: float | None = None

    def __post_init__(self) -> None:
        if not (isinstance(self.update_rate, Real) and self.update_rate in UPDATE_RATES):
            raise ConfigError("update_rate", repr(self.update_rate), f"one of {UPDATE_RATES}")
        object.__setattr__(self, "update_rate", int(self.update_rate))
        check_number(self, "gate", 0.5, 1.0)
        if self.gate == 1.0:
            raise ConfigError("gate", "1", "a probability from 0.5 to below 1")
        for item in fields(self):
            if item.type == "bool":
                _check_flag(self, item.name)
            elif item.type == "float" and item.name != "gate":
                check_number(self, item.name)
        if self.declination is not None:
            check_number(self, "declination", -math.pi, math.pi)
        if self.covariance_scale == 0.0:
            raise ConfigError("covariance_scale", "0", "a factor > 0: no measurement is exact")

    @property
    def output_rate(self) -> int:
        """States per second: rate of preintegration and of reported states [Hz]."""
        return max(MIN_OUTPUT_RATE, self.update_rate)

    @property
    def intervals_per_update(self) -> int:
        """Number of states from one network update to the next."""
        return self.output_rate // self.update_rate

    @property
    def window_updates(self) -> int:
        """Number of updates per window, which is the number of clones."""
        return round(self.update_rate * WINDOW_SECONDS)

    @property
    def overlap_scale(self) -> float:
        """Factor on the network's covariance, since overlapping windows measure the same motion."""
        return self.update_rate * WINDOW_SECONDS * self.covariance_scale


@dataclass(frozen=True)
class GraphConfig:
    """Settings of the factor graph.

    Attributes:
        lag: length of the fixed-lag window of a stream [s].
    """

    lag: float = 5.0

    def __post_init__(self) -> None:
        check_number(self, "lag", 2.0, 60.0)


@dataclass(frozen=True)
class PlaceConfig:
    """What is known of a recording's place, beside its IMU; streams are given fixes instead.

    Attributes:
        satellites: whether satellite positions are used as fixes ("use"), compared with the track
            as if they were true ("compare"), or neither ("ignore").
        waypoints: whether other positions known without attitude are used or compared with.
        closed: whether the track ends where it began, to a metre.
        origin: latitude and longitude of the map's origin [deg], and perhaps the direction of its x
            axis, counter-clockwise from east [deg]; without fixes the origin is the start. None has
            the first position used, with x east.
    """

    satellites: str = "compare"
    waypoints: str = "compare"
    closed: bool = False
    origin: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        for name, choices in (("satellites", SATELLITES), ("waypoints", SATELLITES[:2])):
            value = getattr(self, name)
            if value not in choices:
                raise ConfigError(name, repr(value), f"one of {', '.join(choices)}")
        _check_flag(self, "closed")
        if self.origin is not None:
            object.__setattr__(self, "origin", _checked_origin(self.origin))

    @property
    def georeference(self) -> Georeference | None:
        """Where the map lies according to `origin`."""
        if self.origin is None:
            return None
        latitude, longitude, *yaw = self.origin
        return Georeference(latitude, longitude, math.radians(yaw[0]) if yaw else 0.0)


def _checked_origin(origin: object) -> tuple[float, ...]:
    values = tuple(origin) if isinstance(origin, tuple | list) else ()
    numbers = len(values) in (2, 3) and all(isinstance(v, Real) for v in values)
    pairs = zip(values, _ORIGIN, strict=False)
    if not (numbers and all(low <= v <= high for v, (low, high) in pairs)):
        expected = (
            "latitude and longitude (-180 to 180, or 0 to 360 eastwards) in degrees, as in "
            "48.137,11.575, and perhaps a yaw"
        )
        raise ConfigError("origin", repr(origin), expected)
    return tuple(float(v) for v in values)


@dataclass(frozen=True)
class NavigatorConfig:
    """Everything that a run depends on, except the recording and the weights.

    Attributes:
        noise: IMU noise densities assumed by the filter, 30 to 100 times those of a stationary
            phone: errors of scale and alignment act like noise in motion, and with smaller
            densities the biases would absorb the network's slow errors. To change some of them, use
            `replace(config.noise, ...)`: `ImuNoise(...)` has a sensor's own for all the others.
        filter: settings of the EKF.
        graph: settings of the factor graph.
        gravity: magnitude [m/s^2].
        place: what is known of a recording's place.
    """

    noise: ImuNoise = field(
        default_factory=lambda: ImuNoise(
            gyro_noise=6e-3,
            accel_noise=0.2,
            gyro_walk=1e-5,
            accel_walk=3e-4,
            gyro_scale=GYRO_SCALE_ERROR,
        )
    )
    filter: FilterConfig = field(default_factory=FilterConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    gravity: float = STANDARD_GRAVITY
    place: PlaceConfig = field(default_factory=PlaceConfig)

    def __post_init__(self) -> None:
        for name, kind in _GROUPS.items():
            value = getattr(self, name)
            if not isinstance(value, kind):
                raise ConfigError(name, f"{value!r:.60}", f"a value of type {kind.__name__}")
        check_number(self, "gravity", 9.5, 10.1)


_GROUPS = {"noise": ImuNoise, "filter": FilterConfig, "graph": GraphConfig, "place": PlaceConfig}


def read_config(path: Path | str) -> NavigatorConfig:
    """Read a configuration from a TOML or JSON file.

    Raises:
        ConfigError: the file is missing or malformed, a key is unknown or a value is invalid.
    """
    values = read_settings(Path(path))
    with naming(path):
        return with_settings(NavigatorConfig(), values)
