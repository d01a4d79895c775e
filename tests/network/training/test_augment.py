from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from cut_windows import windows_of
from scipy.spatial.transform import Rotation

from stario.network.training.augment import (
    UNVARIED,
    Augmentation,
    Swing,
    WindowSampler,
    apply_swing,
    heading_of,
    sample_swing,
)
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, Trajectory
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.windows import WINDOW_SAMPLES, WorldStream, world_streams

YAW_ONLY = replace(UNVARIED, any_yaw=1.0, mirrored=0.5)
"""No augmentation except any yaw, and a mirror image of one window in two."""

TO_MIRROR_IMAGE = np.diag([1.0, -1.0, 1.0])


def path(speed: float = 1.0, yaw: float = 0.0) -> Trajectory:
    """A smooth trajectory that never repeats, at a given speed and rotated by a yaw."""
    u = np.arange(0.0, 16.0, 0.01)
    position = np.stack(
        [
            2 * np.sin(1.3 * u) + 0.3 * u,
            np.cos(0.7 * u),
            0.3 * np.sin(3 * u) + 0.1 * np.sin(5.3 * u),
        ],
        1,
    )
    turn = np.stack([np.sin(1.1 * u), 0.8 * np.cos(1.7 * u), 0.9 * u + np.sin(2.3 * u)], axis=1)
    R = Rotation.from_rotvec([0.0, 0.0, yaw])
    return Trajectory(u / speed, R.apply(position), R * Rotation.from_rotvec(turn))


def stream_of(trajectory: Trajectory, name: str = "path") -> WorldStream:
    recording = simulate_imu(trajectory, errors=PERFECT_IMU, name=name)
    (stream,) = world_streams(recording, attitude="true")
    return stream


STREAM = stream_of(path())


@dataclass
class Drawn:
    """A drawn window (6, 200) with its displacement, start, and the yaw and mirroring applied."""

    window: FloatArray
    displacement: FloatArray
    start: int
    turn: FloatArray  # (3, 3), with determinant -1 if mirrored

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(self.turn) < 0.0)

    @property
    def yaw(self) -> float:
        R = self.turn @ TO_MIRROR_IMAGE if self.mirrored else self.turn
        return float(np.arctan2(R[1, 0], R[0, 0]))


def draw_windows(sampler: WindowSampler, references: FloatArray, count: int) -> list[Drawn]:
    """Draw windows; find where each begins, among those at every start, and how it was rotated."""
    found = []
    for window, displacement in zip(
        *(t.double().numpy() for t in sampler.batch(count)), strict=True
    ):
        # Yaw and mirroring keep the vertical acceleration and the size of the yaw rate.
        distance = np.square(references[:, 5] - window[5])
        distance += np.square(np.abs(references[:, 2]) - np.abs(window[2]))
        start = int(np.argmin(distance.sum(axis=1)))
        u, _, vt = np.linalg.svd(window[3:5] @ references[start, 3:5].T)
        turn = np.eye(3)
        turn[:2, :2] = u @ vt
        found.append(Drawn(window, displacement, start, turn))
    return found


def windows_at_every_start(stream: WorldStream) -> tuple[FloatArray, FloatArray]:
    windows, displacements = windows_of(stream, 1)
    return windows.astype(np.float64), displacements.astype(np.float64)


def test_without_ranges_windows_are_rotated_or_mirrored_windows_of_the_navigator():
    windows, displacements = windows_at_every_start(STREAM)
    draws = draw_windows(WindowSampler([STREAM], [1.0], YAW_ONLY, seed=0), windows, 32)
    assert {d.mirrored for d in draws} == {True, False}
    plain = WindowSampler([STREAM], [1.0], replace(YAW_ONLY, mirrored=0.0), seed=0)
    draws += (unmirrored := draw_windows(plain, windows, 32))
    assert {d.mirrored for d in unmirrored} == {False}
    for d in draws:
        # Angular rate is an axial vector: a mirror image reverses its sign.
        axial = d.turn * np.linalg.det(d.turn)
        np.testing.assert_allclose(d.window[:3], axial @ windows[d.start, :3], atol=1e-5)
        np.testing.assert_allclose(d.window[3:], d.turn @ windows[d.start, 3:], atol=1e-5)
        np.testing.assert_allclose(d.displacement, d.turn @ displacements[d.start], atol=1e-5)


