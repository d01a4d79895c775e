from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
import torch

from stario.network.architectures import build_network
from stario.network.displacement import DisplacementNetwork
from stario.network.training.augment import Augmentation
from stario.network.training.config import TrainingConfig
from stario.network.training.data import TrainingData
from stario.network.training.legs import VARIANCE_RATE, LegBatch, LegSampler
from stario.network.training.losses import (
    SIGMA_WEIGHT,
    VELOCITY_SIGMA,
    direction_loss,
    leg_loss,
)
from stario.network.training.validation import ValidationSet
from stario.sequences import PERFECT_IMU, LegStream, about_z, generate_walk, simulate_imu
from stario.sequences.sequence import FloatArray
from stario.sequences.windows import WorldStream, world_streams

SECONDS, STRETCHES = 8, 6


class Stretch:
    """A stretch's legs, and the equations for K displacements in N and for log sigmas (K, 3)."""

    def __init__(self, stream: LegStream, begin: float) -> None:
        legs = (stream.start >= begin) & (stream.stop <= begin + SECONDS)
        self.start, self.stop = stream.start[legs] - begin, stream.stop[legs] - begin
        self.known, self.sigma = stream.displacement[legs], stream.sigma[legs]
        self.duration = self.stop - self.start

    def along_legs(self, steps: FloatArray) -> FloatArray:
        """Change (M, 3) over the legs of what grows evenly by `steps` (K, 3) in each second."""
        edges, total = np.arange(SECONDS + 1.0), np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
        ends = [
            np.column_stack([np.interp(time, edges, axis) for axis in total.T])
            for time in (self.start, self.stop)
        ]
        return ends[1] - ends[0]

    def yaw(self, d_N: FloatArray) -> float:
        found = self.along_legs(d_N)
        products = (found[:, 0] - 1j * found[:, 1]) * (self.known[:, 0] + 1j * self.known[:, 1])
        return float(np.angle(np.sum(products / self.duration)))

    def residual(self, d_N: FloatArray, yaw: float) -> FloatArray:
        return about_z(yaw).apply(self.along_legs(d_N)) - self.known

    def robust(self, d_N: FloatArray, yaw: float) -> float:
        """Sum of the robust squares of the whitened residuals."""
        C = np.diag((self.sigma**2).sum(axis=1) + VARIANCE_RATE * self.duration)
        for one, following in pairwise(range(len(C))):
            if self.stop[one] == self.start[following]:  # they share a position
                shared = self.sigma[one, 1] * self.sigma[following, 0]
                C[one, following] = C[following, one] = -shared
        white = np.linalg.solve(np.linalg.cholesky(C), self.residual(d_N, yaw))
        size = np.linalg.norm(white, axis=1)
        return float(np.where(size < 3.0, size**2, 6.0 * size - 9.0).sum())

    def likelihood(self, log_sigma: FloatArray, residual: FloatArray) -> float:
        """Negative log-likelihood of the horizontal residuals, without constants."""
        variance = np.exp(2.0 * log_sigma[:, :2]).mean(axis=1)
        total = self.along_legs(np.outer(variance, np.ones(3)))[:, 0]
        total += (self.sigma**2).sum(axis=1)
        return float((0.5 * (residual[:, :2] ** 2).sum(axis=1) / total + np.log(total)).sum())


@pytest.fixture(scope="module")
def drawn():
    """Stretches in double precision, as a batch and one by one."""
    rng = np.random.default_rng(0)
    imu_N = rng.normal(size=(3200, 6)).astype(np.float32)
    imu_N[:, 5] = np.arange(len(imu_N))  # tells where a window begins, mirrored or not
    facing_N = np.tile(np.float32([0.6, -0.8]), (len(imu_N), 1))
    # Some legs begin where another ends, some do not; the times are exact in binary.
    start = np.array([0.25, 2.125, 4.0, 6.375, 9.0, 11.125, 13.5])
    stop = np.array([2.125, 3.875, 6.375, 9.0, 11.0, 13.0, 15.75])
    known = rng.normal(size=(len(start), 3)) * [2.0, 2.0, 0.3]
    sigma = rng.uniform(0.3, 0.6, (len(start), 2))
    stream = LegStream("walk", "waypoints", imu_N, facing_N, start, stop, known, sigma)
    varied = Augmentation(tilt=0.0, gyro_bias=0.0, accel_bias=0.0, gyro_noise=0.0, accel_noise=0.0)
    batch = LegSampler([stream], SECONDS, varied, torch.Generator().manual_seed(2)).batch(STRETCHES)
    begins = batch.windows[:, 0, 5, 0].double() / 200.0
    double = LegBatch(*(v.double() if v.is_floating_point() else v for v in batch))
    return double, [Stretch(stream, float(begin)) for begin in begins]


def slope(function: Callable[[FloatArray], float], at: FloatArray) -> FloatArray:
    """Central differences with respect to every element of `at`."""
    found, step = np.zeros_like(at), 1e-5
    for index in np.ndindex(at.shape):
        moved = np.zeros_like(at)
        moved[index] = step
        found[index] = (function(at + moved) - function(at - moved)) / (2.0 * step)
    return found


