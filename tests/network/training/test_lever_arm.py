"""Angular rate, acceleration and displacement of a swing are those of one motion."""

import pytest
import torch

from stario.network.training.augment import Swing, apply_swing, sample_swing

GRAVITY = 9.80665


def at_rest(size: int) -> torch.Tensor:
    imu = torch.zeros(size, 200, 6, dtype=torch.float64)
    imu[..., 5] = GRAVITY
    return imu


def draw_swing(size: int, share: float = 1.0) -> Swing:
    swing = sample_swing(size, share, 2.5, 0.35, torch.Generator().manual_seed(3))
    return Swing(*(value.double() for value in vars(swing).values()))


def test_acceleration_integrates_to_the_displacement():
    swing = draw_swing(64)
    imu, displacement = apply_swing(at_rest(64), torch.zeros(64, 1, 3, dtype=torch.float64), swing)
    # The initial velocity of a window is omega x r.
    now = torch.zeros(1, dtype=torch.float64)
    lever = rotated(swing.lever, swing.axis, swing.angle(now)[0][:, 0])
    velocity = torch.linalg.cross(imu[:, 0, :3], lever)
    accel = imu[..., 3:] - torch.tensor([0.0, 0.0, GRAVITY])
    dt, moved = 1.0 / 200.0, torch.zeros(64, 3, dtype=torch.float64)
    for k in range(200):
        velocity_next = velocity + 0.5 * dt * (accel[:, k] + accel[:, min(k + 1, 199)])
        moved = moved + 0.5 * dt * (velocity + velocity_next)
        velocity = velocity_next
    assert displacement.abs().max() > 0.1
    assert (moved - displacement[:, 0]).abs().max() < 2e-3


def test_rate_and_acceleration_belong_to_one_rotation():
    """Centripetal and tangential parts: accel . r = -|omega x r|^2 for a rigid arm."""
    swing = draw_swing(64)
    imu, _ = apply_swing(at_rest(64), torch.zeros(64, 1, 3, dtype=torch.float64), swing)
    alpha = swing.angle(torch.zeros(1, dtype=torch.float64))[0][:, 0]
    lever = rotated(swing.lever, swing.axis, alpha)
    gyro, accel = imu[:, 0, :3], imu[:, 0, 3:] - torch.tensor([0.0, 0.0, GRAVITY])
    velocity = torch.linalg.cross(gyro, lever)
    assert torch.allclose((accel * lever).sum(1), -(velocity**2).sum(1), atol=1e-5)


def test_a_swing_turns_the_rates_that_were_recorded():
    """Rate of the device in the world: its own, turned with it, and that of the swing."""
    swing, imu = draw_swing(8), at_rest(8)
    imu[..., :3] = torch.tensor([0.3, -0.2, 0.5])
    alone, _ = apply_swing(at_rest(8), torch.zeros(8, 1, 3, dtype=torch.float64), swing)
    both, _ = apply_swing(imu, torch.zeros(8, 1, 3, dtype=torch.float64), swing)
    angle = swing.angle(torch.arange(200, dtype=torch.float64) / 200.0)[0]
    for k in (0, 70, 199):
        turned = rotated(imu[:, k, :3], swing.axis, angle[:, k])
        assert torch.allclose(both[:, k, :3] - alone[:, k, :3], turned, atol=1e-5)


def test_no_swing_is_faster_than_its_bound():
    swing = draw_swing(512)
    time = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    assert 1.5 < swing.angle(time)[1].abs().max() <= 2.5


def test_windows_without_a_swing_are_unchanged():
    imu = torch.randn(16, 200, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    displacement = torch.ones(16, 1, 3, dtype=torch.float64)
    after, moved = apply_swing(imu, displacement, draw_swing(16, share=0.0))
    assert torch.allclose(after, imu, atol=1e-10)
    assert torch.allclose(moved, displacement, atol=1e-10)


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_the_share_of_swung_windows_is_as_requested(share):
    swing = draw_swing(4000, share)
    assert (swing.amplitude[:, 0] > 0).double().mean() == pytest.approx(share, abs=0.03)


def rotated(vector: torch.Tensor, axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    skew = torch.linalg.cross(
        axis[:, None, :].expand(-1, 3, -1), torch.eye(3, dtype=axis.dtype).expand(len(axis), 3, 3)
    ).mT
    return (torch.linalg.matrix_exp(skew * angle[:, None, None]) @ vector[:, :, None])[:, :, 0]
