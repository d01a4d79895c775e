"""Familiarity of a recording's motion to a model, and direction of the model's displacements."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stario.fusion.evaluation.benchmark.direction import Direction, direction
from stario.fusion.evaluation.benchmark.network_alone import predict_stream
from stario.fusion.health import UNFAMILIAR_SHARE
from stario.network.known_motion import FEATURES, features, step_rates
from stario.network.model import DisplacementModel
from stario.sequences.levelled_stream import levelled_streams
from stario.sequences.sequence import ImuSequence
from stario.sequences.windows import WINDOW_SECONDS

_TURNED, _VAGUE = math.radians(45.0), math.radians(20.0)
"""Turn above which a warning is given, and sigma below which agreement is reported [rad]."""

_WORDS = {
    "acceleration": ("acceleration", "m/s^2 rms"),
    "turning": ("rate of turn", "rad/s rms"),
    "fast": ("share of power above 10 Hz", ""),
    "middle": ("share of power from 3 to 10 Hz", ""),
    "vertical": ("share of power along the vertical", ""),
    "step_rate": ("step rate", "Hz"),
    "speed": ("predicted speed", "m/s"),
}


@dataclass(frozen=True)
class Familiarity:
    """Comparison of a recording with the motion that a model's weights were trained on.

    Attributes:
        outside: share of its windows outside that motion; None if the card does not describe it.
        medians: median of each feature, of the step rate and of the speed.
        ranges: 1st and 99th percentile of the training windows.
        direction: direction of the network's displacements relative to the accelerometer.
    """

    outside: float | None
    medians: dict[str, float]
    ranges: dict[str, tuple[float, float]]
    direction: Direction

    @property
    def is_unfamiliar(self) -> bool:
        """Whether too many windows lie outside for the track to be trusted fully."""
        return self.outside is not None and self.outside > UNFAMILIAR_SHARE

    def as_dict(self) -> dict[str, object]:
        """Return the findings as plain values."""
        turn, sigma = (math.degrees(v) for v in (self.direction.turn, self.direction.sigma))
        return {
            "outside": self.outside,
            "medians": self.medians,
            "known": self.ranges,
            "direction": {"turn_deg": None if math.isnan(turn) else turn, "sigma_deg": sigma},
        }

    def lines(self) -> list[str]:
        """Return the findings as lines of text."""
        return self._motion_lines() + self._direction_lines()

    def _direction_lines(self) -> list[str]:
        turn, sigma = self.direction.turn, self.direction.sigma
        difference = f"{math.degrees(turn):.0f} (+-{math.degrees(sigma):.0f}) degrees"
        if abs(turn) > max(_TURNED, 3.0 * sigma):
            return [
                f"! the network's direction differs from the accelerometer's by {difference}: its "
                "track is rotated by this angle, and fusion suffers; use other weights"
            ]
        if sigma < _VAGUE:
            return [f"  the network's direction matches the accelerometer's: off by {difference}"]
        return []

    def _motion_lines(self) -> list[str]:
        if not self.medians:
            return ["motion: no unbroken stretch is long enough to assess it"]
        width = max(len(_WORDS[name][0]) for name in self.medians)
        lines = ["motion, medians:"]
        for name, value in self.medians.items():
            word, unit = _WORDS[name]
            lines.append(f"  {word:<{width}} {value:6.2f} {unit}".rstrip())
        if self.outside is None:
            return [*lines, "  the weights' card does not describe the motion they were trained on"]
        share = f"{self.outside:.0%} of the windows lie outside the weights' training data"
        if not self.is_unfamiliar:
            return [*lines, f"  {share}"]
        beyond = [
            f"{_WORDS[name][0]} {value:.2f} (known {low:.2f} to {high:.2f})"
            for name, value in self.medians.items()
            if name in self.ranges
            for low, high in (self.ranges[name],)
            if not low <= value <= high
        ]
        reason = ", ".join(beyond) or (
            "each feature is within the range of the training, but not their combination"
        )
        return [*lines, f"! {share}: {reason}; the network's sigma is inflated there"]


def familiarity(model: DisplacementModel, sequence: ImuSequence) -> Familiarity:
    """Compare a recording's windows with those that a model's weights were trained on.

    Raises:
        InputError: too few samples, or their rate is not between 50 Hz and 1 kHz.
    """
    streams = levelled_streams(sequence)
    if not streams:
        return Familiarity(None, {}, {}, Direction())
    windows = np.concatenate([stream.windows()[::2] for stream in streams])
    predicted = [predict_stream(model, stream).displacement_N for stream in streams]
    observed = sum(map(direction, streams, predicted), Direction())
    speeds = np.linalg.norm(np.concatenate(predicted)[:, :2], axis=1) / WINDOW_SECONDS
    medians = dict(zip(FEATURES, np.median(features(windows), axis=0).tolist(), strict=True))
    rates = np.concatenate([step_rates(stream.imu_N) for stream in streams])
    if len(rates):
        medians["step_rate"] = float(np.median(rates))
    medians["speed"] = float(np.median(speeds))
    training = model.card.known_motion
    if training is None:
        return Familiarity(None, medians, {}, observed)
    outside = float(np.mean(training.is_unfamiliar(windows)))
    return Familiarity(outside, medians, dict(training.ranges), observed)
