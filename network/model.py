"""Public interface: displacements and covariances from windows, all as NumPy arrays.

A `DisplacementModel` combines an engine, which runs a network, and the card with its calibration.
"""

from __future__ import annotations

import hashlib
import importlib.resources
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from stario.network.architectures import ARCHITECTURES
from stario.network.card import Card, card_path, dump_card, read_weights
from stario.network.runtime.engines import Engine, Float32Array, load_onnx, weights_engine
from stario.sequences.errors import InputError, WeightsError
from stario.sequences.files import atomic_write
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SAMPLES

if TYPE_CHECKING:  # PyTorch is imported only by what needs it
    from stario.network.displacement import DisplacementNetwork


Memory = tuple[int, tuple[Float32Array | None, ...]]
"""State along a track: number of windows so far, and the network's state for each series."""


class DisplacementModel:
    """Model that predicts displacements with calibrated covariance from windows of IMU data.

    Args:
        engine: engine that runs the network.
        card: description of its weights.

    Attributes:
        engine: that engine.
        card: that card.
    """

    def __init__(self, engine: Engine, card: Card) -> None:
        self.engine, self.card = engine, card

    def __repr__(self) -> str:
        return f"DisplacementModel({self.name}, sha256 {self.card.sha256[:12] or 'unknown'})"

    @property
    def name(self) -> str:
        """Name of the architecture."""
        return self.card.architecture

    @property
    def training_form(self) -> DisplacementNetwork:
        """Trainable form of the network, in evaluation mode.

        Raises:
            InputError: the model is an exported graph.
        """
        return self.engine.training_form

    @property
    def is_recurrent(self) -> bool:
        """Whether predictions depend on earlier windows (`predict_next`)."""
        return self.engine.state_size > 0

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Predict the displacement over each window, from its start to one second later.

        For a recording, `Navigator.observe(recording).measurements` gives the displacements.

        Args:
            windows: (B, 6, 200), gyroscope [rad/s] then specific force [m/s^2] at 200 Hz, rotated
                into frame H: z up, the device's heading zero (README, "The window and its frame").

        Returns:
            Displacement (B, 3) [m] and covariance (B, 3, 3) [m^2], in the window's frame.

        Raises:
            InputError: the shape is wrong or a value is not finite.
        """
        batch = _checked_windows(windows)
        if len(batch) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3, 3))
        mean, log_sigma, _ = self.engine.run(batch)
        return self._calibrated(mean, log_sigma)

    def predict_next(
        self, windows: ArrayLike, updates: int, memory: Memory | None = None
    ) -> tuple[FloatArray, FloatArray, Memory]:
        """Predict the next windows of an unbroken track with a recurrent network.

        Args:
            windows: (B, 6, 200) as for `predict`, in order of time.
            updates: number of windows that begin within the length of one; each such series of
                windows, one second apart, has its own state, as in training.
            memory: what was returned with the windows before; None at the start of a track.

        Returns:
            Displacement and covariance as from `predict`, and the memory of these windows.

        Raises:
            InputError: as for `predict`.
        """
        batch = _checked_windows(windows)
        mean, log_sigma = np.zeros((2, len(batch), 3), np.float32)
        first, (*states,) = memory or (0, (None,) * updates)
        for k in range(len(batch)):
            series = (first + k) % updates
            answer = self.engine.run(batch[k : k + 1], states[series])
            mean[k], log_sigma[k], states[series] = answer
        return *self._calibrated(mean, log_sigma), (first + len(batch), tuple(states))

    def _calibrated(
        self, mean: Float32Array, log_sigma: Float32Array
    ) -> tuple[FloatArray, FloatArray]:
        """Return displacements and covariances from the network's own outputs."""
        variance = self.card.calibration.variance(log_sigma.astype(np.float64))
        return mean.astype(np.float64), variance[:, :, None] * np.eye(3)


def save_model(path: Path, network: DisplacementNetwork, card: Card) -> Card:
    """Write weights and card into one folder, each atomically.

    Returns:
        The card with the checksum filled in.
    """
    state = {k: v.detach().cpu().contiguous() for k, v in network.network.state_dict().items()}
    import safetensors.torch

    content = safetensors.torch.save(state, metadata={"architecture": card.architecture})
    card = replace(card, sha256=hashlib.sha256(content).hexdigest())
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, "wb") as file:
        file.write(content)
    with atomic_write(card_path(path)) as file:
        file.write(dump_card(card))
    return card


