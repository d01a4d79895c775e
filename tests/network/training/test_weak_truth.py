from dataclasses import replace

import numpy as np
import pytest
import torch
from training_runs import shallow

from stario.network.displacement import DisplacementNetwork
from stario.network.training.augment import UNVARIED, Augmentation
from stario.network.training.config import TrainingConfig, training_config
from stario.network.training.data import TrainingData
from stario.network.training.legs import LegBatch, LegSampler, ends_covariance, velocity_change
from stario.network.training.losses import direction_loss, leg_residuals
from stario.network.training.parallel import Workers
from stario.network.training.train import train
from stario.network.training.validation import ValidationSet
from stario.sequences import ConfigError, InputError, LegStream, about_z, leg_streams, world_streams
from stario.sequences.sequence import FloatArray, ImuSequence, PositionTrack
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk

PLAIN = replace(UNVARIED, mirrored=0.5)
SECONDS = 12
STYLE = WalkStyle(carry="handheld", preferred_speed=1.4, mount_rotvec=(0.3, -0.2, 0.9))
WALK = simulate_imu(generate_walk(2, 60.0, style=STYLE), 100.0, PERFECT_IMU, 0, name="walk")


def with_positions(kind: str, every: float, yaw: float = 0.0) -> ImuSequence:
    """The walk with positions in place of poses, on a map rotated by a yaw [rad]."""
    time = np.arange(1.0, 58.0, every)
    position = WALK.truth.at(time).position_W
    rotated = about_z(yaw).apply(position)
    columns = 2 if kind == "waypoints" else 3
    track = PositionTrack(time, rotated[:, :columns], kind)
    return replace(WALK, truth=None, positions=track)


def sampler_of(streams: list[LegStream], seconds: int, augmentation=PLAIN) -> LegSampler:
    return LegSampler(streams, seconds, augmentation, torch.Generator().manual_seed(0))


def batch_of(recording: ImuSequence, augmentation: Augmentation = PLAIN) -> LegBatch:
    return sampler_of(leg_streams(recording), SECONDS, augmentation).batch(16)


def true_displacements(recording: ImuSequence, batch: LegBatch) -> torch.Tensor:
    """Return the true (S, K, 3) in the levelled frame N of stretches, found by their windows."""
    [stream] = leg_streams(recording)
    [world] = world_streams(WALK, attitude="true")
    found = []
    for windows in batch.windows:
        begin = begin_of(windows[0, 5].numpy(), stream)
        position = WALK.truth.at(begin / 200.0 + np.arange(SECONDS + 1.0)).position_W
        # The rotation from the world to the levelled frame, from the horizontal force.
        part = slice(begin, begin + 2000)
        a, b = (x[part, 3] + 1j * x[part, 4] for x in (world.imu_W, stream.imu_N))
        found.append(np.diff(position, axis=0) @ about_z(np.angle(np.vdot(a, b))).as_matrix().T)
    return torch.tensor(np.stack(found), dtype=torch.float32)


def begin_of(vertical: FloatArray, stream: LegStream) -> int:
    """Return the sample where a window begins, from its vertical force, which no yaw changes."""
    found = np.flatnonzero(np.abs(stream.imu_N[:-200, 5] - vertical[0]) < 1e-4)
    off = [np.abs(stream.imu_N[k : k + 200, 5] - vertical).max() for k in found]
    return int(found[np.argmin(off)])


def rotated(predicted_N: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    c, s = angle.cos(), angle.sin()
    x, y, z = predicted_N.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)


@pytest.mark.parametrize(("kind", "every"), [("positions", 0.1), ("waypoints", 4.0)])
def test_true_displacements_leave_no_residual_on_a_rotated_map(kind, every):
    recording = with_positions(kind, every, yaw=2.0)
    for augmentation in (PLAIN, replace(PLAIN, yaw=0.5, any_yaw=0.3)):
        batch = batch_of(recording, augmentation)
        assert int(batch.known.sum(1).min()) >= 2
        predicted_N = true_displacements(recording, batch)
        residual = leg_residuals(predicted_N, batch)
        # Ends within a window are interpolated at constant speed, which a start does not have.
        size = residual[..., :2].norm(dim=-1)[batch.known]
        assert float(size.median()) < 0.1
        assert float(size.max()) < 0.6
        longest = float(batch.displacement[..., :2].norm(dim=-1).max())
        assert longest > 2.0


def test_the_velocity_change_is_determined_from_the_accelerometer():
    [world] = world_streams(WALK, attitude="true")
    accel_W = torch.from_numpy(world.imu_W[: SECONDS * 200, 3:5]).view(1, SECONDS, 200, 2)
    position = torch.from_numpy(world.position_W[: SECONDS * 200 + 1 : 200, :2])
    moved = position.diff(dim=0)
    changes = moved[2:] - moved[:-2]
    changes = changes - changes.mean(dim=0)
    assert float(changes.norm(dim=-1).max()) > 0.5
    assert float((velocity_change(accel_W)[0] - changes).norm(dim=-1).max()) < 0.02


