"""Configuration: frozen groups, each field with its unit and default.

A file (TOML or JSON) may set any of them; an unknown key is refused. The configuration a run used
is saved beside its results and can be given to the next run as it is.
"""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import dataclass, field, fields
from numbers import Real
from pathlib import Path

import numpy as np

from stario.sequences.errors import ConfigError
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.settings import check_number, with_settings
from stario.sequences.windows import WINDOW_SECONDS

UPDATE_RATES = (1, 2, 5, 10, 20)
"""Network updates per second that may be asked for."""

SMALLEST_SIGMA = 1e-6
"""What is known exactly is given this much, so that a covariance stays positive definite."""

LEAST_OUTPUT_RATE = 10
"""States per second where the network is asked less often [Hz]."""


@dataclass(frozen=True)
class FilterConfig:
    """The state-cloning EKF.

    Attributes:
        update_rate: network updates per second.
        covariance_scale: factor on the network's covariance beyond update_rate x window length,
            which accounts for overlapping windows. Successive errors of the network are alike,
            so innovations are smaller than single errors; fitted to NIS and position NEES on the
            training and validation recordings, the latter unknown to the network then.
        network_turn_sigma: by which what the network says of a minute or so is turned [rad]; a
            state of its own once fixes tell the direction.
        gate: probability of the chi-square test; beyond it the covariance is inflated, at once: one
            left out lets the speed drift, which makes the next right one look false.
        tilt_sigma: of the first attitude when the device is moving [rad].
        yaw_sigma: of the first attitude's yaw [rad]; small, since the start defines the yaw.
        velocity_sigma: of the first velocity, taken as zero [m/s].
        gyro_bias_sigma: of the first gyroscope bias [rad/s], of devices that correct it well. What
            a network says of it is weak and biased itself: its slow errors turn the tracks of
            devices whose gyroscope is right. Where gravity, rest or the magnetic field show more,
            the filter widens it by itself.
        accel_bias_sigma: of the first accelerometer bias [m/s^2].
        gap_gyro_noise: while no samples arrive [rad/s/sqrt(Hz)].
        gap_accel_noise: while no samples arrive [m/s^2/sqrt(Hz)].
        stillness_noise: factor on the white noise of a phone's IMU within which a second of samples
            counts as rest (`rest`); 0 never does.
        adaptive: whether the accelerometer's density and the gyroscope bias's prior are first
            guesses that innovations and gravity correct; False where the device is known.
        magnetometer: whether a recording's or stream's magnetic field is used.
        declination: of magnetic from true north, positive east [rad]. Where it is given, a track
            whose direction nothing else tells is turned by its magnetic field, so that x points
            east and y north; None leaves its first yaw zero.
    """

    update_rate: int = 2
    covariance_scale: float = 0.5
    network_turn_sigma: float = 0.05
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
        for name in ("adaptive", "magnetometer"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise ConfigError(name, repr(getattr(self, name)), "True or False")
        for item in fields(self):
            if item.name not in ("update_rate", "gate", "adaptive", "magnetometer", "declination"):
                check_number(self, item.name)
        if self.declination is not None:
            check_number(self, "declination", -math.pi, math.pi)
        if self.covariance_scale == 0.0:
            raise ConfigError("covariance_scale", "0", "a factor > 0: nothing is measured exactly")

    @property
    def output_rate(self) -> int:
        """States per second: the IMU is folded and the state reported this often [Hz]."""
        return max(LEAST_OUTPUT_RATE, self.update_rate)

    @property
    def intervals_per_update(self) -> int:
        """States from one network update to the next."""
        return self.output_rate // self.update_rate

    @property
    def window_updates(self) -> int:
        """Updates per window: how many clones are held."""
        return round(self.update_rate * WINDOW_SECONDS)

    @property
    def overlap_scale(self) -> float:
        """Factor on the network's covariance: the same motion is measured this many times."""
        return self.update_rate * WINDOW_SECONDS * self.covariance_scale


@dataclass(frozen=True)
class GraphConfig:
    """The factor graph.

    Attributes:
        lag: how far back the graph of a stream moves its keyframes [s].
    """

    lag: float = 5.0

    def __post_init__(self) -> None:
        check_number(self, "lag", 2.0, 60.0)


@dataclass(frozen=True)
class NavigatorConfig:
    """Everything a run depends on besides the recording and the weights.

    Attributes:
        noise: densities of the IMU as the filter assumes them. Ten to thirty times a phone's at
            rest: errors of scale and alignment act like noise while it moves, and a filter that
            believes more follows the network's slow errors with its biases.
        filter: the EKF.
        graph: the factor graph.
        gravity: magnitude [m/s^2].
    """

    noise: ImuNoise = field(
        default_factory=lambda: ImuNoise(
            gyro_noise=6e-3, accel_noise=0.1, gyro_walk=1e-5, accel_walk=3e-4
        )
    )
    filter: FilterConfig = field(default_factory=FilterConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)
    gravity: float = STANDARD_GRAVITY

    def __post_init__(self) -> None:
        for name, kind in (("noise", ImuNoise), ("filter", FilterConfig), ("graph", GraphConfig)):
            value = getattr(self, name)
            if not isinstance(value, kind):
                raise ConfigError(name, f"{value!r:.60}", f"of type {kind.__name__}")
        check_number(self, "gravity", 9.5, 10.1)


def read_config(path: Path | str) -> NavigatorConfig:
    """A configuration from a TOML or JSON file.

    Raises:
        ConfigError: the file is missing or malformed, a key is unknown or a value does not fit.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        values = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
    except FileNotFoundError:
        raise ConfigError(str(path), "nothing there", "a TOML or JSON file") from None
    except OSError as error:
        found = error.strerror or "an error"
        raise ConfigError(str(path), found, "a TOML or JSON file") from error
    except ValueError as error:
        raise ConfigError(str(path), str(error), "a TOML or JSON file") from error
    if not isinstance(values, dict):
        raise ConfigError(str(path), type(values).__name__, "a table of values")
    return with_settings(NavigatorConfig(), values)
