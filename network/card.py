"""Card of a weights file: architecture, inputs, calibration, training data.

Weights are a safetensors file; the card is the JSON file next to it. Loading rejects a pair that
does not match in architecture, window, frame or checksum. Nothing is ever unpickled.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from stario.sequences.errors import ConfigError, WeightsError
from stario.sequences.sequence import FloatArray
from stario.sequences.settings import with_settings
from stario.sequences.windows import WINDOW_RATE, WINDOW_SAMPLES

FORMAT = 1
FRAME = "gravity-aligned, z up, the device's heading zero"
FRAMES = (FRAME, "gravity-aligned, z up, yaw arbitrary")
"""Accepted frames; a network trained at any yaw can also use windows at the device's heading."""

MAX_SIGMA = 5.0
"""Upper limit of sigma [m]: nobody walks further in a second."""

_STEEPEST = 10.0
"""Largest accepted exponent, beyond any that a calibration finds."""

CHANNELS = ["gyro_x", "gyro_y", "gyro_z", "accel_x", "accel_y", "accel_z"]

_FIXED = {
    "format": FORMAT,
    "outputs": 6,
    "rate": WINDOW_RATE,
    "samples": WINDOW_SAMPLES,
    "channels": CHANNELS,
}
"""Fields that are the same on every card."""


@dataclass(frozen=True)
class Calibration:
    """Calibration of a network's log standard deviations, fitted on validation recordings.

    sigma = sqrt((scale * exp(exponent * log_sigma))^2 + floor^2), each per axis x, y, z of the
    window's frame (x and y share their values, because the frame's yaw is arbitrary).

    Attributes:
        scale: factors on the network's sigma.
        exponent: powers of the network's sigma.
        floor: minimum sigma [m], above 0.

    Raises:
        ConfigError: a value is out of range.
    """

    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    exponent: tuple[float, float, float] = (1.0, 1.0, 1.0)
    floor: tuple[float, float, float] = (0.005, 0.005, 0.005)

    def __post_init__(self) -> None:
        for name in ("scale", "exponent", "floor"):
            values = getattr(self, name)
            if len(values) != 3 or not all(math.isfinite(v) and v >= 0.0 for v in values):
                raise ConfigError(name, repr(values), "three finite numbers of 0 or more")
        if min(self.floor) <= 0.0:
            raise ConfigError("floor", repr(self.floor), "above 0, against a covariance of 0")
        if max(self.exponent) > _STEEPEST:
            raise ConfigError("exponent", repr(self.exponent), f"up to {_STEEPEST:g}")

    def variance(self, log_sigma: FloatArray) -> FloatArray:
        """Return calibrated variances (M, 3) [m^2] for log sigmas (M, 3)."""
        sigma = np.array(self.scale) * np.exp(np.array(self.exponent) * log_sigma)
        return np.asarray(np.minimum(sigma, MAX_SIGMA) ** 2 + np.square(self.floor))


@dataclass(frozen=True)
class Card:
    """Description of a weights file.

    Attributes:
        architecture: a name in `architectures.ARCHITECTURES`.
        outputs: number of outputs: 3 displacements [m], then 3 log standard deviations.
        rate: sampling rate of a window [Hz].
        samples: number of samples of a window.
        frame: frame of the window and the displacement.
        channels: rows of a window; gyroscope in rad/s, accelerometer in m/s^2.
        sha256: checksum of the weights file.
        calibration: calibration of the standard deviations.
        trained_on: descriptions of the training recordings and simulations.
        recipe: the command and settings that produced the weights.
        figures: results on named recordings.
        format: version of the card's layout.

    Raises:
        ConfigError: the card describes other windows.
    """

    architecture: str
    sha256: str = ""
    outputs: int = 6
    rate: float = WINDOW_RATE
    samples: int = WINDOW_SAMPLES
    frame: str = FRAME
    channels: list[str] = field(default_factory=lambda: list(CHANNELS))
    calibration: Calibration = field(default_factory=Calibration)
    trained_on: list[str] = field(default_factory=list)
    recipe: dict[str, Any] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)
    format: int = FORMAT

    def __post_init__(self) -> None:
        for name, expected in _FIXED.items():
            if getattr(self, name) != expected:
                raise ConfigError(name, repr(getattr(self, name)), repr(expected))
        if self.frame not in FRAMES:
            raise ConfigError("frame", repr(self.frame), repr(FRAME))


def card_path(weights: Path) -> Path:
    """Return the card's path: `NAME.json` next to `NAME.safetensors`."""
    return weights.with_suffix(".json")


def dump_card(card: Card) -> str:
    """Return the card as JSON text."""
    return json.dumps(asdict(card), indent=2) + "\n"


def read_weights(weights: Path) -> tuple[bytes, Card]:
    """Read a weights file and its card, and check that they belong together.

    Returns:
        content of the safetensors file, and the card.

    Raises:
        WeightsError: card or weights are missing, malformed, of another kind, or the checksum
            differs.
    """
    path = card_path(weights)
    if weights.is_dir():
        fix = f"name the one in it: {weights / 'model.safetensors'}"
        raise WeightsError(weights, "file", "a folder", "a file of weights", fix)
    for needed in (weights, path):
        if not needed.is_file():
            raise WeightsError(needed, "file", "nothing there", "weights and card in one folder")
    card = parse_card(path.read_bytes(), path)
    content = weights.read_bytes()
    digest = hashlib.sha256(content).hexdigest()
    if digest != card.sha256:
        raise WeightsError(
            weights,
            "sha256",
            digest[:12],
            f"{card.sha256[:12]} as on the card",
            "the file is truncated or belongs to another card",
        )
    return content, card


def parse_card(text: str | bytes, path: Path) -> Card:
    """Parse a card from its JSON text.

    Args:
        text: JSON text as returned by `dump_card`.
        path: path of the file that the text is from, for the error.

    Raises:
        WeightsError: the text is not a card, or the card describes other windows.
    """
    try:
        content = json.loads(text)
        content.pop("known_motion", None)  # on cards until 2026; nothing depends on it any more
        for kind, given in ((Card, content), (Calibration, content.get("calibration", {}))):
            if isinstance(given, dict) and (lacking := {f.name for f in fields(kind)} - {*given}):
                raise ValueError(f"no {min(lacking)!r} in {kind.__name__.lower()}")
        return with_settings(Card(""), content)
    except ConfigError as error:
        raise WeightsError(path, error.field, error.found, error.expected) from error
    except (ValueError, TypeError, AttributeError, RecursionError) as error:
        raise WeightsError(path, "card", str(error), "a StarIO weights card") from error
