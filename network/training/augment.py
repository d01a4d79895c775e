"""Random windows cut from world-frame streams, and their augmentation for training.

Everything works on whole batches: a training step draws start points, replay speed, yaw, tilt,
biases, noise and mirroring for all windows at once. Sources: yaw, tilt and biases follow TLIO
(Liu et al. 2020); replay and mirroring are exact symmetries of the mechanics, and so is a swing of
the device about a nearby point, added to windows that were recorded without it.

Hands turn a device while its owner walks on. The device then moves with the walk plus
r_W(t) = exp(alpha(t) [n]x) r_0, a lever arm rotated about a fixed axis n; rotating the device about
its own centre leaves its specific force in the world unchanged and adds its rate. All of this is
exact: rate, acceleration and displacement follow from the same angle alpha(t), a sum of sines.
The network learns that rotation carries no information about the path walked.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stario.sequences.errors import ConfigError, InputError
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.settings import check_number
from stario.sequences.windows import HEADING_STEP, WINDOW_RATE, WINDOW_SAMPLES, WorldStream

log = logging.getLogger(__name__)


CPU = torch.device("cpu")

_SINES = 2
"""Number of sines in the angle of a swing."""

_FREQUENCIES = (0.1, 1.0)
"""Range of their frequencies [Hz]: sweeps and shakes of hands."""

_SHARES = ("replayed", "swung", "mirrored", "any_yaw")


@dataclass(frozen=True)
class Augmentation:
    """Extent of the random variation of windows.

    Attributes:
        speeds: range of the replay speed; a window replayed s times as fast has angular rates x s,
            linear accelerations x s^2, and covers s seconds of the recording.
        replayed: share of windows replayed at such a speed; the others keep speed 1.
        swung: share of windows to which a swing of the device is added.
        swing_rate: maximum angular rate of a swing [rad/s].
        lever: maximum distance of the device from the pivot of the swing [m].
        mirrored: share of windows mirrored left to right.
        yaw: standard deviation of the error of the device's heading [rad].
        any_yaw: share of windows rotated by a uniformly random yaw instead.
        tilt: maximum error of the gravity direction [rad], about a random horizontal axis.
        gyro_bias: half-width of the uniform bias [rad/s].
        accel_bias: half-width of the uniform bias [m/s^2].
        gyro_noise: maximum standard deviation of white noise on the 200 Hz samples [rad/s].
        accel_noise: maximum standard deviation of white noise on the 200 Hz samples [m/s^2].
    """

    speeds: tuple[float, float] = (0.6, 1.8)
    replayed: float = 0.4
    swung: float = 0.35
    swing_rate: float = 2.5
    lever: float = 0.35
    mirrored: float = 0.5
    yaw: float = 0.3
    any_yaw: float = 0.3
    tilt: float = 0.05
    gyro_bias: float = 0.03
    accel_bias: float = 0.15
    gyro_noise: float = 0.01
    accel_noise: float = 0.08

    def __post_init__(self) -> None:
        if not _is_range(self.speeds):
            raise ConfigError("speeds", repr(self.speeds), "two factors in (0, 10], slow then fast")
        for item in fields(self)[1:]:
            check_number(self, item.name, 0.0, 1.0 if item.name in _SHARES else 100.0)


def _is_range(speeds: object) -> bool:
    match speeds:
        case (int() | float() as slow, int() | float() as fast):
            return 0.0 < slow <= fast <= 10.0
    return False


UNVARIED = Augmentation((1.0, 1.0), *[0.0] * (len(fields(Augmentation)) - 1))
"""No variation: windows as they were recorded."""


def reach_of(augmentation: Augmentation, successive: int = 1) -> int:
    """Return the minimum number of samples for successive windows at the fastest replay."""
    # Windows that are not replayed keep speed 1.
    return math.ceil(successive * WINDOW_SAMPLES * max(1.0, augmentation.speeds[1])) + 1


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


class Stretches:
    """One array of every stream, from which stretches of one length are gathered.

    On a CPU, streams may be memory-mapped: a batch reads what it is cut from and nothing is kept.
    On a GPU all streams together (50 hours take 1.5 GB) are copied once, and a batch never leaves
    the device: drawing on the CPU would take several times as long as the network.

    Args:
        arrays: (N_i, K) float32, one of each stream.
        device: device of what is gathered.
    """

    def __init__(self, arrays: Sequence[NDArray[np.float32]], device: torch.device) -> None:
        self._arrays, self._whole = list(arrays), torch.empty(0)
        self._is_resident = device.type == "cuda"
        if self._is_resident:
            lengths = [len(array) for array in self._arrays]
            self._first = torch.tensor(np.cumsum([0, *lengths[:-1]]), device=device)
            self._whole = torch.from_numpy(np.concatenate(self._arrays)).to(device)

    def gathered(self, stream: Tensor, start: Tensor, length: int) -> Tensor:
        """Return samples [start, start + length) of the numbered streams, (B, length, K)."""
        if self._is_resident:
            rows = (self._first[stream] + start)[:, None] + torch.arange(
                length, device=start.device
            )
            return self._whole[rows]
        places = zip(stream.tolist(), start.tolist(), strict=True)
        found = [self._arrays[index][first : first + length] for index, first in places]
        return torch.from_numpy(np.stack(found, dtype=np.float32))


class WindowSampler:
    """Sampler of augmented training batches from weighted streams.

    Args:
        streams: streams; those shorter than the windows at the fastest replay are skipped.
        weights: relative frequency of each stream, per second of its length.
        augmentation: extent of the random variation.
        seed: seed of all draws.
        successive: consecutive windows, one second apart, that are drawn and varied as one.
        device: device on which batches are drawn and varied; its draws differ from another's.

    Raises:
        InputError: no stream is long enough.
    """

    def __init__(
        self,
        streams: Sequence[WorldStream],
        weights: Sequence[float],
        augmentation: Augmentation,
        seed: int,
        successive: int = 1,
        device: torch.device = CPU,
    ) -> None:
        self.augmentation = augmentation
        self._successive = successive
        self._reach = reach = reach_of(augmentation, successive)
        pairs = [(s, w) for s, w in zip(streams, weights, strict=True) if len(s) >= reach]
        if not pairs:
            expected = "one long enough for the windows at the fastest replay"
            raise InputError("streams", f"none with {reach} samples at 200 Hz", expected)
        if len(pairs) < len(streams):
            log.warning(
                "skipping %d of %d stretches, shorter than the %.1f s that windows span",
                len(streams) - len(pairs), len(streams), reach / WINDOW_RATE,
            )  # fmt: skip
        kept = [weight for _, weight in pairs]
        self._starts = torch.tensor([len(s) - reach + 1 for s, _ in pairs], device=device)
        share = self._starts.double() * torch.tensor(kept, dtype=torch.float64, device=device)
        self._cumulative = (share / share.sum()).cumsum(0)
        self._imu_W = Stretches([s.imu_W for s, _ in pairs], device)
        self._position_W = Stretches([s.position_W for s, _ in pairs], device)
        self._facing_W = Stretches([s.facing_W for s, _ in pairs], device)
        self.generator = torch.Generator(device).manual_seed(seed)

    def batch(self, size: int) -> tuple[Tensor, Tensor]:
        """Draw augmented windows (size, 6, 200) and displacements (size, 3) [m].

        K > 1 successive windows have shapes (size, K, 6, 200) and (size, K, 3).
        """
        drawn, device = self.generator, self.generator.device
        share = torch.rand(size, generator=drawn, dtype=torch.float64, device=device)
        stream = torch.searchsorted(self._cumulative, share).clamp(max=len(self._starts) - 1)
        # Whole samples: at speed 1, interpolation would smooth data that is not smoothed otherwise.
        offset = (uniform(drawn, size).double() * self._starts[stream]).floor()
        low, high = self.augmentation.speeds
        speed = low + (high - low) * uniform(drawn, size)
        speed = torch.where(uniform(drawn, size) < self.augmentation.replayed, speed, 1.0)
        count = self._successive * WINDOW_SAMPLES + 1
        steps = torch.arange(count, dtype=torch.float64, device=device)
        at = offset.double()[:, None] + steps * speed[:, None].double()
        imu_W, position_W, facing_W = (
            part.gathered(stream, offset.long(), self._reach)
            for part in (self._imu_W, self._position_W, self._facing_W)
        )
        imu = _replayed(_lerp(imu_W, offset, at[:, :-1]), speed)
        ends = _lerp(position_W, offset, at[:, ::WINDOW_SAMPLES])
        facing = _lerp(facing_W, offset, at[:, :-1:HEADING_STEP])
        imu, displacement = self._vary(imu, ends.diff(dim=1), facing)
        if self._successive == 1:
            return imu.transpose(1, 2).contiguous(), displacement.squeeze(1)
        windows = imu.view(size, self._successive, WINDOW_SAMPLES, 6)
        return windows.transpose(2, 3).contiguous(), displacement

    def _vary(self, imu: Tensor, displacement: Tensor, facing: Tensor) -> tuple[Tensor, Tensor]:
        """Add swings in W, then apply `augmented`, which rotates each second into its frame H.

        Args:
            imu: (B, 200 K, 6) gyroscope and specific force in W.
            displacement: (B, K, 3) in W [m].
            facing: (B, 10 K, 2) direction in which the device faces in W.
        """
        a, size, seconds = self.augmentation, len(imu), self._successive
        swings = sample_swing(size, a.swung, a.swing_rate, a.lever, self.generator)
        imu, displacement = apply_swing(imu, displacement, swings)
        heading = heading_of(facing.view(size, seconds, -1, 2), swings)
        imu = imu.reshape(size * seconds, WINDOW_SAMPLES, 6)
        imu, R_WH = augmented(imu, heading.flatten(), a, self.generator, seconds)
        displacement = displacement.reshape(-1, 1, 3) @ R_WH
        return imu.view(size, -1, 6), displacement.view(size, seconds, 3)


def _replayed(imu: Tensor, speed: Tensor) -> Tensor:
    """Scale rates by s and linear accelerations by s^2; gravity is unchanged."""
    s = speed[:, None, None]
    gravity = imu.new_tensor([0.0, 0.0, STANDARD_GRAVITY])
    accel = (imu[..., 3:] - gravity) * s**2 + gravity
    return torch.cat([imu[..., :3] * s, accel], dim=2)


def augmented(
    imu: Tensor,
    heading: Tensor,
    augmentation: Augmentation,
    generator: torch.Generator,
    together: int,
) -> tuple[Tensor, Tensor]:
    """Rotate windows (B, 200, 6) from W into frame H, as an imperfect device would measure them.

    They are rotated by minus the heading (B,) plus an error; mirrored left to right, which in H is
    the same person with the device in the other hand; tilted, biased and made noisy.

    Args:
        imu: windows in W.
        heading: heading of the device in W, averaged over the window [rad].
        augmentation: extent of the random variation.
        generator: generator of all draws.
        together: consecutive windows that share mirroring, tilt, biases and noise level.

    Returns:
        Windows (B, 200, 6) as presented to the network, and R_WH (B, 3, 3), which maps vectors such
        as its displacements to W and undoes the mirroring.
    """
    a, groups, device = augmentation, len(imu) // together, generator.device

    def symmetric(*shape: int) -> Tensor:
        return 2.0 * uniform(generator, *shape) - 1.0

    def of_each(values: Tensor) -> Tensor:
        return values.repeat_interleave(together, dim=0)

    # Drawn for every window: the yaw fit of a stretch of weak truth removes a common error.
    error = a.yaw * torch.randn(len(imu), generator=generator, device=device)
    anywhere = uniform(generator, len(imu)) < a.any_yaw
    R_HW = _about_z(torch.where(anywhere, symmetric(len(imu)) * torch.pi, error) - heading)
    sign = torch.where(uniform(generator, groups) < a.mirrored, -1.0, 1.0)
    one = torch.ones_like(sign)
    mirror = of_each(torch.stack([one, sign, sign, sign, one, one], dim=1))
    R_tilt = of_each(_small_tilt(symmetric(groups, 2) * a.tilt / 2**0.5))
    turned = (imu.view(len(imu), -1, 2, 3) @ R_HW.mT.unsqueeze(1)).reshape(imu.shape)
    tilted = (turned * mirror.unsqueeze(1)).view(len(imu), -1, 2, 3) @ R_tilt.mT.unsqueeze(1)
    limits = imu.new_tensor([a.gyro_bias] * 3 + [a.accel_bias] * 3)
    deviations = imu.new_tensor([a.gyro_noise] * 3 + [a.accel_noise] * 3)
    imu = tilted.reshape(imu.shape) + of_each(symmetric(groups, 6) * limits).unsqueeze(1)
    white = torch.randn(imu.shape, generator=generator, device=device)
    imu = imu + white * of_each(uniform(generator, groups)[:, None, None] ** 2 * deviations)
    return imu, R_HW.mT * mirror[:, None, 3:]


def heading_of(facing: Tensor, swings: Swing | None = None) -> Tensor:
    """Return headings (B, K) [rad] from facing directions (B, K, 10, 2), with swings added."""
    size, seconds, instants, _ = facing.shape
    angle = torch.atan2(facing[..., 1], facing[..., 0])
    if swings is not None:
        time = torch.arange(seconds * instants, device=facing.device) * (HEADING_STEP / WINDOW_RATE)
        turn = swings.angle(time)[0] * swings.axis[:, 2:]
        angle = angle + turn.view(size, seconds, instants)
    length = facing.norm(dim=-1)
    return torch.atan2((length * angle.sin()).sum(-1), (length * angle.cos()).sum(-1))


def _about_z(yaw: Tensor) -> Tensor:
    cos, sin, zero, one = yaw.cos(), yaw.sin(), torch.zeros_like(yaw), torch.ones_like(yaw)
    rows = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, one], dim=1)
    return rows.view(-1, 3, 3)


def _small_tilt(angles: Tensor) -> Tensor:
    """Return the rotations by horizontal rotation vectors (B, 2) [rad], by Rodrigues' formula."""
    zero = torch.zeros_like(angles[:, 0])
    x, y = angles[:, 0], angles[:, 1]
    skew = torch.stack([zero, zero, y, zero, zero, -x, -y, x, zero], dim=1).view(-1, 3, 3)
    half = torch.sinc(angles.norm(dim=1) / (2.0 * torch.pi))[:, None, None]
    sine = torch.sinc(angles.norm(dim=1) / torch.pi)[:, None, None]
    return torch.eye(3, device=angles.device) + sine * skew + 0.5 * half**2 * skew @ skew


def _lerp(pieces: Tensor, start: Tensor, at: Tensor) -> Tensor:
    """Interpolate pieces (B, reach, K), which begin at `start` (B,), at indices `at` (B, M).

    Returns:
        (B, M, K).
    """
    size, reach, _ = pieces.shape
    last = start.long()[:, None] + reach - 2
    left = at.floor().long().minimum(last)
    weight = (at - left).float().unsqueeze(-1)
    row = torch.arange(size, device=at.device)[:, None]
    local = left - start.long()[:, None] + reach * row
    rows = pieces.view(size * reach, -1)
    here, there = (rows.index_select(0, k.flatten()).view(*k.shape, -1) for k in (local, local + 1))
    return here * (1.0 - weight) + there * weight
