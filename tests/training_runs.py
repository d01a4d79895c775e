"""A tiny training run, on a device on a swing, and networks that are trained quickly."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from stario.network.stario import WIDTHS
from stario.network.training.augment import Augmentation
from stario.network.training.config import TrainingConfig
from stario.network.training.data import TrainingData
from stario.network.training.train import train
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.windows import WorldStream

TINY = TrainingConfig(
    epochs=4,
    epoch_windows=128,
    batch=16,
    rate=1e-3,
    likelihood_from=0.5,
    average=0.9,
    device="cpu",
    augmentation=Augmentation(
        speeds=(1.0, 1.0), swung=0.0, any_yaw=1.0, tilt=0.02, gyro_bias=0.01, accel_bias=0.05
    ),
)


def swaying(name: str, phase: float, seconds: float = 20.0) -> WorldStream:
    """A device on a swing of period 2 s, whose acceleration determines its displacement."""
    t = np.arange(round(200 * seconds)) / 200.0
    position = np.stack([np.sin(np.pi * t + phase), 0.5 * np.sin(np.pi * t), 0.0 * t], axis=1)
    imu_W = np.zeros((len(t), 6), np.float32)
    imu_W[:, 3:] = -(np.pi**2) * position + [0.0, 0.0, STANDARD_GRAVITY]
    facing_W = np.tile(np.float32([1.0, 0.0]), (len(t), 1))
    return WorldStream(name, imu_W, position.astype(np.float32), facing_W)


STREAMS = [swaying("a", 0.3), swaying("b", 1.2)]
VALIDATION = [swaying("c", 0.8, 6.0), swaying("d", 2.0, 6.0)]
HELD_OUT = TrainingData(VALIDATION)


def narrow(patch: pytest.MonkeyPatch) -> None:
    """Give StarIO an eighth of its channels and half of its blocks."""
    patch.setattr("stario.network.stario.WIDTHS", tuple(width // 8 for width in WIDTHS))
    patch.setattr("stario.network.stario.BLOCKS", (1, 1, 1, 1))


def shallow(patch: pytest.MonkeyPatch) -> None:
    """Give RNIN one residual block in place of eight; its memory stays as it is."""
    one_block = "stario.network.baselines.networks.residual_groups"
    patch.setattr(one_block, lambda block: block(64, 512, 8))


def run(
    folder: Path, config: TrainingConfig = TINY, words: Sequence[str] = (), **options: Any
) -> Path:
    return train(config, TrainingData(STREAMS, words=words), HELD_OUT, folder, **options)
