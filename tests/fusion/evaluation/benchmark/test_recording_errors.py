"""Errors of a network alone on one recording, against a known share of the truth."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from displacement_stub import Stub, errors_of, horizontal_path, streams_of, with_waypoints
from recorded import DATA

from stario.fusion.evaluation.displacement_error import (
    _AtTicks,
    _interpolated,
    _stretches,
    known_truth,
)
from stario.fusion.evaluation.pedestrian import PedestrianDeadReckoning
from stario.sequences.errors import InputError
from stario.sequences.readers import read_recording
from stario.sequences.sequence import ImuSequence, PositionTrack, is_gap

ARCHIVES = DATA / "archives"


def with_positions(walk: ImuSequence, jump: float = 0.0) -> ImuSequence:
    truth = walk.truth
    position_W = truth.position_W + np.where(truth.time > 40.0, jump, 0.0)[:, None]
    return replace(walk, truth=None, positions=PositionTrack(truth.time, position_W, "positions"))


def test_with_poses_displacements_of_nine_tenths_give_that_length_ratio(walk):
    stub = Stub(walk)
    size = float(np.sqrt(np.mean(np.sum(stub.displacement_H**2, axis=1))))
    found, blocks = errors_of(walk, Stub(walk, 0.9))
    assert found["length_ratio"] == pytest.approx(0.9, abs=0.02)
    assert found["rms_1s_m"] == pytest.approx(0.1 * size, rel=0.02)
    assert found["nis"] == pytest.approx(1.5 * (0.1 * size) ** 2 / 0.01, rel=0.05)
    assert found["rms_10s_m"] > 4.0 * found["rms_1s_m"]
    assert found["path_m"] == pytest.approx(horizontal_path(walk), rel=0.05)
    each_second = blocks[blocks["metric"] == "rms_1s_m"]
    assert len(each_second) == 3  # of 30 s each, the last one shorter
    total, count = each_second[["squares", "count"]].sum()
    assert np.sqrt(total / count) == pytest.approx(found["rms_1s_m"])


@pytest.mark.parametrize("count", [0, 1])
def test_a_recording_without_usable_truth_is_refused(walk, count):
    with pytest.raises(InputError, match="truth: found none"):
        known_truth(walk.without_truth())
    valid = np.arange(len(walk.truth.time)) < count
    with pytest.raises(InputError, match=f"truth: found {count} valid"):
        known_truth(replace(walk, truth=replace(walk.truth, valid=valid)))


def test_with_poses_a_rotation_raises_displacement_errors_but_not_the_fitted_ate(walk):
    exact, _ = errors_of(walk, Stub(walk))
    assert exact["rms_1s_m"] < 1e-9
    assert exact["rms_30s_m"] < 0.1  # windows overlap: a track through them is smoother
    assert exact["ate_fit_m"] < 0.1
    assert exact["ate_first_m"] < 0.2
    turned, _ = errors_of(walk, Stub(walk, yaw=0.5))
    assert turned["ate_fit_m"] == pytest.approx(exact["ate_fit_m"], rel=0.01)
    assert turned["ate_first_m"] > 10.0 * turned["ate_fit_m"]
    assert turned["rms_1s_m"] > 0.3


def test_with_positions_yaw_is_fitted_and_nothing_is_compared_across_a_jump(walk):
    smooth, all_blocks = errors_of(with_positions(walk), Stub(walk, 0.9, yaw=2.0))
    jumped, blocks = errors_of(with_positions(walk, jump=9.0), Stub(walk, 0.9, yaw=2.0))
    for found in (smooth, jumped):
        assert found["length_ratio"] == pytest.approx(0.9, abs=0.02)
        assert found["stretch_percent"] < 5.0
        assert np.isnan(found["ate_fit_m"])
    assert jumped["rms_10s_m"] == pytest.approx(smooth["rms_10s_m"], rel=0.3)
    fewer, all_of_them = (b.groupby("metric")["count"].sum() for b in (blocks, all_blocks))
    assert fewer["rms_10s_m"] < all_of_them["rms_10s_m"]


def test_positions_at_1_hz_give_the_same_errors(walk):
    time = np.arange(1.0, 74.0)
    track = PositionTrack(time, walk.truth.at(time).position_W, "positions")
    slow = replace(walk, truth=None, positions=track)
    found, _ = errors_of(slow, Stub(walk, 0.9, yaw=2.0))
    assert found["length_ratio"] == pytest.approx(0.9, abs=0.02)
    frequent, _ = errors_of(with_positions(walk), Stub(walk, 0.9, yaw=2.0))
    assert found["rms_10s_m"] == pytest.approx(frequent["rms_10s_m"], rel=0.05)


def test_with_waypoints_yaw_and_position_are_fitted_first(walk):
    exact, _ = errors_of(with_waypoints(walk), Stub(walk, yaw=-1.0))
    short, blocks = errors_of(with_waypoints(walk), Stub(walk, 0.9))
    assert exact["ate_fit_m"] < 0.1
    assert exact["length_ratio"] == pytest.approx(1.0, abs=0.02)
    assert short["length_ratio"] == pytest.approx(0.9, abs=0.02)
    # A track scaled about its centre has an error of a tenth of the waypoints' spread.
    time = np.arange(1.0, 70.0, 8.0)
    xy = walk.truth.at(time).position_W[:, :2]
    spread = float(np.sqrt(np.mean(np.sum((xy - xy.mean(axis=0)) ** 2, axis=1))))
    assert short["ate_fit_m"] == pytest.approx(0.1 * spread, rel=0.15)
    assert set(blocks["metric"]) == {"rms_10s_m"}
    total, count = blocks[["squares", "count"]].sum()
    assert np.sqrt(total / count) == pytest.approx(short["ate_fit_m"])


def test_positions_are_unknown_in_their_gaps_and_beyond_their_ends(walk):
    whole = with_positions(walk).positions
    time = whole.time
    known = ((time > 5.0) & (time < 20.0)) | ((time > 30.0) & (time < 70.0))
    ticks = np.arange(0.0, 75.0, 0.5)
    track = PositionTrack(time[known], whole.position_W[known], "positions")
    position, breaks = _interpolated(ticks, track, is_gap(np.diff(track.time)))
    inside = ((ticks > 5.1) & (ticks < 19.9)) | ((ticks > 30.1) & (ticks < 69.9))
    outside = (ticks < 4.9) | ((ticks > 20.1) & (ticks < 29.9)) | (ticks > 70.1)
    assert np.isfinite(position[inside]).all()
    assert np.isnan(position[outside]).all()
    assert len(set(breaks[(ticks > 5.1) & (ticks < 69.9)])) == 2  # before and after the gap


@pytest.mark.skipif(not ARCHIVES.exists(), reason=f"no recordings at {ARCHIVES}")
@pytest.mark.parametrize(
    ("name", "kind", "path_m", "error"),
    [
        ("kipd.h5:yk_01", "poses", 127.4, "ate_fit_percent"),
        ("rocip.h5:r4", "positions", 290.3, "stretch_percent"),
        ("ilc.h5:site2_F1_5dd35c7527889b0006b76852", "waypoints", 65.2, "ate_fit_percent"),
    ],
)
def test_pedestrian_dead_reckoning_is_near_the_truth_on_real_recordings(name, kind, path_m, error):
    recording = read_recording(Path(f"{ARCHIVES}/{name}"))
    found, _ = errors_of(recording, PedestrianDeadReckoning())
    assert known_truth(recording)[0] == kind
    assert found["path_m"] == pytest.approx(path_m, rel=0.05)
    assert found["length_ratio"] == pytest.approx(1.0, abs=0.3)
    assert found[error] < 15.0


def test_pedestrian_dead_reckoning_is_judged_like_a_network(stepping):
    [stream] = streams_of(stepping)
    predicted = PedestrianDeadReckoning().piece(stream)
    np.testing.assert_allclose(predicted.covariance_N[0], 0.3**2 * np.eye(3))  # its usual error
    found, _ = errors_of(stepping, PedestrianDeadReckoning())
    assert 0.5 < found["length_ratio"] < 1.6


def test_the_share_of_the_path_is_that_of_the_pieces_between_gaps(stepping):
    """Pieces are fitted one by one: a share of the whole path would shrink with every gap."""
    kept = np.abs(stepping.time - stepping.time.mean()) > 0.5
    samples = {name: getattr(stepping, name)[kept] for name in ("time", "gyro", "accel")}
    found, _ = errors_of(replace(stepping, **samples), PedestrianDeadReckoning())
    share = 100.0 * found["ate_fit_m"] / (0.5 * found["path_m"])
    assert found["ate_fit_percent"] == pytest.approx(share, rel=0.1)


def test_stretches_at_rest_have_no_error_relative_to_their_path():
    rng = np.random.default_rng(0)
    track, truth = (0.01 * (rng.normal(size=100) + 1j * rng.normal(size=100)) for _ in range(2))
    breaks = np.zeros(100, dtype=np.int64)
    assert list(_stretches(_AtTicks(track, truth, breaks))) == []
    assert len(list(_stretches(_AtTicks(track, truth + np.arange(100.0), breaks)))) == 3
