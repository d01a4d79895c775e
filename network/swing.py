"""A device swung about a point beside it, added to windows that were recorded otherwise.

Hands turn a device while its owner walks on. The device's point moves with the walk plus
r_W(t) = exp(alpha(t) [n]x) r_0, a lever arm turned about a fixed axis n; rotating the device about
its own point leaves its specific force in the world untouched and adds its rate. All of it is
exact: rate, acceleration and displacement follow from the same angle alpha(t), a sum of sines.
It teaches that turning says nothing of the way that was walked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from stario.sequences.windows import WINDOW_RATE, WINDOW_SAMPLES

_SINES = 2
"""Sines in the angle of a swing."""

_FREQUENCIES = (0.1, 1.0)
"""Of those sines [Hz]: sweeps and shakes of hands."""


@dataclass(frozen=True, eq=False)
class Swing:
    """One swing for each of B windows.

    Attributes:
        axis: (B, 3) unit vectors in W.
        lever: (B, 3) from the point that walks to the device at angle zero [m].
        amplitude: (B, K) of each sine [rad].
        frequency: (B, K) angular frequency of each sine [rad/s].
        phase: (B, K) [rad].
    """

    axis: Tensor
    lever: Tensor
    amplitude: Tensor
    frequency: Tensor
    phase: Tensor


def draw_swing(
    size: int, share: float, rate: float, lever: float, generator: torch.Generator
) -> Swing:
    """Random swings about axes near the vertical, as arms and hips make them.

    Args:
        size: of the batch B.
        share: of windows that are swung at all.
        rate: largest angular rate [rad/s].
        lever: longest lever arm [m].
        generator: of the draws.
    """

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    axis = torch.randn(size, 3, generator=generator) * torch.tensor([0.5, 0.5, 0.0])
    axis = torch.nn.functional.normalize(axis + torch.tensor([0.0, 0.0, 1.0]), dim=1)
    arm = torch.nn.functional.normalize(torch.randn(size, 3, generator=generator), dim=1)
    arm = arm * lever * uniform(size, 1)
    low, high = (2.0 * math.pi * f for f in _FREQUENCIES)
    frequency = low + (high - low) * uniform(size, _SINES)
    rates = rate / _SINES * uniform(size, _SINES)
    swings = (uniform(size, 1) < share).float()
    phase = 2.0 * math.pi * uniform(size, _SINES)
    return Swing(axis, arm * swings, swings * rates / frequency, frequency, phase)


def swung(imu: Tensor, displacement: Tensor, swing: Swing) -> tuple[Tensor, Tensor]:
    """Windows (B, 200, 6) in W and displacements (B, 3) [m] with the swing added."""
    time = torch.arange(WINDOW_SAMPLES + 1) / WINDOW_RATE
    argument = swing.frequency[..., None] * time + swing.phase[..., None]
    amplitude, frequency = swing.amplitude[..., None], swing.frequency[..., None]
    angle = (amplitude * argument.sin()).sum(1)[..., None]
    rate = (amplitude * frequency * argument.cos()).sum(1)[..., None]
    growth = -(amplitude * frequency**2 * argument.sin()).sum(1)[..., None]

    axis = swing.axis[:, None, :].expand(-1, WINDOW_SAMPLES + 1, -1)
    lever = _turned(swing.lever[:, None, :].expand_as(axis), axis, angle)
    tangent = torch.linalg.cross(axis, lever)
    acceleration = growth * tangent + rate**2 * torch.linalg.cross(axis, tangent)

    inside = slice(0, WINDOW_SAMPLES)
    gyro = _turned(imu[..., :3], axis[:, inside], angle[:, inside]) + (rate * axis)[:, inside]
    accel = imu[..., 3:] + acceleration[:, inside]
    return torch.cat([gyro, accel], dim=2), displacement + lever[:, -1] - lever[:, 0]


def _turned(vectors: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
    """Rodrigues' rotation of vectors (B, T, 3) about unit axes by angles (B, T, 1)."""
    along = axis * (axis * vectors).sum(2, keepdim=True)
    across = torch.linalg.cross(axis, vectors)
    turned: Tensor = along + angle.cos() * (vectors - along) + angle.sin() * across
    return turned