@pytest.mark.parametrize("speed", [0.8, 1.25, 1.6])
def test_a_replayed_window_is_one_of_the_same_path_at_that_speed(speed):
    windows, displacements = windows_at_every_start(stream_of(path(speed=speed)))
    replay = replace(YAW_ONLY, speeds=(speed, speed), replayed=1.0)
    # Starts on the recording's grid fall between samples of the replay: take only near ones.
    draws = draw_windows(WindowSampler([STREAM], [1.0], replay, seed=2), windows, 64)
    near = [d for d in draws if np.abs(d.window[5] - windows[d.start, 5]).max() < 2e-3]
    assert len(near) >= 5
    for d in near:
        axial = d.turn * np.linalg.det(d.turn)
        np.testing.assert_allclose(d.window[:3], axial @ windows[d.start, :3], atol=5e-3)
        np.testing.assert_allclose(d.window[3:], d.turn @ windows[d.start, 3:], atol=2e-2)
        np.testing.assert_allclose(d.displacement, d.turn @ displacements[d.start], atol=2e-3)


def test_yaw_is_uniform_over_the_circle():
    rest = resting("east")
    east = replace(rest, position_W=np.float32([1.0, 0.0, 0.0]) * np.arange(2000)[:, None] / 200.0)
    _, displacement = WindowSampler([east], [1.0], YAW_ONLY, seed=3).batch(4000)
    yaw = torch.atan2(displacement[:, 1], displacement[:, 0])
    octants = torch.bincount(((yaw + np.pi) // (np.pi / 4)).long() % 8, minlength=8)
    assert octants.min() > 500 - 4 * np.sqrt(4000 * 7 / 64)


def resting(name: str, length: int = 2000, climb: float = 0.0) -> WorldStream:
    """A device at rest, or in a lift at constant speed [m/s]: the IMU measures gravity alone."""
    imu_W = np.zeros((length, 6), np.float32)
    imu_W[:, 5] = STANDARD_GRAVITY
    position_W = np.zeros((length, 3), np.float32)
    position_W[:, 2] = climb * np.arange(length) / 200.0
    ahead = np.tile(np.float32([1.0, 0.0]), (length, 1))  # a level device that heads along x
    return WorldStream(name, imu_W, position_W, ahead)


def at_rest_with(**ranges: float) -> torch.Tensor:
    sampler = WindowSampler([resting("rest")], [1.0], replace(YAW_ONLY, **ranges), seed=0)
    return sampler.batch(256)[0]


def test_tilt_rotates_gravity_by_no_more_than_its_limit():
    windows = at_rest_with(tilt=0.1)
    gravity = windows[:, 3:, 0].double()
    np.testing.assert_allclose(gravity.norm(dim=1), STANDARD_GRAVITY, rtol=1e-6)
    angle = torch.acos((gravity[:, 2] / STANDARD_GRAVITY).clamp(max=1.0))
    assert 0.06 < float(angle.max()) <= 0.1 + 1e-4
    assert float(gravity[:, :2].mean(dim=0).abs().max()) < 0.1


def test_biases_are_constant_over_a_window_and_within_their_range():
    windows = at_rest_with(gyro_bias=0.05, accel_bias=0.2)
    torch.testing.assert_close(windows, windows[:, :, :1].expand(-1, -1, WINDOW_SAMPLES))
    bias = windows[:, :, 0]
    bias[:, 5] -= STANDARD_GRAVITY
    limits = torch.tensor([0.05] * 3 + [0.2] * 3)
    assert (bias.abs() <= limits + 1e-5).all()
    assert (bias.abs().amax(0) > 0.9 * limits).all()


def test_noise_is_white_and_within_its_deviation():
    windows = at_rest_with(gyro_noise=0.02, accel_noise=0.15)
    deviation = windows.std(dim=2)
    limits = torch.tensor([0.02] * 3 + [0.15] * 3)
    assert (deviation <= 1.3 * limits).all()
    assert (deviation.amax(0) > 0.8 * limits).all()
    varied = windows - windows.mean(dim=2, keepdim=True)
    neighbours = (varied[:, :, 1:] * varied[:, :, :-1]).mean() / varied.square().mean()
    assert abs(float(neighbours)) < 0.02


def test_the_same_seed_draws_the_same_windows():
    def batches(seed):
        sampler = WindowSampler([STREAM], [1.0], Augmentation(), seed)
        return [*sampler.batch(8), *sampler.batch(8)]

    first, again, other = batches(5), batches(5), batches(6)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first[0], other[0])
    assert not torch.equal(first[0], first[2])


def test_weights_are_per_second_of_stream_and_no_window_extends_past_its_end():
    # A short lift up and a long lift down; the short one has three times the weight.
    streams = [resting("up", 1201, climb=1.0), resting("down", 4201, climb=-1.0)]
    _, displacement = WindowSampler(streams, [3.0, 1.0], YAW_ONLY, seed=0).batch(2000)
    share = float((displacement[:, 2] > 0.0).double().mean())
    assert share == pytest.approx(3 * 5 / (3 * 5 + 20), abs=0.05)
    streams = [resting(str(k), 400, climb=1.0) for k in range(8)]
    ranges = replace(YAW_ONLY, speeds=(0.6, 1.8), replayed=0.5)
    _, displacement = WindowSampler(streams, [1.0] * 8, ranges, seed=0).batch(2000)
    # A window that did would fall by the height of a stream.
    assert float(displacement[:, 2].min()) > 0.59
    assert float(displacement[:, 2].max()) < 1.81


def test_ten_hours_on_disk_are_not_loaded_into_memory(tmp_path):
    statm = Path("/proc/self/statm")
    if not statm.exists():
        pytest.skip("this system does not report resident memory")
    rows = 10 * 3600 * 200  # 317 MB in files of zeros that take no space on the disk
    imu_W, position_W, facing_W = (
        np.memmap(tmp_path / str(width), np.float32, "w+", shape=(rows, width))
        for width in (6, 3, 2)
    )
    before = int(statm.read_text().split()[1])
    long = WorldStream("long", imu_W, position_W, facing_W)
    sampler = WindowSampler([long], [1.0], Augmentation(), seed=0)
    windows, _ = sampler.batch(64)
    assert torch.isfinite(windows).all()
    assert int(statm.read_text().split()[1]) - before < 25_000  # pages of 4 kB


def test_successive_windows_are_contiguous_and_share_one_augmentation():
    ranges = replace(YAW_ONLY, gyro_bias=0.05, accel_bias=0.2, tilt=0.1)
    sampler = WindowSampler([resting("lift", 2400, climb=1.0)], [1.0], ranges, 0, successive=5)
    windows, displacement = sampler.batch(16)
    assert windows.shape == (16, 5, 6, 200)
    # One tilt and one bias for all windows of a row, others for the next row.
    torch.testing.assert_close(windows, windows[:, :1].expand_as(windows))
    assert float((windows[0] - windows[1]).abs().max()) > 1e-3
    torch.testing.assert_close(displacement[..., 2], torch.ones(16, 5), atol=1e-4, rtol=0.0)


def test_successive_windows_are_those_of_the_rotated_path():
    windows, displacements = windows_at_every_start(STREAM)
    rows, moved = WindowSampler([STREAM], [1.0], YAW_ONLY, 3, successive=4).batch(6)
    for row, moves in zip(rows.double().numpy(), moved.double().numpy(), strict=True):
        distance = np.square(windows[:, 5] - row[0, 5])
        start = int(np.argmin(distance.sum(axis=1)))
        for k in range(4):
            index = start + k * WINDOW_SAMPLES
            # Yaw and mirroring keep vertical components and lengths.
            np.testing.assert_allclose(row[k, 5], windows[index, 5], atol=1e-5)
            np.testing.assert_allclose(moves[k, 2], displacements[index, 2], atol=1e-5)
            lengths = [np.linalg.norm(d[:2]) for d in (moves[k], displacements[index])]
            assert lengths[0] == pytest.approx(lengths[1], abs=1e-5)


def test_a_swing_continues_from_one_window_to_the_next():
    swinging = replace(YAW_ONLY, swung=1.0, swing_rate=2.5, lever=0.35)
    windows, displacement = WindowSampler(
        [resting("rest", 2400)], [1.0], swinging, 0, successive=3
    ).batch(8)
    # Each window has its own heading, which affects neither vertical components nor lengths.
    invariant = torch.stack([*(windows[:, :, k] for k in (2, 5)), windows[:, :, :2].norm(dim=2)])
    seam = (invariant[:, :, 1:, 0] - invariant[:, :, :-1, -1]).abs().max()
    assert float(displacement.norm(dim=-1).max()) > 0.05
    assert float(seam) < 0.2  # a sample's change, not a jump to another swing


def test_windows_do_not_depend_on_where_the_device_points():
    plain = replace(YAW_ONLY, any_yaw=0.0, yaw=0.0)
    rotated = stream_of(path(yaw=2.0))
    first, second = (WindowSampler([s], [1.0], plain, seed=4).batch(16) for s in (STREAM, rotated))
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, atol=5e-3, rtol=1e-3)