def test_the_direction_loss_rotates_displacements_back_to_the_true_direction():
    recording = with_positions("positions", 0.1)
    batch = batch_of(recording)
    predicted_N = true_displacements(recording, batch)
    right = float(direction_loss(predicted_N, batch))
    losses = []
    for degrees in (-90.0, 90.0, -130.0, 130.0, -170.0, 170.0):
        angle = torch.tensor(np.radians(degrees), dtype=torch.float32, requires_grad=True)
        loss = direction_loss(rotated(predicted_N, angle), batch)
        loss.backward()
        assert float(angle.grad) * degrees > 0.0
        losses.append(float(loss.detach()))
    by_size = np.reshape(losses, (3, 2)).mean(axis=1)  # to either side
    assert (np.diff(by_size) > 0.0).all()
    assert right < 0.2 * min(losses)


def test_a_waypoint_tapped_late_moves_two_legs_in_opposite_directions():
    start, stop = np.array([0.0, 4.0, 9.0]), np.array([4.0, 8.0, 13.0])
    C = ends_covariance(start, stop, np.full((3, 2), 0.5))
    np.testing.assert_allclose(np.diag(C), 0.5)
    assert C[0, 1] == pytest.approx(-0.25)  # they share the end at 4 s
    assert C[1, 2] == 0.0  # 8 and 9 s are two ends
    rng = np.random.default_rng(0)
    ends = 0.5 * rng.normal(size=(100_000, 5))
    legs = np.stack([ends[:, 1] - ends[:, 0], ends[:, 2] - ends[:, 1], ends[:, 4] - ends[:, 3]])
    np.testing.assert_allclose(np.cov(legs), C, atol=0.01)


def test_jumps_rides_invalid_positions_and_another_clock_make_no_legs():
    recording = with_positions("positions", 0.1)
    time, position = recording.positions.time, recording.positions.position_W.copy()
    position[time > 30.0] += [5.0, 0.0, 0.0]
    jumped = replace(recording, positions=PositionTrack(time, position, "positions"))
    [whole], [cut] = leg_streams(recording), leg_streams(jumped)
    assert len(whole.start) - len(cut.start) == 1
    assert not ((cut.start < 30.0) & (cut.stop > 30.1)).any()
    ride = replace(recording, positions=PositionTrack(time, 9.0 * position, "positions"))
    assert leg_streams(ride) == []
    run = replace(recording, positions=PositionTrack(time, 2.5 * position, "positions"))
    [slow] = leg_streams(run)  # without those of the full pace, which is below that of a jump
    speed = np.linalg.norm(slow.displacement, axis=1) / (slow.stop - slow.start)
    assert len(slow.start) < len(cut.start)
    assert speed.max() <= 2.5
    position = recording.positions.position_W
    nothing = PositionTrack(time, position, "positions", np.zeros(len(time), dtype=bool))
    assert leg_streams(replace(recording, positions=nothing)) == []
    stray = PositionTrack(np.append(time, 1.7e10), np.vstack([position, position[-1]]), "positions")
    [stream], [usual] = leg_streams(replace(recording, positions=stray)), leg_streams(recording)
    assert abs(len(stream.start) - len(usual.start)) <= 1


@pytest.mark.parametrize(("every", "legs"), [(0.1, 28), (1.0, 28), (2.5, 22)])
def test_a_track_at_a_low_rate_has_legs_except_across_its_gaps(every, legs):
    recording = with_positions("positions", every)
    [whole] = leg_streams(recording)
    assert len(whole.start) == pytest.approx(legs, abs=1)
    time = recording.positions.time
    valid = (time < 20.0) | (time > 28.0)
    gap = PositionTrack(time, recording.positions.position_W, "positions", valid)
    [cut] = leg_streams(replace(recording, positions=gap))
    assert not ((cut.start < 21.0) & (cut.stop > 27.0)).any()
    assert len(cut.start) < len(whole.start)


def test_stretches_are_divided_among_two_processes_but_not_among_three():
    batch, cpu = batch_of(with_positions("positions", 0.1)), torch.device("cpu")
    halves = [Workers(rank, 2, cpu).share(batch) for rank in (0, 1)]
    for value, *parts in zip(batch, *halves, strict=True):
        torch.testing.assert_close(torch.stack(parts, dim=1).flatten(0, 1), value)
    assert all(map(torch.equal, Workers(1, 3, cpu).share(batch), batch))


