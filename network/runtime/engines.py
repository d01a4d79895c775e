"""Engines that run a network: PyTorch from weights, ONNX Runtime from an exported file.

Both map windows to displacement and log sigma. A recurrent network (RNIN) also takes the state
after the previous window and returns the state for the next one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stario.sequences.errors import InputError

if TYPE_CHECKING:  # ONNX Runtime alone must work without PyTorch
    from stario.network.displacement import DisplacementNetwork

Float32Array = NDArray[np.float32]

Answer = tuple[Float32Array, Float32Array, Float32Array | None]
"""Displacement (B, 3) [m], log sigma (B, 3), and the state after these windows."""

_BATCH = 64


class TorchEngine:
    """PyTorch on the CPU, in the network's fastest form.

    Args:
        network: network with its weights; it is left in evaluation mode.

    Attributes:
        training_form: that network, whose weights are trainable.
    """

    def __init__(self, network: DisplacementNetwork) -> None:
        from stario.network.runtime.inference import inference_form

        self.training_form = network.eval()
        self._network = inference_form(network)

    @property
    def is_recurrent(self) -> bool:
        """Whether the network is recurrent: it carries a state from window to window."""
        return self._network.is_recurrent

    def first_state(self) -> Float32Array:
        """Return the state (2, 1, H) of a recurrent network before the first window."""
        return self._network.first_state(1).numpy()

    def run(self, windows: Float32Array, state: Float32Array | None = None) -> Answer:
        """Run windows (B, 6, 200), each from its own state, or from zero if `state` is None."""
        import torch

        tensor = torch.from_numpy(windows)
        with torch.inference_mode():
            if state is not None:
                mean, log_sigma, after = self._network.step(tensor, torch.from_numpy(state))
                return mean.numpy(), log_sigma.numpy(), after.numpy()
            parts = [self._network(part) for part in torch.split(tensor, _BATCH)]
        mean = torch.cat([m for m, _ in parts])
        return mean.numpy(), torch.cat([s for _, s in parts]).numpy(), None


class OnnxEngine:
    """ONNX Runtime on the CPU.

    Args:
        session: an `onnxruntime.InferenceSession` of a graph written by `export_onnx`.
    """

    def __init__(self, session: Any) -> None:
        self._session = session
        shapes = {node.name: node.shape for node in session.get_inputs()}
        self._state_size = int(shapes["state"][2]) if "state" in shapes else 0

    @property
    def is_recurrent(self) -> bool:
        """Whether the network is recurrent: it carries a state from window to window."""
        return self._state_size > 0

    def first_state(self) -> Float32Array:
        """Return the state (2, 1, H) of a recurrent network before the first window."""
        return np.zeros((2, 1, self._state_size), np.float32)

    @property
    def training_form(self) -> DisplacementNetwork:
        """Network with trainable weights, which an exported graph does not contain.

        Raises:
            InputError: always.
        """
        raise InputError("model", "an exported graph", "a safetensors file of weights")

    def run(self, windows: Float32Array, state: Float32Array | None = None) -> Answer:
        """Run windows (B, 6, 200), each from its own state, or from zero if `state` is None."""
        if state is not None:
            mean, log_sigma, after = self._session.run(None, {"windows": windows, "state": state})
            return mean, log_sigma, after
        parts = []
        for begin in range(0, len(windows), _BATCH):
            feed = {"windows": windows[begin : begin + _BATCH]}
            if self.is_recurrent:
                shape = (2, len(feed["windows"]), self._state_size)
                feed["state"] = np.zeros(shape, np.float32)
            parts.append(self._session.run(["displacement", "log_sigma"], feed))
        mean, log_sigma = (np.concatenate(part) for part in zip(*parts, strict=True))
        return mean, log_sigma, None


Engine = TorchEngine | OnnxEngine
