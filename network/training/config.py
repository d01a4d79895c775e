"""The training recipe, common to all networks, and its schedule.

The learning rate warms up and falls along a cosine as a function of the step alone, so a run that
is interrupted and resumed follows the same schedule.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from stario.network.architectures import ARCHITECTURES
from stario.network.training.augment import Augmentation, reach_of
from stario.sequences.errors import ConfigError
from stario.sequences.settings import check_number, with_settings
from stario.sequences.windows import Attitude

NETWORK_SETTINGS: dict[str, dict[str, object]] = {
    # Its LSTM runs over successive windows (Chen et al. 2021); 250 are 25 stretches of ten seconds.
    # Stretches of weak truth have the same number of windows, or twice that.
    "RNIN": {"successive": 10, "batch": 250, "track_seconds": 10},
}
"""Settings from a network's own paper that override the recipe's defaults."""

SIMULATED = "simulated"
"""Name of the simulated walks in a recipe's shares."""

INSERTED = "moments"
"""Name of the bad moments inserted into recordings in a recipe's shares."""

MADE = (SIMULATED, INSERTED)
"""Sources that are no recordings; their shares are among all windows."""

FINE_TUNING: dict[str, object] = {
    "epochs": 2,
    "epoch_windows": 40_000,
    "batch": 160,
    "rate": 1e-4,
    "learned": 0.3,
    "likelihood_from": 0.0,
    "shares": {SIMULATED: 0.05},
    "augmentation": {
        "replayed": 0.2, "swung": 0.1, "yaw": 0.05, "any_yaw": 0.0, "tilt": 0.01,
        "gyro_bias": 0.005, "accel_bias": 0.05, "gyro_noise": 0.002, "accel_noise": 0.02,
    },
}  # fmt: skip
"""Settings for weights that know walking already: those of the default weights' last stage, but
slower, and mixed with the initial weights. A few walks otherwise make a network forget the rest."""

LEAST_SECONDS = 4
"""Minimum windows per stretch of weak truth: two changes of velocity over two seconds."""

_COUNTS = {
    **dict.fromkeys(("epochs", "epoch_windows", "batch", "patience", "successive"), 1),
    **dict.fromkeys(("waypoint_stretches", "track_stretches"), 1),
    **dict.fromkeys(("waypoint_seconds", "track_seconds"), LEAST_SECONDS),
    "seed": 0,
}

_CHOICES = {
    "architecture": tuple(ARCHITECTURES),
    "precision": ("float32", "bfloat16"),
    "device": ("auto", "cpu", "cuda"),
    "attitude": ("levelled", "true"),
}

_SHARES = ("warm_up", "weight_decay", "likelihood_from", "average", "learned")