@pytest.mark.slow
def test_training_with_legs_reduces_the_error_at_positions(tmp_path, monkeypatch):
    """Legs are trained together with windows of full truth from the same walk."""
    [legs] = leg_streams(with_positions("positions", 0.1))
    streams = [stream.part(0, 4000) for stream in world_streams(WALK)]
    monkeypatch.setattr("stario.network.training.validation._STRETCHES", 6)
    config = TrainingConfig(
        epochs=3, epoch_windows=192, batch=16, rate=5e-3, seed=2, warm_up=0.0,
        likelihood_from=0.0, track_stretches=2, augmentation=PLAIN,
    )  # fmt: skip
    reports = []
    data = TrainingData(streams, legs=[legs])
    train(
        config, data, data, tmp_path,
        on_epoch=lambda report: reports.append(report.validation_by_recording),
    )  # fmt: skip
    assert reports[-1]["positions"] < 0.9 * reports[0]["positions"]
    assert (tmp_path / "checkpoint.safetensors").exists()


def test_a_recurrent_network_is_trained_on_stretches_in_rows(tmp_path, monkeypatch):
    """Its state is kept through a stretch, which must be a whole number of rows."""
    shallow(monkeypatch)
    monkeypatch.setattr("stario.network.training.validation._STRETCHES", 5)
    [legs] = leg_streams(with_positions("positions", 0.1))
    streams = [stream.part(0, 4000) for stream in world_streams(WALK)]
    values = {"architecture": "RNIN", "epochs": 1, "batch": 20, "epoch_windows": 20}
    config = training_config({**values, "track_stretches": 1, "likelihood_from": 0.0})
    data, shapes = TrainingData(streams, legs=[legs]), []
    original = DisplacementNetwork.forward
    monkeypatch.setattr(
        DisplacementNetwork,
        "forward",
        lambda self, *given: shapes.append(tuple(given[0].shape)) or original(self, *given),
    )
    train(config, data, data, tmp_path / "rows")
    assert shapes[0] == (3, 10, 6, 200)  # two rows with full truth, one stretch of a track
    assert (5, 10, 6, 200) in shapes
    with pytest.raises(ConfigError, match=r"positions: found 12, expected a multiple.*=10"):
        train(replace(config, track_seconds=12), data, data, tmp_path)


def test_legs_of_short_walks_can_select_the_weights_alone():
    [legs] = leg_streams(with_positions("positions", 0.1))
    part = replace(legs, imu_N=legs.imu_N[: 8 * 200], facing_N=legs.facing_N[: 8 * 200])
    data = TrainingData(world_streams(WALK), legs=[part], simulated=True)
    held_out = ValidationSet(data, TrainingConfig())
    assert list(held_out.legs) == ["positions"]  # of eight seconds, though training uses twelve
    errors = {"walk": 5.0, "positions": 0.25}
    assert held_out.selection_error(errors) == 0.25
    combined = ValidationSet(replace(data, simulated=False), TrainingConfig())
    assert combined.selection_error(errors) == 2.625


def test_stretches_begin_where_two_complete_legs_follow(caplog):
    """Two legs of ten seconds fit into 21 s only if the stretch begins at a waypoint."""
    [far], [near] = (
        leg_streams(with_positions("waypoints", 10.0)),
        leg_streams(with_positions("waypoints", 6.0)),
    )
    assert int(sampler_of([far], 21).batch(32).known.sum(1).min()) == 2
    assert not caplog.text
    both = sampler_of([far, near], 15).batch(32)
    assert int(both.known.sum(1).min()) == 2
    assert "skipping 1 of 2" in caplog.text
    assert float(both.seconds[both.known].max()) == pytest.approx(6.0)


def test_waypoints_too_far_apart_are_refused_with_the_seconds_that_suffice():
    """Unless the recording is too short for any recipe."""
    legs = leg_streams(with_positions("waypoints", 25.0))
    with pytest.raises(InputError, match=r"25.0 s .*within 20 s.*`waypoint_seconds`.* 51$"):
        sampler_of(legs, 20)
    assert int(sampler_of(legs, 51).batch(4).known.sum()) == 8
    with pytest.raises(InputError, match="use longer recordings; `--validation`"):
        sampler_of([stream.part(0, 30 * 200) for stream in legs], 20)


def test_validation_skips_legs_without_information(caplog):
    """Their error would be 0, the best possible."""
    legs = leg_streams(with_positions("waypoints", 25.0))
    data = TrainingData(world_streams(WALK), legs=legs, simulated=True)
    held_out = ValidationSet(data, TrainingConfig())
    assert held_out.legs == {}
    assert held_out.selection_error({"walk": 5.0}) == 5.0
    assert "validation skips waypoints" in caplog.text