def test_a_swing_rotates_the_heading_which_counts_as_much_as_the_device_is_level():
    """The heading of a level device rotates by the mean vertical component of the swing's angle."""
    generator = torch.Generator().manual_seed(0)
    swings = sample_swing(64, 1.0, 2.0, 0.0, generator)
    level = torch.zeros(64, 1, 10, 2)
    level[..., 0] = 1.0
    turn = (swings.angle(torch.arange(10) / 10.0)[0] * swings.axis[:, 2:]).mean(dim=1)
    small = turn.abs() < 0.3
    torch.testing.assert_close(
        heading_of(level, swings)[small, 0], turn[small], atol=0.05, rtol=0.0
    )
    # Facing vectors are short where the device points up or down, and its heading is vague.
    facing = torch.zeros(1, 1, 10, 2)
    facing[0, 0, :5, 0], facing[0, 0, 5:, 1] = 0.1, 1.0
    assert float(heading_of(facing)) == pytest.approx(np.arctan2(1.0, 0.1))


# --- rate, acceleration and displacement of a swing are those of one motion -----------------------


def at_rest(size: int) -> torch.Tensor:
    return torch.from_numpy(resting("rest", 200).imu_W).double().repeat(size, 1, 1)


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
    accel = imu[..., 3:] - torch.tensor([0.0, 0.0, STANDARD_GRAVITY])
    dt, moved = 1.0 / 200.0, torch.zeros(64, 3, dtype=torch.float64)
    for k in range(200):
        velocity_next = velocity + 0.5 * dt * (accel[:, k] + accel[:, min(k + 1, 199)])
        moved = moved + 0.5 * dt * (velocity + velocity_next)
        velocity = velocity_next
    assert displacement.abs().max() > 0.1
    assert (moved - displacement[:, 0]).abs().max() < 2e-3