@dataclass(frozen=True)
class TrainingConfig:
    """Training recipe.

    Attributes:
        architecture: name of the network.
        epochs: number of epochs, of `epoch_windows` windows each.
        epoch_windows: windows drawn between two validations.
        batch: windows per step.
        rate: peak learning rate (Adam with decoupled weight decay).
        warm_up: share of the steps with a rising rate.
        weight_decay: decoupled weight decay.
        dropout: share of the head's features that is dropped; None for the network's own value.
        likelihood_from: share of the steps after which sigma is learned too.
        clip: maximum norm of the gradient.
        average: decay per step of the running average of the weights.
        learned: share of this average in the result; initial weights, if there are any, make up the
            rest (Wortsman et al., "Robust fine-tuning of zero-shot models", CVPR 2022).
        patience: epochs without a better validation error after which training stops.
        precision: "float32" or "bfloat16" (mixed, nearly twice as fast; a CPU without AVX-512
            computes in float32 all the same).
        device: "auto", "cpu" or "cuda".
        attitude: attitude that rotates windows into the world frame: "levelled" by the IMU, as at
            inference, or "true", the papers' protocol.
        successive: number of consecutive windows, one second apart, that a step draws from one
            place; above 1 only for a recurrent network.
        seed: seed of initial weights, draws and dropout.
        waypoint_stretches: stretches between waypoints per step, where recordings have them
            (`stario.network.training.losses`).
        waypoint_seconds: number of windows in each of them.
        track_stretches: stretches along a track of positions without attitude, per step.
        track_seconds: number of windows in each; few, because heads and phones drift
            apart in yaw.
        shares: share of the windows for each source, named by a folder, archive or file in its
            recordings' paths ("ridi.h5" or "ridi" for `archives/ridi.h5:name`); recordings of no
            named source are drawn by their length and liveliness. The share of a source that is
            absent goes to the other recordings. "simulated" and "moments" are the shares of
            simulated walks and of bad moments inserted into recordings among all windows.
        compiled: compile the network for training (torch.compile; on CPUs, it needs a C++
            compiler and saves a third of the time).
        augmentation: how windows are varied.

    Raises:
        ConfigError: a value is out of range.
    """

    architecture: str = "StarIO"
    epochs: int = 60
    epoch_windows: int = 43_008
    batch: int = 256
    rate: float = 1e-3
    warm_up: float = 0.05
    weight_decay: float = 1e-4
    dropout: float | None = None
    likelihood_from: float = 0.6
    clip: float = 1.0
    average: float = 0.998
    learned: float = 1.0
    patience: int = 20
    precision: str = "float32"
    device: str = "auto"
    attitude: Attitude = "levelled"
    successive: int = 1
    seed: int = 0
    waypoint_stretches: int = 6
    waypoint_seconds: int = 20
    track_stretches: int = 8
    track_seconds: int = 12
    shares: Mapping[str, float] = field(default_factory=dict)
    compiled: bool = False
    augmentation: Augmentation = field(default_factory=Augmentation)

    def __post_init__(self) -> None:
        for name, least in _COUNTS.items():
            value = getattr(self, name)
            if not (isinstance(value, int) and value >= least):
                raise ConfigError(name, repr(value), f"an integer of {least} or more")
        check_number(self, "seed", 0, 2**31 - 1)  # torch adds rank and step
        for name in _SHARES:
            check_number(self, name, 0.0, 1.0)
        check_number(self, "rate", 1e-8, 1.0)
        check_number(self, "clip", 1e-6, 1e6)
        if self.dropout is not None:
            check_number(self, "dropout", 0.0, 0.99)
        for name, share in self.shares.items():
            is_number = isinstance(share, int | float) and not isinstance(share, bool)
            if not (is_number and 0.0 <= share <= 1.0):
                raise ConfigError(f"shares, {name}", repr(share), "a share from 0 to 1")
        recorded = sum(share for name, share in self.shares.items() if name not in MADE)
        if recorded > 1.0 + 1e-9:
            raise ConfigError("shares", f"a sum of {recorded:g} over recorded sources", "1 or less")
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise ConfigError(name, repr(getattr(self, name)), f"one of {', '.join(choices)}")
        if self.batch % self.successive:
            expected = f"a multiple of successive={self.successive}"
            raise ConfigError("batch", str(self.batch), expected)

    @property
    def reach(self) -> int:
        """Minimum number of samples of a stream to draw from."""
        return reach_of(self.augmentation, self.successive)

    @property
    def steps_per_epoch(self) -> int:
        """Number of steps between two validations."""
        return max(1, self.epoch_windows // self.batch)

    @property
    def steps(self) -> int:
        """Maximum number of steps of the run."""
        return self.epochs * self.steps_per_epoch


def learning_rate(config: TrainingConfig, step: int) -> float:
    """Return the rate at a step: linear warm-up, then a cosine to a hundredth of the peak."""
    warm = config.warm_up * config.steps
    if step < warm:
        return config.rate * (step + 1) / max(warm, 1.0)
    progress = (step - warm) / max(config.steps - warm, 1.0)
    return config.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * progress)))


def training_config(values: dict[str, object]) -> TrainingConfig:
    """Return a recipe from plain values (a parsed JSON file); unknown keys are rejected.

    Raises:
        ConfigError: a key is unknown or a value out of range.
    """
    architecture = values.get("architecture", TrainingConfig.architecture)
    own = NETWORK_SETTINGS.get(str(architecture), {})
    return with_settings(TrainingConfig(), {**own, **values})
