"""PyTorch: networks in training, and weights for which there is no ONNX graph."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.nn.utils.fusion import fuse_conv_bn_eval

from stario.network.architectures import build_network
from stario.network.baselines.parts import ConvNorm
from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.engines import BATCH, Answer, Float32Array


class TorchEngine:
    """PyTorch on the CPU; batch norms are folded into the convolutions before them.

    Args:
        network: network with its weights; it is left in evaluation mode. Later changes of the
            weights do not affect the engine.

    Attributes:
        training_form: that network, whose weights are trainable.
    """

    def __init__(self, network: DisplacementNetwork) -> None:
        self.training_form = network.eval()
        self._network = _folded(network)

    @property
    def is_recurrent(self) -> bool:
        """Whether the network is recurrent: it carries a state from window to window."""
        return self._network.is_recurrent

    def first_state(self) -> Float32Array:
        """Return the state (2, 1, H) of a recurrent network before the first window."""
        return self._network.first_state(1).numpy()

    def run(self, windows: Float32Array, state: Float32Array | None = None) -> Answer:
        """Run windows (B, 6, 200), each from its own state, or from zero if `state` is None."""
        tensor = torch.from_numpy(windows)
        with torch.inference_mode():
            if state is not None:
                mean, log_sigma, after = self._network.step(tensor, torch.from_numpy(state))
                return mean.numpy(), log_sigma.numpy(), after.numpy()
            parts = [self._network(part) for part in torch.split(tensor, BATCH)]
        mean = torch.cat([m for m, _ in parts])
        return mean.numpy(), torch.cat([s for _, s in parts]).numpy(), None


def trainable(architecture: str, state: Mapping[str, Tensor]) -> DisplacementNetwork:
    """Build a network with its weights, in evaluation mode.

    Raises:
        RuntimeError: the tensors are not those of the architecture.
    """
    network = DisplacementNetwork(build_network(architecture))
    network.network.load_state_dict(state)
    return network.eval()


def _folded(network: DisplacementNetwork) -> DisplacementNetwork:
    """Return a copy with every `ConvNorm` as one convolution with bias; outputs agree to 1e-5."""
    network = copy.deepcopy(network).requires_grad_(False)
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if isinstance(child, ConvNorm):
                pair: Any = child.double()
                setattr(parent, name, fuse_conv_bn_eval(pair[0], pair[1]).float())
    return network
