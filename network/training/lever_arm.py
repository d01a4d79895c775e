"""Swings of a device about a nearby point, added to windows that were recorded without them.

Hands turn a device while its owner walks on. The device then moves with the walk plus
r_W(t) = exp(alpha(t) [n]x) r_0, a lever arm rotated about a fixed axis n; rotating the device about
its own centre leaves its specific force in the world unchanged and adds its rate. All of this is
exact: rate, acceleration and displacement follow from the same angle alpha(t), a sum of sines.
The network learns that rotation carries no information about the path walked.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from stario.sequences.windows import WINDOW_RATE, WINDOW_SAMPLES

_SINES = 2
"""Number of sines in the angle of a swing."""

_FREQUENCIES = (0.1, 1.0)
"""Range of their frequencies [Hz]: sweeps and shakes of hands."""


@dataclass(frozen=True, eq=False)
class Swing:
    """One swing for each of B windows; its angle is a sum of K sines.

    Attributes:
        axis: (B, 3) unit vectors in W.
        lever: (B, 3) from the pivot to the device at angle zero [m].
        amplitude: (B, K) [rad].
        frequency: (B, K) [rad/s].
        phase: (B, K) [rad].
    """

    axis: Tensor
    lever: Tensor
    amplitude: Tensor
    frequency: Tensor
    phase: Tensor

    def angle(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the angle about the axis and two derivatives (B, T) [rad] at times (T,) [s]."""
        argument = self.frequency[..., None] * time + self.phase[..., None]
        a, w = self.amplitude[..., None], self.frequency[..., None]
        sine = a * argument.sin()
        return sine.sum(-2), (a * w * argument.cos()).sum(-2), -(w**2 * sine).sum(-2)


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    """Draw numbers from 0 to 1 on the generator's device."""
    return torch.rand(*shape, generator=generator, device=generator.device)


def sample_swing(
    size: int, share: float, rate: float, lever: float, generator: torch.Generator
) -> Swing:
    """Draw swings about axes near the vertical, like those of arms and hips.

    Args:
        size: batch size B.
        share: share of windows that receive a swing.
        rate: maximum angular rate [rad/s].
        lever: maximum lever arm [m].
        generator: generator of the draws.
    """
    device = generator.device
    spread = torch.randn(size, 3, generator=generator, device=device)
    spread = spread * spread.new_tensor([0.5, 0.5, 0.0])
    axis = torch.nn.functional.normalize(spread + spread.new_tensor([0.0, 0.0, 1.0]), dim=1)
    arm = torch.randn(size, 3, generator=generator, device=device)
    arm = torch.nn.functional.normalize(arm, dim=1)
    swings = (uniform(generator, size) < share).float()
    low, high = (2.0 * math.pi * f for f in _FREQUENCIES)
    frequency = low + (high - low) * uniform(generator, size, _SINES)
    amplitude = swings[:, None] * rate / _SINES * uniform(generator, size, _SINES) / frequency
    phase = 2.0 * math.pi * uniform(generator, size, _SINES)
    lever_W = arm * (swings * lever * uniform(generator, size))[:, None]
    return Swing(axis, lever_W, amplitude, frequency, phase)


def apply_swing(imu: Tensor, displacement: Tensor, swing: Swing) -> tuple[Tensor, Tensor]:
    """Add a swing to the IMU (B, 200 K, 6) in W and to displacements (B, K, 3) [m]."""
    length = imu.shape[1]
    time = torch.arange(length + 1, device=imu.device) / WINDOW_RATE
    angle, rate, growth = (values[..., None] for values in swing.angle(time))

    axis = swing.axis[:, None, :].expand(-1, length + 1, -1)
    lever = _turned(swing.lever[:, None, :].expand_as(axis), axis, angle)
    tangent = torch.linalg.cross(axis, lever)
    acceleration = growth * tangent + rate**2 * torch.linalg.cross(axis, tangent)

    inside = slice(0, length)
    gyro = _turned(imu[..., :3], axis[:, inside], angle[:, inside]) + (rate * axis)[:, inside]
    accel = imu[..., 3:] + acceleration[:, inside]
    return torch.cat([gyro, accel], dim=2), displacement + lever[:, ::WINDOW_SAMPLES].diff(dim=1)


def _turned(vectors: Tensor, axis: Tensor, angle: Tensor) -> Tensor:
    """Rotate vectors (B, T, 3) about unit axes by angles (B, T, 1), by Rodrigues' formula."""
    along = axis * (axis * vectors).sum(2, keepdim=True)
    across = torch.linalg.cross(axis, vectors)
    turned: Tensor = along + angle.cos() * (vectors - along) + angle.sin() * across
    return turned