def test_rate_and_acceleration_belong_to_one_rotation_and_recorded_rates_turn_with_it():
    """Centripetal and tangential parts: accel . r = -|omega x r|^2 for a rigid arm."""
    swing = draw_swing(64)
    imu, _ = apply_swing(at_rest(64), torch.zeros(64, 1, 3, dtype=torch.float64), swing)
    alpha = swing.angle(torch.zeros(1, dtype=torch.float64))[0][:, 0]
    lever = rotated(swing.lever, swing.axis, alpha)
    gyro, accel = imu[:, 0, :3], imu[:, 0, 3:] - torch.tensor([0.0, 0.0, STANDARD_GRAVITY])
    velocity = torch.linalg.cross(gyro, lever)
    assert torch.allclose((accel * lever).sum(1), -(velocity**2).sum(1), atol=1e-5)
    # Rate of the device in the world: its own, turned with it, and that of the swing.
    swing, imu = draw_swing(8), at_rest(8)
    imu[..., :3] = torch.tensor([0.3, -0.2, 0.5])
    alone, _ = apply_swing(at_rest(8), torch.zeros(8, 1, 3, dtype=torch.float64), swing)
    both, _ = apply_swing(imu, torch.zeros(8, 1, 3, dtype=torch.float64), swing)
    angle = swing.angle(torch.arange(200, dtype=torch.float64) / 200.0)[0]
    for k in (0, 70, 199):
        turned = rotated(imu[:, k, :3], swing.axis, angle[:, k])
        assert torch.allclose(both[:, k, :3] - alone[:, k, :3], turned, atol=1e-5)


@pytest.mark.parametrize("share", [0.25, 0.75])
def test_swings_have_the_share_requested_and_none_is_faster_than_its_bound(share):
    swing = draw_swing(4000, share)
    assert (swing.amplitude[:, 0] > 0).double().mean() == pytest.approx(share, abs=0.03)
    time = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    assert 1.5 < swing.angle(time)[1].abs().max() <= 2.5


def rotated(vector: torch.Tensor, axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    skew = torch.linalg.cross(
        axis[:, None, :].expand(-1, 3, -1), torch.eye(3, dtype=axis.dtype).expand(len(axis), 3, 3)
    ).mT
    return (torch.linalg.matrix_exp(skew * angle[:, None, None]) @ vector[:, :, None])[:, :, 0]
