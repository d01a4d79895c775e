"""PyTorch: networks in training, and weights for which there is no ONNX graph."""

from __future__ import annotations

import copy
from typing import Any

import torch
from torch.nn.utils.fusion import fuse_conv_bn_eval

from stario.network.baselines.parts import ConvNorm
from stario.network.displacement import DisplacementNetwork
from stario.network.runtime.engines import Answer, Engine, Float32Array


class TorchEngine(Engine):
    """PyTorch on the CPU; batch norms are folded into the convolutions before them.

    Args:
        network: network with its weights; it is left in evaluation mode. Later changes of the
            weights do not affect the engine.
    """

    def __init__(self, network: DisplacementNetwork) -> None:
        self._trainable, self._network = network.eval(), _folded(network)
        self.state_size = network.state_size

    @property
    def training_form(self) -> DisplacementNetwork:
        """The network itself."""
        return self._trainable

    def _run(self, windows: Float32Array, state: Float32Array) -> Answer:
        given = (windows, state) if self.state_size else (windows,)
        with torch.inference_mode():
            mean, log_sigma, *after = self._network(*map(torch.from_numpy, given))
        return mean.numpy(), log_sigma.numpy(), after[0].numpy() if after else state


def _folded(network: DisplacementNetwork) -> DisplacementNetwork:
    """Return a copy with every `ConvNorm` as one convolution with bias; outputs agree to 1e-5."""
    network = copy.deepcopy(network).requires_grad_(False)
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if isinstance(child, ConvNorm):
                pair: Any = child.double()
                setattr(parent, name, fuse_conv_bn_eval(pair[0], pair[1]).float())
    return network
