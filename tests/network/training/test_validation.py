"""Validation windows are those of inference: in the frame in which the device's heading is zero."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from stario.network.architectures import build_network
from stario.network.displacement import DisplacementNetwork
from stario.network.training.config import TrainingConfig
from stario.network.training.validation import ValidationSet
from stario.sequences.attitude.rotations import about_z
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import generate_walk
from stario.sequences.windows import WorldStream, world_streams


def rotated(stream: WorldStream, yaw: float) -> WorldStream:
    """The same walk in a world rotated about the vertical."""
    R = about_z(yaw).as_matrix()
    imu_W = np.concatenate([part @ R.T for part in np.split(stream.imu_W, 2, axis=1)], axis=1)
    return replace(
        stream,
        imu_W=imu_W.astype(np.float32),
        position_W=(stream.position_W @ R.T).astype(np.float32),
        facing_W=(stream.facing_W @ R[:2, :2].T).astype(np.float32),
    )


def test_errors_do_not_depend_on_the_yaw_of_the_world() -> None:
    [stream] = world_streams(simulate_imu(generate_walk(3, 10.0), 200.0, PERFECT_IMU, 0))
    torch.manual_seed(0)
    network = DisplacementNetwork(build_network("DeepILS"))
    before, after = (
        ValidationSet([each], torch.device("cpu"), TrainingConfig()).residuals(network)
        for each in (stream, rotated(stream, 2.0))
    )
    for found, expected in zip(after, before, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_errors_are_those_of_a_network_that_always_predicts_the_same() -> None:
    """The device faces along y: walked north means walked forward, along x of the window."""
    t = np.arange(1000) / 200.0
    position_W = np.stack([0.0 * t, 1.2 * t, 0.1 * t], axis=1).astype(np.float32)
    facing_W = np.tile(np.float32([0.0, 1.0]), (len(t), 1))
    still = np.tile(np.float32([0.0, 0.0, 0.0, 0.0, 0.0, 9.81]), (len(t), 1))

    class Constant(torch.nn.Module):
        def forward(self, windows: torch.Tensor) -> torch.Tensor:
            return torch.tensor([[1.0, 0.0, 0.0, -1.0, -2.0, -3.0]]).expand(len(windows), 6)

    stream = WorldStream("north", still, position_W, facing_W)
    held_out = ValidationSet([stream], torch.device("cpu"), TrainingConfig())
    error, log_sigma = held_out.residuals(DisplacementNetwork(Constant()))
    np.testing.assert_allclose(error, np.tile([-0.2, 0.0, -0.1], (len(error), 1)), atol=1e-5)
    np.testing.assert_allclose(log_sigma, np.tile([-1.0, -2.0, -3.0], (len(error), 1)))
