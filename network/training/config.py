"""The training recipe: one for every network, its loss and its schedule.

The mean is learned by squared error from first to last. Sigma joins later, by the Gaussian
likelihood e^2 / (2 sigma^2) + log sigma of the mean's error as it stands (detached): the joint
likelihood, also weighted by sigma (Seitzer et al. 2022), starves the mean of gradient wherever
sigma is large, and it is the large errors that a track is made of.

The rate warms up and falls along a cosine as a function of the step alone, so a run that is killed
and resumed follows the same schedule.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from stario.network.architectures import ARCHITECTURES
from stario.network.training.augment import Augmentation, reach_of
from stario.sequences.errors import ConfigError
from stario.sequences.settings import check_number, with_settings
from stario.sequences.windows import Attitude

NETWORK_SETTINGS: dict[str, dict[str, object]] = {
    # Its LSTM runs over successive windows (Chen et al. 2021); 250 are 25 walks of ten seconds.
    # Stretches of weak truth are as many windows in a row, or twice as many.
    "RNIN": {"successive": 10, "batch": 250, "track_seconds": 10},
}
"""Settings that a network's own paper asks for, over the recipe's defaults."""

SIMULATED = "simulated"
"""What a recipe's shares call the simulated walks."""

SIGMA_WEIGHT = 0.05
"""Of the likelihood beside the squared error [m^2]: as large as a good error's square."""

LEAST_SECONDS = 4
"""Windows in a row of weak truth: two changes of velocity over two seconds."""

_COUNTS = {
    "epochs": 1,
    "epoch_windows": 1,
    "batch": 1,
    "patience": 1,
    "successive": 1,
    "waypoint_stretches": 1,
    "waypoint_seconds": LEAST_SECONDS,
    "track_stretches": 1,
    "track_seconds": LEAST_SECONDS,
}

_RANGES = (
    ("rate", 1e-8, 1.0),
    ("warm_up", 0.0, 1.0),
    ("weight_decay", 0.0, 1.0),
    ("likelihood_from", 0.0, 1.0),
    ("clip", 1e-6, 1e6),
    ("average", 0.0, 1.0),
)


@dataclass(frozen=True)
class TrainingConfig:
    """The recipe.

    Attributes:
        architecture: name of the network.
        epochs: passes of `epoch_windows` windows.
        epoch_windows: windows drawn between two validations.
        batch: windows per step.
        rate: peak learning rate (Adam with decoupled weight decay).
        warm_up: share of the steps with a rising rate.
        weight_decay: decoupled.
        dropout: share of the head's features that is silenced; None leaves it to the network.
        likelihood_from: share of the steps after which sigma is learned too.
        clip: largest norm of the gradient.
        average: decay of the running average of the weights per step.
        patience: epochs without a better validation error after which training stops.
        precision: "float32" or "bfloat16" (mixed; nearly twice as fast where there is support).
        device: "auto", "cpu" or "cuda".
        attitude: by which windows are turned into the world: "levelled" by the IMU, as in use, or
            "true", the papers' protocol.
        successive: windows in a row, one second apart, that a step draws from one place; more than
            one only for a network that remembers earlier windows.
        seed: of initial weights, draws and dropout.
        waypoint_stretches: stretches between waypoints that a step learns from, where recordings
            have them (`stario.network.training.weak_truth`).
        waypoint_seconds: windows in each of them.
        track_stretches: the same of stretches along a track of positions without attitude.
        track_seconds: windows in each; short, as heads and phones drift apart in yaw.
        shares: of the windows that each source makes up, by a part of its recordings' path;
            those that none names are drawn by their length and liveliness. What is named but not
            there leaves its share to the other recordings. "simulated" is the share of simulated
            walks among all windows.
        compiled: compile the network for training (torch.compile; needs a C++ compiler on CPUs,
            which saves a third of the time).
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
                raise ConfigError(name, repr(value), f"a count of at least {least}")
        for name, low, high in _RANGES:
            check_number(self, name, low, high)
        for name, share in self.shares.items():
            if not (isinstance(share, int | float) and 0.0 <= share <= 1.0):
                raise ConfigError(f"shares, {name}", repr(share), "a share from 0 to 1")
        recorded = sum(share for name, share in self.shares.items() if name != SIMULATED)
        if recorded > 1.0 + 1e-9:
            raise ConfigError(
                "shares", f"{recorded:g} of the recordings' windows in all", "1 or less"
            )
        if self.architecture not in ARCHITECTURES:
            known = f"one of {', '.join(ARCHITECTURES)}"
            raise ConfigError("architecture", repr(self.architecture), known)
        if not (isinstance(self.seed, int) and 0 <= self.seed < 2**31):
            raise ConfigError("seed", repr(self.seed), "a count from 0 to below 2^31")
        dropout = 0.0 if self.dropout is None else self.dropout
        if not (isinstance(dropout, int | float) and 0.0 <= dropout < 1.0):
            raise ConfigError("dropout", repr(self.dropout), "a share from 0 to below 1, or none")
        if self.precision not in ("float32", "bfloat16"):
            raise ConfigError("precision", repr(self.precision), "float32 or bfloat16")
        if self.batch % self.successive:
            raise ConfigError(
                "batch", str(self.batch), f"a multiple of successive={self.successive}"
            )
        if self.device not in ("auto", "cpu", "cuda"):
            raise ConfigError("device", repr(self.device), "auto, cpu or cuda")
        if self.attitude not in ("levelled", "true"):
            raise ConfigError("attitude", repr(self.attitude), "levelled or true")

    @property
    def reach(self) -> int:
        """Samples that a stream must have to be drawn from."""
        return reach_of(self.augmentation, self.successive)

    @property
    def steps_per_epoch(self) -> int:
        """Steps between two validations."""
        return max(1, self.epoch_windows // self.batch)

    @property
    def steps(self) -> int:
        """Steps of the whole run."""
        return self.epochs * self.steps_per_epoch


def loss_with_sigma(squared: Tensor, log_sigma: Tensor) -> Tensor:
    """Squared errors (B, 3) [m^2] and the likelihood of sigma given them, side by side."""
    likelihood = 0.5 * squared.detach() * torch.exp(-2.0 * log_sigma) + log_sigma
    return (squared + SIGMA_WEIGHT * likelihood).sum(1).mean()


def learning_rate(config: TrainingConfig, step: int) -> float:
    """Linear warm-up, then a cosine down to a hundredth of the peak."""
    warm = config.warm_up * config.steps
    if step < warm:
        return config.rate * (step + 1) / max(warm, 1.0)
    progress = (step - warm) / max(config.steps - warm, 1.0)
    return config.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * progress)))


def training_config(values: dict[str, object]) -> TrainingConfig:
    """A recipe from plain values (a parsed JSON file), unknown keys refused.

    Raises:
        ConfigError: a key is unknown or a value out of range.
    """
    architecture = values.get("architecture", TrainingConfig.architecture)
    own = NETWORK_SETTINGS.get(str(architecture), {})
    return with_settings(TrainingConfig(), {**own, **values})
