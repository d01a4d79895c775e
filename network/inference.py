"""The inference form of a network: the same numbers, several times faster on a CPU.

StarIO's form keeps activations as rows of channels, (B, L, C). What makes it fast, each step exact
up to rounding:

- Trained batch norms are affine and go into the convolution next to them. Where a norm comes
  before zero padding, the padded taps miss its offset, so that a depthwise convolution gets a bias
  per position and channel.
- 1x1 convolutions, and strided ones whose taps do not overlap, are matrix products of rows. The
  two branches of the star operation are one product.
- The root mean square of a window is one number: what follows is linear in it, so it scales
  pooled vectors and weights instead of the large tensors.
- Both wings lie side by side in one vector; taps per position keep their convolutions apart.

Shapes below: B windows, L time steps, C channels.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from stario.network.stario import EPSILON, Block, DualWingStarBlock, GatedUnit, StarIO, Wing
from stario.sequences.windows import WINDOW_SAMPLES

if TYPE_CHECKING:
    from stario.network.model import DisplacementNetwork


def inference_form(network: DisplacementNetwork) -> nn.Module:
    """A network in evaluation mode in the form that runs fastest.

    StarIO comes back as a copy whose outputs agree to 1e-5; weights that change later do not reach
    it. Other architectures come back as they are.

    Args:
        network: (B, 6, 200) to displacement (B, 3) [m] and log sigma (B, 3).
    """
    network.eval()
    if not isinstance(network.network, StarIO):
        return network
    # The same centring and clamping around the faster network.
    return type(network)(_FastStarIO(network.network)).eval()


class _FastStarIO(nn.Module):
    """StarIO on rows of channels."""

    def __init__(self, network: StarIO) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        length = WINDOW_SAMPLES
        trunk: list[nn.Module] = list(network.trunk.children())
        for layer, following in zip(trunk, [*trunk[1:], None], strict=True):
            if isinstance(layer, nn.Conv1d) and isinstance(following, nn.BatchNorm1d):
                layers.append(_Strided(layer, following))
                length = (length + 2 * int(layer.padding[0]) - 3) // layer.stride[0] + 1
            elif isinstance(layer, Block):
                layers.append(_FastStar(layer.star, length))
                if layer.gated is not None:
                    layers.append(_FastGate(layer.gated, length))
        self.trunk = nn.Sequential(*layers)
        linear = [layer for layer in network.head if isinstance(layer, nn.Linear)]
        # The head reads the channels of a time step together, not the time steps of a channel.
        weights = [layer.weight for layer in linear]
        weights[0] = weights[0].view(len(weights[0]), -1, length).transpose(1, 2).flatten(1)
        self.head = nn.ModuleList(map(_Rows, weights, [layer.bias for layer in linear]))

    def forward(self, windows: Tensor) -> Tensor:
        """(B, 6, 200) to (B, outputs)."""
        x = self.trunk(windows.transpose(1, 2)).flatten(1)
        for layer in self.head[:-1]:
            x = layer(x).relu_()
        output: Tensor = self.head[-1](x)
        return output


class _Folded(nn.Module):
    """Holds folded weights as buffers of its own."""

    def hold(self, **tensors: Tensor) -> None:
        for name, value in tensors.items():
            own = value.detach().float().clone(memory_format=torch.contiguous_format)
            self.register_buffer(name, own, persistent=False)


class _Rows(_Folded):
    """Product of rows (N, C) with a weight (D, C), plus a bias (D,)."""

    weight: Tensor
    bias: Tensor

    def __init__(self, weight: Tensor, bias: Tensor) -> None:
        super().__init__()
        self.hold(weight=weight.T, bias=bias)

    def forward(self, rows: Tensor) -> Tensor:
        return torch.addmm(self.bias, rows, self.weight)

    def onto(self, x: Tensor, rows: Tensor) -> Tensor:
        """Add the product to x (B, L, D) in place."""
        x.add_(self.bias).flatten(0, 1).addmm_(rows, self.weight)
        return x


class _Strided(nn.Module):
    """Convolution of width 3 with stride, and the norm after it, on (B, L, C)."""

    def __init__(self, convolution: nn.Conv1d, norm: nn.BatchNorm1d) -> None:
        super().__init__()
        self.stride, self.padding = convolution.stride[0], int(convolution.padding[0])
        scale, offset = _affine(norm)
        weight = convolution.weight.double() * scale[:, None, None]
        self.rows = _Rows(weight.transpose(1, 2).flatten(1), offset)

    def forward(self, x: Tensor) -> Tensor:
        if self.padding:
            x = nn.functional.pad(x, (0, 0, self.padding, self.padding))
        taps = x.unfold(1, 3, self.stride).transpose(2, 3)
        batch, length = taps.shape[:2]
        result: Tensor = self.rows(taps.reshape(batch * length, -1))
        return result.view(batch, length, -1)


class _Depthwise(_Folded):
    """Depthwise convolution of width 3, zero-padded, with norms before and after it folded in.

    Args:
        convolution: of the channels.
        before: scale and offset (C,) of its input.
        after: scale and offset (C,) of its output.
        length: L of its input.
    """

    previous: Tensor
    present: Tensor
    following: Tensor
    bias: Tensor

    def __init__(
        self,
        convolution: nn.Conv1d,
        before: tuple[Tensor, Tensor] | None,
        after: tuple[Tensor, Tensor] | None,
        length: int,
    ) -> None:
        super().__init__()
        taps = convolution.weight.double().squeeze(1).T  # (3, C)
        bias = torch.zeros(length, taps.shape[1], dtype=torch.float64)
        if convolution.bias is not None:
            bias = bias + convolution.bias
        if before is not None:
            scale, offset = before
            reach = torch.ones(3, length, 1)
            reach[0, 0] = reach[2, -1] = 0.0  # the padding is zero, it has no offset
            bias = bias + (reach * (taps * offset)[:, None]).sum(0)
            taps = taps * scale
        if after is not None:
            taps, bias = taps * after[0], bias * after[0] + after[1]
        self.hold(previous=taps[0], present=taps[1], following=taps[2], bias=bias)

    def forward(self, x: Tensor) -> Tensor:
        y = torch.addcmul(self.bias, x, self.present)
        return _add_neighbours(y, x, self.previous, self.following)


class _FastStar(nn.Module):
    """DWSB and its shortcut; changes its input in place."""

    def __init__(self, block: DualWingStarBlock, length: int) -> None:
        super().__init__()
        self.depthwise = _Depthwise(block.depthwise, None, _affine(block.norm), length)
        branches = block.branch_gate, block.branch_value
        weight = torch.cat([branch.weight.squeeze(2) for branch in branches])
        self.branches = _Rows(weight, torch.cat([_bias(branch) for branch in branches]))
        self.inner = block.branch_gate.out_channels
        self.wings = _Wings(block.channel_wing, self.inner, block.time_wing, length)
        factor = self.wings.factor
        self.project = _Rows(block.project.weight.squeeze(2) * factor, _bias(block.project))

    def forward(self, x: Tensor) -> Tensor:
        batch, length, _ = x.shape
        gate, value = self.branches(self.depthwise(x).flatten(0, 1)).split(self.inner, dim=1)
        # The star and its square lie one after the other, so that they are pooled together.
        powers = x.new_empty(2, batch, length, self.inner)
        star, square = powers.unbind()
        torch.mul(gate.clamp_(0.0, 6.0), value, out=star.flatten(0, 1))
        torch.mul(star, star, out=square)
        channel, time = self.wings(torch.cat([powers.sum(2), powers.sum(3)], dim=2))
        torch.add(channel.unsqueeze(1), time.unsqueeze(2), out=square)
        return self.project.onto(x, star.mul_(square).flatten(0, 1))


class _Wings(_Folded):
    """Weights of both wings from the pooled star operation, before its normalisation.

    With q the mean square, r = 1 / sqrt(q + eps), and mean m and variance v before normalising,
    the normalised star has mean r m and deviation sqrt(r^2 v + eps) = r sqrt(v + eps (q + eps)).
    The convolution is linear in r too, and the weights take up the r of the star they multiply.
    L q is a sum over the time wing: the `factor` sqrt(L) that r lacks is left to fixed weights.

    Vectors hold C positions of the channel wing, then L of the time wing.
    """

    share: Tensor
    mu: Tensor
    xi: Tensor
    previous: Tensor
    present: Tensor
    following: Tensor

    def __init__(self, channel: Wing, channels: int, time: Wing, length: int) -> None:
        super().__init__()
        self.length = length
        self.factor = length**0.5

        def side_by_side(of_channel: Tensor, of_time: Tensor) -> Tensor:
            return torch.cat([of_channel.expand(channels), of_time.expand(length)])

        taps = [
            side_by_side(a, b) * self.factor
            for a, b in zip(
                channel.convolution.weight.view(3), time.convolution.weight.view(3), strict=True
            )
        ]
        seam = torch.ones(channels + length - 1)
        seam[channels - 1] = 0.0  # neither wing sees the other
        self.hold(
            share=side_by_side(torch.tensor(1.0 / length), torch.tensor(1.0 / channels)),
            mu=side_by_side(channel.mu, time.mu),
            xi=side_by_side(channel.xi, time.xi),
            previous=taps[0][1:] * seam,
            present=taps[1],
            following=taps[2][:-1] * seam,
        )

    def forward(self, sums: Tensor) -> tuple[Tensor, Tensor]:
        """Sums (2, B, C + L) of star and square to weights x r / factor, (B, C) and (B, L)."""
        mean, square = (sums * self.share).unbind()
        length = self.length
        energy = square[:, -length:].sum(1, keepdim=True).add_(length * EPSILON)
        variance = torch.addcmul(square, mean, mean, value=-1.0).clamp_min_(0.0)
        deviation = variance.add_(energy, alpha=EPSILON / length).sqrt_()
        pooled = (mean * self.mu).addcmul_(deviation, self.xi)
        weights = _add_neighbours(pooled * self.present, pooled, self.previous, self.following)
        r = energy.rsqrt_()
        weights.mul_(r).sigmoid_().mul_(r)
        return weights[:, :-length], weights[:, -length:]


class _FastGate(_Folded):
    """MSGCU and its shortcut; changes its input in place."""

    excite: Tensor

    def __init__(self, unit: GatedUnit, length: int) -> None:
        super().__init__()
        scale, offset = _affine(unit.norm)
        self.value = _Depthwise(unit.value, (scale, offset), None, length)
        # Sums stand for means here too: the counts go into the weights and the epsilon.
        squeeze = unit.squeeze.weight.double()
        self.squeeze = _Rows(squeeze * scale / length, squeeze @ offset)
        self.hold(excite=unit.excite.weight.T)
        size = length * unit.value.out_channels
        self.epsilon = size * EPSILON
        self.project = _Rows(unit.project.weight.squeeze(2) * size**0.5, _bias(unit.project))

    def forward(self, x: Tensor) -> Tensor:
        gate = torch.mm(self.squeeze(x.sum(1)).relu_(), self.excite).softmax(1)
        value = self.value(x)
        # The gate is the same at all times, so the energy needs only the value's own per channel.
        energy = (value * value).sum(1).mul_(gate).mul_(gate).sum(1, keepdim=True)
        scale = gate.mul_(energy.add_(self.epsilon).rsqrt_())
        return self.project.onto(x, value.mul_(scale.unsqueeze(1)).flatten(0, 1))


def _add_neighbours(y: Tensor, x: Tensor, previous: Tensor, following: Tensor) -> Tensor:
    """Add to y (B, N, ...) the two outer taps of a convolution of width 3 along N of x."""
    y[:, 1:].addcmul_(x[:, :-1], previous)
    y[:, :-1].addcmul_(x[:, 1:], following)
    return y


def _affine(norm: nn.BatchNorm1d) -> tuple[Tensor, Tensor]:
    """Scale and offset (C,) of a trained batch norm, in double precision."""
    assert norm.running_var is not None
    assert norm.running_mean is not None
    scale = norm.weight.double() / torch.sqrt(norm.running_var.double() + norm.eps)
    return scale, norm.bias.double() - scale * norm.running_mean.double()


def _bias(convolution: nn.Conv1d) -> Tensor:
    assert convolution.bias is not None
    return convolution.bias
