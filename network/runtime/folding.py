"""Folding of trained batch norms into the convolutions before them."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from stario.network.baselines.parts import ConvNorm


def affine(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Return the scale and offset (C,) of a trained batch norm, in double precision."""
    assert norm.running_var is not None
    assert norm.running_mean is not None
    variance, mean = norm.running_var.double(), norm.running_mean.double()
    scale = norm.weight.detach().double() / torch.sqrt(variance + norm.eps)
    return scale, norm.bias.detach().double() - scale * mean


def folded(network: nn.Module) -> nn.Module:
    """Return a copy in evaluation mode with every `ConvNorm` as one convolution with bias."""
    network = copy.deepcopy(network).eval().requires_grad_(False)
    for parent in list(network.modules()):
        for name, child in parent.named_children():
            if isinstance(child, ConvNorm):
                setattr(parent, name, _merged(child))
    return network


def _merged(pair: ConvNorm) -> nn.Conv1d:
    convolution, norm = pair
    assert isinstance(convolution, nn.Conv1d)
    assert isinstance(norm, nn.BatchNorm1d)
    scale, offset = affine(norm)
    merged = nn.Conv1d(
        convolution.in_channels,
        convolution.out_channels,
        convolution.kernel_size[0],
        convolution.stride[0],
        int(convolution.padding[0]),
        groups=convolution.groups,
    )
    with torch.no_grad():
        merged.weight.copy_(convolution.weight.double() * scale[:, None, None])
        assert merged.bias is not None
        merged.bias.copy_(offset)
    return merged.requires_grad_(False)