def packaged_names() -> str:
    """Return the names of the packaged weights as text, for messages."""
    folder = importlib.resources.files("stario.network.weights")
    found = (Path(str(file)) for file in folder.iterdir())
    *names, last = sorted(file.stem for file in found if file.suffix == ".safetensors")
    return f"{', '.join(names)} or {last}"


def load_model(name_or_path: str | Path = "default") -> DisplacementModel:
    """Load a model by name or path.

    Args:
        name_or_path: name of packaged weights ("default", or "open", whose sources allow any use),
            a safetensors file with its card next to it, or an ONNX file written by `export_onnx`.
            In a clone of the repository also "first-stage", trained without the held-out groups,
            and "walks-36min", the earlier ones. StarIO and ONNX files run in ONNX Runtime, other
            networks in PyTorch.

    Raises:
        WeightsError: the file or its card is missing or truncated, or they do not match.
        InputError: neither a name nor a path.
    """
    if not isinstance(name_or_path, str | Path):
        raise InputError("name_or_path", f"{name_or_path!r:.60}", f"{packaged_names()}, or a file")
    path = Path(name_or_path)
    if path.suffix == ".onnx":
        return DisplacementModel(*load_onnx(path))
    packaged = Path(str(importlib.resources.files("stario.network.weights")), f"{path}.safetensors")
    is_name = path.parent == Path() and not path.suffix
    if is_name and packaged.is_file():
        path = packaged
    elif is_name and not path.exists():
        fix = "others are files in network/weights of StarIO's repository"
        raise WeightsError(path, "weights", "no such file", f"a file, or {packaged_names()}", fix)
    content, card = read_weights(path)
    if card.architecture not in ARCHITECTURES:
        known = f"one of {', '.join(ARCHITECTURES)}"
        raise WeightsError(card_path(path), "architecture", repr(card.architecture), known)
    engine = weights_engine(card.architecture, content)
    return DisplacementModel(engine or _torch_engine(card.architecture, content, path), card)


def _torch_engine(architecture: str, content: bytes, path: Path) -> Engine:
    import safetensors.torch

    from stario.network.displacement import trainable
    from stario.network.runtime.torch_engine import TorchEngine

    try:
        return TorchEngine(trainable(architecture, safetensors.torch.load(content)))
    except (safetensors.SafetensorError, RuntimeError) as error:
        expected = f"tensors of {architecture}"
        raise WeightsError(path, "weights", first_mismatch(error), expected) from error


def first_mismatch(error: Exception) -> str:
    """Return what an error of loading tensors names first.

    PyTorch lists the mismatches below an uninformative headline, all 200 names in one line if they
    are those of another network.
    """
    lines = [line.strip() for line in str(error).splitlines()] or [""]
    return f"{lines[min(1, len(lines) - 1)]:.160}"


def weights_named(name: str, runs: Path) -> str | Path:
    """Return the argument of `load_model` for a network's name, a file or "default".

    Args:
        name: "default"; an architecture, whose training run is the folder of that name in `runs`
            (for StarIO without a run, the default weights); or a file.
        runs: folder of training runs.

    Raises:
        WeightsError: the architecture has no weights in `runs`.
    """
    if name not in ARCHITECTURES:
        return name
    path = runs / name / "model.safetensors"
    if path.is_file():
        return path
    if name == "StarIO":
        return "default"
    fix = f"train it: stario train --model '{name}' --out '{runs / name}'"
    raise WeightsError(path, "file", "no such file", f"weights of {name}", fix)


def _checked_windows(windows: ArrayLike) -> Float32Array:
    try:
        batch = np.require(windows, np.float32, ["C", "W"])  # torch warns about read-only arrays
    except (TypeError, ValueError) as error:
        raise InputError("windows", str(error), f"numbers (B, 6, {WINDOW_SAMPLES})") from error
    if batch.ndim != 3 or batch.shape[1:] != (6, WINDOW_SAMPLES):
        raise InputError("windows", f"shape {batch.shape}", f"(B, 6, {WINDOW_SAMPLES})")
    if not np.isfinite(batch).all():
        raise InputError("windows", "a value that is not finite", "finite samples")
    return batch