def test_loss_and_gradients_follow_the_equations(drawn):
    """Neither the fitted yaw nor the likelihood's residual passes a gradient to the mean."""
    batch, stretches = drawn
    rng = np.random.default_rng(1)
    d_H = rng.normal(size=(STRETCHES, SECONDS, 3)) * [1.0, 1.0, 0.2] + [0.7, 0.2, 0.0]
    log_sigma = rng.normal(-1.0, 0.5, (STRETCHES, SECONDS, 3))
    mean, sigma = (torch.tensor(part, requires_grad=True) for part in (d_H, log_sigma))
    loss, plain = leg_loss(mean, sigma, batch)
    loss = loss - direction_loss((batch.R_NH @ mean[..., None])[..., 0], batch)
    loss.backward()

    count = sum(len(stretch.known) for stretch in stretches)
    assert int(batch.known.sum()) == count > 2 * STRETCHES
    R_NH = batch.R_NH.numpy()
    d_N = np.einsum("skij,skj->ski", R_NH, d_H)
    yaws = [stretch.yaw(d) for stretch, d in zip(stretches, d_N, strict=True)]
    expected, per_second = 0.0, 0.0
    for s, (stretch, yaw) in enumerate(zip(stretches, yaws, strict=True)):
        residual = stretch.residual(d_N[s], yaw)
        robust = partial(stretch.robust, yaw=yaw)
        likelihood = partial(stretch.likelihood, residual=residual)
        expected += VARIANCE_RATE * robust(d_N[s]) + SIGMA_WEIGHT * likelihood(log_sigma[s])
        per_second += float(((residual[:, :2] ** 2).sum(axis=1) / stretch.duration).sum())
        in_N = VARIANCE_RATE / count * slope(robust, d_N[s])
        in_H = np.einsum("kij,ki->kj", R_NH[s], in_N)
        np.testing.assert_allclose(mean.grad[s], in_H, atol=1e-6)
        of_sigma = SIGMA_WEIGHT / count * slope(likelihood, log_sigma[s])
        np.testing.assert_allclose(sigma.grad[s], of_sigma, atol=1e-6)
    assert float(loss.detach()) == pytest.approx(expected / count, rel=1e-5)
    assert float(plain) == pytest.approx(per_second / count, rel=1e-5)


def turned_away(d_N: FloatArray, change: FloatArray, size: float) -> float:
    """Loss of a stretch's direction; `size` is the root mean square of |d_k+2 - d_k|, no variable.

    Args:
        d_N: (K, 3) displacements in N.
        change: (K - 2, 2) changes of velocity by the accelerometer.
        size: as above.
    """
    d, a = (v[:, 0] + 1j * v[:, 1] for v in (d_N[2:] - d_N[:-2], change))
    c = np.mean(np.conj(d) * a)
    chance = 0.25 * size * float(np.sqrt(np.mean(np.abs(a) ** 2)))
    return float(2.0 * VARIANCE_RATE / VELOCITY_SIGMA**2 * max(0.0, abs(c) / 2 - c.real - chance))


def test_direction_loss_and_its_gradient_follow_the_equations(drawn):
    """Some stretches contradict the accelerometer beyond chance, others do not."""
    batch, d_N = drawn[0], np.random.default_rng(3).normal(size=(STRETCHES, SECONDS, 3))
    predicted = torch.tensor(d_N, requires_grad=True)
    loss = direction_loss(predicted, batch)
    loss.backward()
    losses = []
    for d, change, gradient in zip(d_N, batch.velocity_change.numpy(), predicted.grad, strict=True):
        size = float(np.sqrt(np.mean(np.sum((d[2:] - d[:-2])[:, :2] ** 2, axis=1))))
        of_stretch = partial(turned_away, change=change, size=size)
        losses.append(of_stretch(d))
        np.testing.assert_allclose(gradient, slope(of_stretch, d) / STRETCHES, atol=1e-6)
    assert 0 < np.count_nonzero(losses) < STRETCHES
    assert float(loss.detach()) == pytest.approx(np.mean(losses), rel=1e-5)


def rotated(stream: WorldStream, yaw: float) -> WorldStream:
    R = about_z(yaw).as_matrix()
    imu_W = np.concatenate([part @ R.T for part in np.split(stream.imu_W, 2, axis=1)], axis=1)
    return replace(
        stream,
        imu_W=imu_W.astype(np.float32),
        position_W=(stream.position_W @ R.T).astype(np.float32),
        facing_W=(stream.facing_W @ R[:2, :2].T).astype(np.float32),
    )


def test_errors_do_not_depend_on_the_yaw_of_the_world():
    [stream] = world_streams(simulate_imu(generate_walk(3, 10.0), 200.0, PERFECT_IMU, 0))
    torch.manual_seed(0)
    network = DisplacementNetwork(build_network("DeepILS"))
    before, after = (
        ValidationSet(TrainingData([each]), TrainingConfig()).residuals(network)
        for each in (stream, rotated(stream, 2.0))
    )
    for found, expected in zip(after, before, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-4)


def test_errors_are_those_of_a_network_that_always_predicts_the_same():
    """The device faces along y: walked north means walked forward, along x of the window."""
    t = np.arange(1000) / 200.0
    position_W = np.stack([0.0 * t, 1.2 * t, 0.1 * t], axis=1).astype(np.float32)
    facing_W = np.tile(np.float32([0.0, 1.0]), (len(t), 1))
    still = np.tile(np.float32([0.0, 0.0, 0.0, 0.0, 0.0, 9.81]), (len(t), 1))

    class Constant(torch.nn.Module):
        def forward(self, windows):
            return torch.tensor([[1.0, 0.0, 0.0, -1.0, -2.0, -3.0]]).expand(len(windows), 6)

    stream = WorldStream("north", still, position_W, facing_W)
    held_out = ValidationSet(TrainingData([stream]), TrainingConfig())
    error, log_sigma = held_out.residuals(DisplacementNetwork(Constant()))
    np.testing.assert_allclose(error, np.tile([-0.2, 0.0, -0.1], (len(error), 1)), atol=1e-5)
    np.testing.assert_allclose(log_sigma, np.tile([-1.0, -2.0, -3.0], (len(error), 1)))
