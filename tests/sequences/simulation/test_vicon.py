from pathlib import Path

import numpy as np
import pytest
from recorded import DATA
from scipy.spatial.transform import Rotation

from stario.sequences.errors import ReadError
from stario.sequences.sequence import STANDARD_GRAVITY, FloatArray, Trajectory
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.vicon import clean_capture, read_vicon_walks, smooth_rows
from stario.sequences.simulation.walks import WalkStyle, generate_walk

WALKS = DATA / "walks" / "oxiod_vicon.npz"


@pytest.fixture(scope="module")
def walk() -> Trajectory:
    return generate_walk(2, 40.0, style=WalkStyle(preferred_speed=0.8))


def captured(walk: Trajectory, noise: float = 1e-4) -> FloatArray:
    """The walk as the capture would give it: noisy and in single precision."""
    rng = np.random.default_rng(0)
    position = walk.position_W + noise * rng.standard_normal((len(walk), 3))
    shaken = walk.attitude_WB * Rotation.from_rotvec(
        10 * noise * rng.standard_normal((len(walk), 3))
    )
    table = np.hstack([walk.time[:, None] + 300.0, position, shaken.as_quat(canonical=True)])
    return np.asarray(table.astype(np.float32), dtype=np.float64)


def off(piece: Trajectory, walk: Trajectory) -> tuple[float, float]:
    """Largest distance [m] and angle [rad] from the walk that was captured."""
    rows = np.rint((piece.time - 300.0) * 100.0).astype(int)
    distance = np.linalg.norm(piece.position_W - walk.position_W[rows], axis=1)
    angle = (piece.attitude_WB.inv() * walk.attitude_WB[rows]).magnitude()
    return float(distance.max()), float(angle.max())


def test_a_clean_capture_stays_whole_and_close(walk: Trajectory) -> None:
    (piece,) = clean_capture(captured(walk))
    assert piece.time[-1] - piece.time[0] > 39.5
    assert np.allclose(np.diff(piece.time), 0.01, atol=1e-9)
    distance, angle = off(piece, walk)
    assert distance < 0.004
    assert angle < 0.02


def test_smoothing_makes_the_noise_small_beside_the_gait(walk: Trajectory) -> None:
    (piece,) = clean_capture(captured(walk))
    rows = np.rint((piece.time - 300.0) * 100.0).astype(int)
    true = Trajectory(piece.time, walk.position_W[rows], walk.attitude_WB[rows])
    accel = [simulate_imu(track, 100.0, PERFECT_IMU).accel[50:-50] for track in (true, piece)]
    assert (accel[1] - accel[0]).std() < 0.5 * (accel[0] - accel[0].mean(axis=0)).std()
    raw = np.diff(captured(walk)[:, 1:4], 2, axis=0) * 1e4
    assert raw.std() > 2.0  # without smoothing it would have drowned


def test_a_glitch_is_bridged(walk: Trajectory) -> None:
    table = captured(walk)
    table[1000:1006, 1:4] += 0.3
    table[2000:2010, 4:8] = (
        Rotation.from_quat(table[2000:2010, 4:8]) * Rotation.from_rotvec([3.0, 0, 0])
    ).as_quat()
    table[3000:3004, 1:4] += 0.015  # too small a step to be seen, yet no body does that
    (piece,) = clean_capture(table)
    distance, angle = off(piece, walk)
    assert distance < 0.006
    assert angle < 0.05


def test_a_lasting_flip_and_a_gap_start_new_pieces(walk: Trajectory) -> None:
    table = captured(walk)
    table[1500:, 4:8] = (
        Rotation.from_quat(table[1500:, 4:8]) * Rotation.from_rotvec([0, 3.05, 0])
    ).as_quat()
    table = np.delete(table, np.arange(2500, 2560), axis=0)
    pieces = clean_capture(table)
    assert [round(piece.time[-1] - piece.time[0]) for piece in pieces] == [15, 10, 14]
    assert off(pieces[0], walk)[1] < 0.02
    assert off(pieces[1], walk)[1] > 3.0
    for piece in pieces:
        assert np.linalg.norm(simulate_imu(piece, 100.0, PERFECT_IMU).gyro, axis=1).max() < 6.0


def test_short_pieces_and_garbage_are_dropped(walk: Trajectory) -> None:
    table = captured(walk)
    assert clean_capture(table[:400]) == []
    assert clean_capture(table[:0]) == []
    table[:, 1:4] = np.random.default_rng(1).standard_normal((len(table), 3))
    assert clean_capture(table) == []


def test_smoothing_halves_its_cutoff_and_fills_losses() -> None:
    t = np.arange(4000) / 100.0
    for cutoff in (3.0, 6.0):
        wave = np.sin(2.0 * np.pi * cutoff * t)[:, None]
        smooth = smooth_rows(wave, np.ones(len(t)), cutoff)[500:-500]
        assert smooth.std() / wave[500:-500].std() == pytest.approx(0.5, abs=0.01)
        assert np.corrcoef(smooth[:, 0], wave[500:-500, 0])[0, 1] > 0.999  # no phase
    slow = np.sin(2.0 * np.pi * 0.5 * t)[:, None]
    weight = np.ones(len(t))
    weight[2000:2020] = 0.0
    broken = np.where(weight[:, None] > 0, slow, 99.0)
    assert np.abs(smooth_rows(broken, weight, 6.0) - slow)[100:-100].max() < 0.01


def test_files_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ReadError, match="file"):
        read_vicon_walks(tmp_path / "missing.npz")
    text = tmp_path / "text.npz"
    text.write_text("no archive")
    with pytest.raises(ReadError, match="npz"):
        read_vicon_walks(text)
    np.savez(tmp_path / "shape.npz", walk=np.zeros((10, 3)))
    with pytest.raises(ReadError, match="quaternion"):
        read_vicon_walks(tmp_path / "shape.npz")
    np.savez(tmp_path / "pickled.npz", walk=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ReadError, match="numeric"):
        read_vicon_walks(tmp_path / "pickled.npz")


@pytest.mark.skipif(not WALKS.exists(), reason=f"no recordings at {WALKS}")
def test_recorded_walks_keep_their_minutes_and_look_like_an_accelerometer() -> None:
    walks = read_vicon_walks(WALKS)
    pieces = [piece for track in walks.values() for piece in track]
    assert len(walks) == 24
    assert sum(piece.time[-1] - piece.time[0] for piece in pieces) / 60.0 > 140.0
    assert min(piece.time[-1] - piece.time[0] for piece in pieces) >= 5.0
    handheld = [p for name, track in walks.items() if name.startswith("hand") for p in track]
    for piece in handheld[::6]:
        imu = simulate_imu(piece, 100.0, PERFECT_IMU)
        force = np.linalg.norm(imu.accel, axis=1) - STANDARD_GRAVITY
        # Phones on such walks show 0.79 to 0.95 m/s^2 and never more than 5.
        assert 0.4 < force.std() < 1.5
        assert np.abs(force).max() < 6.0
        assert np.linalg.norm(imu.gyro, axis=1).max() < 8.0
