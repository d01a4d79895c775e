"""Displacement and covariance from windows: what every network is wrapped in.

`DisplacementNetwork` is the trainable module (windows to displacement and log sigma);
`DisplacementModel` is what callers use: NumPy in, NumPy out, covariance calibrated.
"""

from __future__ import annotations

import hashlib
import importlib.resources
from pathlib import Path

import numpy as np
import safetensors
import safetensors.torch
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor, nn

from stario.network.architectures import ARCHITECTURES, build_network
from stario.network.card import Card, card_path, dump_card, read_card
from stario.network.inference import inference_form
from stario.sequences.errors import InputError, WeightsError
from stario.sequences.files import atomic_write
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray
from stario.sequences.windows import WINDOW_SAMPLES, WINDOW_SECONDS

_BATCH = 64
_LOG_SIGMA_RANGE = (-6.0, 3.0)


class DisplacementNetwork(nn.Module):
    """A network with its input centred: gravity is taken off the vertical specific force.

    Args:
        network: (B, 6, 200) to (B, 6).
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network
        self.gravity: Tensor
        gravity = torch.zeros(6, 1)
        gravity[5] = STANDARD_GRAVITY
        self.register_buffer("gravity", gravity, persistent=False)

    def forward(self, windows: Tensor) -> tuple[Tensor, Tensor]:
        """Windows (B, 6, 200) to displacement (B, 3) [m] and log sigma (B, 3)."""
        output = self.network(windows - self.gravity).float()
        return output[:, :3], output[:, 3:].clamp(*_LOG_SIGMA_RANGE)


class DisplacementModel:
    """Displacements with calibrated covariance from windows of IMU data.

    Args:
        network: trained weights.
        card: their description.
    """

    def __init__(self, network: DisplacementNetwork, card: Card) -> None:
        self.card = card
        self.training_form = network.eval()
        self._network = inference_form(network)

    @property
    def name(self) -> str:
        """The architecture's name."""
        return self.card.architecture

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Displacement over each window, from its start to one second later.

        Args:
            windows: (B, 6, 200), gyroscope [rad/s] then specific force [m/s^2] at 200 Hz, rotated
                into a gravity-aligned frame (z up, any yaw).

        Returns:
            displacement (B, 3) [m] and covariance (B, 3, 3) [m^2], in the window's frame.

        Raises:
            InputError: the shape does not fit or a value is not finite.
        """
        batch = _checked_windows(windows)
        mean, log_sigma = self._run(batch)
        variance = self.card.calibration.variance(log_sigma)
        return mean, variance[:, :, None] * np.eye(3)

    def predict_velocity(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Mean velocity over each window (B, 3) [m/s] and covariance (B, 3, 3) [m^2/s^2].

        The arguments and errors are those of `predict`.
        """
        displacement, covariance = self.predict(windows)
        return displacement / WINDOW_SECONDS, covariance / WINDOW_SECONDS**2

    def _run(self, windows: NDArray[np.float32]) -> tuple[FloatArray, FloatArray]:
        if len(windows) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3))
        with torch.inference_mode():
            parts = [self._network(part) for part in torch.split(torch.from_numpy(windows), _BATCH)]
        mean = torch.cat([m for m, _ in parts]).numpy().astype(np.float64)
        return mean, torch.cat([s for _, s in parts]).numpy().astype(np.float64)


def save_model(path: Path, network: DisplacementNetwork, card: Card) -> Card:
    """Write weights and card side by side, each whole or not at all.

    Returns:
        The card with the checksum filled in.
    """
    state = {k: v.detach().cpu().contiguous() for k, v in network.network.state_dict().items()}
    content = safetensors.torch.save(state, metadata={"architecture": card.architecture})
    card = Card(**{**vars(card), "sha256": hashlib.sha256(content).hexdigest()})
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, "wb") as file:
        file.write(content)
    with atomic_write(card_path(path)) as file:
        file.write(dump_card(card))
    return card


def load_model(name_or_path: str | Path = "default") -> DisplacementModel:
    """Load weights by name ("default": those in the package) or by path of a safetensors file.

    Raises:
        WeightsError: the file or its card is missing, cut short, or they do not match.
    """
    path = Path(name_or_path)
    if str(name_or_path) == "default":
        folder = importlib.resources.files("stario.network.weights")
        path = Path(str(folder.joinpath("default.safetensors")))
    card = read_card(path)
    if card.architecture not in ARCHITECTURES:
        known = f"one of {', '.join(ARCHITECTURES)}"
        raise WeightsError(card_path(path), "architecture", repr(card.architecture), known)
    network = DisplacementNetwork(build_network(card.architecture))
    try:
        network.network.load_state_dict(safetensors.torch.load_file(path))
    except (safetensors.SafetensorError, RuntimeError) as error:
        # PyTorch lists what does not fit below a headline that says nothing.
        lines = [line.strip() for line in str(error).splitlines()]
        raise WeightsError(
            path, "weights", lines[min(1, len(lines) - 1)], f"tensors of {card.architecture}"
        ) from error
    return DisplacementModel(network, card)


def _checked_windows(windows: ArrayLike) -> NDArray[np.float32]:
    batch = np.ascontiguousarray(windows, dtype=np.float32)
    if batch.ndim != 3 or batch.shape[1:] != (6, WINDOW_SAMPLES):
        raise InputError("windows", f"shape {batch.shape}", f"(B, 6, {WINDOW_SAMPLES})")
    if not np.isfinite(batch).all():
        raise InputError("windows", "a value that is not finite", "finite samples")
    return batch
