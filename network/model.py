"""Displacement and covariance from windows: what callers use, NumPy in and NumPy out.

A `DisplacementModel` is an engine that computes a network and the card with its calibration.
"""

from __future__ import annotations

import hashlib
import importlib.resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stario.network.architectures import ARCHITECTURES, build_network
from stario.network.card import Card, card_path, dump_card, read_card
from stario.network.runtime.engines import Engine, TorchEngine
from stario.sequences.errors import InputError, WeightsError
from stario.sequences.files import atomic_write
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WINDOW_SAMPLES

if TYPE_CHECKING:  # an exported graph does without PyTorch
    from stario.network.displacement import DisplacementNetwork


class DisplacementModel:
    """Displacements with calibrated covariance from windows of IMU data.

    Args:
        engine: computes the network.
        card: description of its weights.
    """

    def __init__(self, engine: Engine, card: Card) -> None:
        self.card = card
        self._engine = engine

    @property
    def name(self) -> str:
        """The architecture's name."""
        return self.card.architecture

    @property
    def training_form(self) -> DisplacementNetwork:
        """The network as it is trained, in evaluation mode.

        Raises:
            InputError: the model is an exported graph.
        """
        return self._engine.training_form

    def stateful_inference(self, updates: int = 1) -> DisplacementModel | StatefulModel:
        """What predicts the windows of one unbroken track, in the order of time.

        Args:
            updates: windows that begin within the length of one: a window follows the one so many
                before it.

        Returns:
            The model itself, or a `StatefulModel` if the network remembers earlier windows.
        """
        return StatefulModel(self, updates) if self._engine.remembers else self

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Displacement over each window, from its start to one second later.

        Args:
            windows: (B, 6, 200), gyroscope [rad/s] then specific force [m/s^2] at 200 Hz, rotated
                into a gravity-aligned frame (z up, any yaw).

        Returns:
            displacement (B, 3) [m] and covariance (B, 3, 3) [m^2], in the window's frame; wider
            where a window lies outside what the weights know (`stario.network.known_motion`).

        Raises:
            InputError: the shape does not fit or a value is not finite.
        """
        batch = _checked_windows(windows)
        if len(batch) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3, 3))
        mean, log_sigma, _ = self._engine.run(batch)
        return self._calibrated(batch, mean, log_sigma)

    def predict_after(
        self, window: NDArray[np.float32], state: NDArray[np.float32] | None
    ) -> tuple[FloatArray, FloatArray, NDArray[np.float32]]:
        """Of a network that remembers: one window (1, 6, 200) after the one that left the state.

        Returns:
            displacement (1, 3) [m], covariance (1, 3, 3) [m^2], and the state that it leaves.
        """
        if state is None:
            state = self._engine.first_state()
        mean, log_sigma, after = self._engine.run(window, state)
        assert after is not None  # a state that is given comes back
        return *self._calibrated(window, mean, log_sigma), after

    def _calibrated(
        self,
        windows: NDArray[np.float32],
        mean: NDArray[np.float32],
        log_sigma: NDArray[np.float32],
    ) -> tuple[FloatArray, FloatArray]:
        variance = self.card.calibration.variance(log_sigma.astype(np.float64))
        if self.card.known_motion is not None:
            variance *= self.card.known_motion.variance_factor(windows)[:, None]
        return mean.astype(np.float64), variance[:, :, None] * np.eye(3)


Memory = tuple[int, tuple[NDArray[np.float32] | None, ...]]
"""Of a network along a track: windows so far, and what each series of them left."""


class StatefulModel:
    """A model whose network remembers earlier windows, along one track.

    Args:
        model: whose network remembers.
        updates: windows that begin within the length of one; each such series of windows, one
            second apart, has a memory of its own, as in training.

    Attributes:
        memory: how many windows there were, and what each series remembers; may be put back.
    """

    def __init__(self, model: DisplacementModel, updates: int) -> None:
        self._model = model
        self.memory: Memory = (0, (None,) * updates)

    def predict(self, windows: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """The track's next windows; arguments, results and errors as of `DisplacementModel`."""
        batch = _checked_windows(windows)
        mean, covariance = np.zeros((len(batch), 3)), np.zeros((len(batch), 3, 3))
        count, (*states,) = self.memory
        for k in range(len(batch)):
            series = count % len(states)
            mean[k : k + 1], covariance[k : k + 1], states[series] = self._model.predict_after(
                batch[k : k + 1], states[series]
            )
            count += 1
        self.memory = count, tuple(states)
        return mean, covariance


