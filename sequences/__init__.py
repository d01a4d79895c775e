"""What was recorded: sequences, readers, simulation, windows, metrics and figures."""

from stario.sequences.errors import (
    ConfigError,
    InputError,
    ReadError,
    StarioError,
    WeightsError,
)
from stario.sequences.noise import ImuNoise
from stario.sequences.sequence import STANDARD_GRAVITY, ImuSequence, Trajectory

__all__ = [
    "STANDARD_GRAVITY",
    "ConfigError",
    "ImuNoise",
    "ImuSequence",
    "InputError",
    "ReadError",
    "StarioError",
    "Trajectory",
    "WeightsError",
]