def save_model(path: Path, network: DisplacementNetwork, card: Card) -> Card:
    """Write weights and card side by side, each whole or not at all.

    Returns:
        The card with the checksum filled in.
    """
    state = {k: v.detach().cpu().contiguous() for k, v in network.network.state_dict().items()}
    import safetensors.torch

    content = safetensors.torch.save(state, metadata={"architecture": card.architecture})
    card = Card(**{**vars(card), "sha256": hashlib.sha256(content).hexdigest()})
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path, "wb") as file:
        file.write(content)
    with atomic_write(card_path(path)) as file:
        file.write(dump_card(card))
    return card


def packaged_names() -> str:
    """Weights in the package, as words."""
    folder = importlib.resources.files("stario.network.weights")
    found = (Path(str(file)) for file in folder.iterdir())
    *names, last = sorted(file.stem for file in found if file.suffix == ".safetensors")
    return f"{', '.join(names)} or {last}"


def load_model(name_or_path: str | Path = "default") -> DisplacementModel:
    """Load a model by name or path.

    Args:
        name_or_path: of weights in the package ("default"; "open", whose sources allow any use;
            "first-stage", which left groups out; "walks-36min", those before), a safetensors file
            with its card beside it, or an ONNX file of `export_onnx`, which ONNX Runtime then
            computes.

    Raises:
        WeightsError: the file or its card is missing, cut short, or they do not match.
        InputError: an ONNX file, but onnxruntime is not installed.
    """
    if not isinstance(name_or_path, str | Path):
        raise InputError("name_or_path", f"{name_or_path!r:.60}", f"{packaged_names()}, or a file")
    path = Path(name_or_path)
    if path.suffix == ".onnx":
        from stario.network.runtime.onnx_file import load_onnx

        return DisplacementModel(*load_onnx(path))
    packaged = Path(str(importlib.resources.files("stario.network.weights")), f"{path}.safetensors")
    if path.parent == Path() and not path.suffix and packaged.is_file():
        path = packaged
    if path.parent == Path() and not path.suffix and not path.exists():
        raise WeightsError(path, "weights", "nothing there", f"a file, or {packaged_names()}")
    card = read_card(path)
    if card.architecture not in ARCHITECTURES:
        known = f"one of {', '.join(ARCHITECTURES)}"
        raise WeightsError(card_path(path), "architecture", repr(card.architecture), known)
    import safetensors.torch

    from stario.network.displacement import DisplacementNetwork

    network = DisplacementNetwork(build_network(card.architecture))
    try:
        network.network.load_state_dict(safetensors.torch.load_file(path))
    except (safetensors.SafetensorError, RuntimeError) as error:
        # PyTorch lists what does not fit below a headline that says nothing.
        lines = [line.strip() for line in str(error).splitlines()]
        raise WeightsError(
            path, "weights", lines[min(1, len(lines) - 1)], f"tensors of {card.architecture}"
        ) from error
    return DisplacementModel(TorchEngine(network), card)


def weights_named(name: str, runs: Path) -> str | Path:
    """What `load_model` takes for a network's name, a file or "default".

    Args:
        name: "default"; an architecture, whose training run is the folder of that name in `runs`
            (StarIO without one means the default weights); or a file.
        runs: folder of training runs.

    Raises:
        WeightsError: the architecture has no weights there.
    """
    if name not in ARCHITECTURES:
        return name
    path = runs / name / "model.safetensors"
    if path.is_file():
        return path
    if name == "StarIO":
        return "default"
    fix = f"train it: stario train --model '{name}' --out '{runs / name}'"
    raise WeightsError(path, "file", "nothing there", f"weights of {name}", fix)


def _checked_windows(windows: ArrayLike) -> NDArray[np.float32]:
    batch = np.require(windows, np.float32, ["C", "W"])  # torch warns of what is read-only
    if batch.ndim != 3 or batch.shape[1:] != (6, WINDOW_SAMPLES):
        raise InputError("windows", f"shape {batch.shape}", f"(B, 6, {WINDOW_SAMPLES})")
    if not np.isfinite(batch).all():
        raise InputError("windows", "a value that is not finite", "finite samples")
    return batch
