"""Judging of networks alone by groups, with a stub that predicts a known share of the truth."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from recorded import DATA
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.folders import fresh_folder
from stario.fusion.evaluation.judging.displacement_error import (
    RecordingErrors,
    _AtTicks,
    _stretches,
    _Sums,
    recording_errors,
)
from stario.fusion.evaluation.judging.judge import (
    POOLED,
    RecordingResult,
    judge,
    labels,
    rows_of,
)
from stario.fusion.evaluation.judging.network_alone import Predictions, predictions
from stario.fusion.evaluation.judging.prepared import Prepared, prepare, prepared_recordings
from stario.fusion.evaluation.judging.table import (
    JudgingResult,
    groups_figure,
    judgement_text,
    verdict,
    write_judgement,
)
from stario.fusion.evaluation.pedestrian import PedestrianDeadReckoning
from stario.sequences.attitude.rotations import about_z
from stario.sequences.datasets.batch import Skipped
from stario.sequences.errors import InputError
from stario.sequences.readers import read_recording
from stario.sequences.sequence import ImuSequence, PositionTrack
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import generate_walk

ARCHIVES = DATA / "archives"


@pytest.fixture(scope="module")
def walk() -> ImuSequence:
    return simulate_imu(generate_walk(9, 75.0), 100.0, PERFECT_IMU, 3, name="walk")


def with_positions(walk: ImuSequence, jump: float = 0.0) -> ImuSequence:
    truth = walk.truth
    assert truth is not None
    position_W = truth.position_W + np.where(truth.time > 40.0, jump, 0.0)[:, None]
    return replace(walk, truth=None, positions=PositionTrack(truth.time, position_W, "positions"))


def with_waypoints(walk: ImuSequence, every: float = 8.0) -> ImuSequence:
    truth = walk.truth
    assert truth is not None
    time = np.arange(1.0, 70.0, every)
    xy = truth.at(time).position_W[:, :2]
    return replace(walk, truth=None, positions=PositionTrack(time, xy, "waypoints"))


@cache
def prepared_once(recording: ImuSequence) -> Prepared:
    return prepare(recording, Path("walk"))


class Stub:
    """Predictor of the true displacements of successive windows, scaled and rotated."""

    def __init__(self, walk: ImuSequence, scale: float = 1.0, yaw: float = 0.0) -> None:
        [piece] = prepared_once(walk).pieces
        known = piece.position_W
        steps = np.exp(-1j * piece.yaw_WN[:-2]) * (known[2:] - known[:-2])
        steps = scale * np.exp(1j * yaw) * steps[: piece.stream.window_count]
        steps = np.pad(steps, (0, piece.stream.window_count - len(steps)), "edge")
        steps = np.exp(-1j * piece.stream.headings) * steps  # in the windows' frames
        self.displacement_H = np.stack([steps.real, steps.imag, 0.0 * steps.real], axis=1)
        self.served = 0

    def predict(self, windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first, self.served = self.served, self.served + len(windows)
        covariance = np.broadcast_to(0.01 * np.eye(3), (len(windows), 3, 3))
        return self.displacement_H[first : self.served], covariance


def horizontal_path(walk: ImuSequence) -> float:
    truth = walk.truth
    assert truth is not None
    return replace(truth, position_W=truth.position_W * [1.0, 1.0, 0.0]).path_length()


def errors_of(recording: ImuSequence, stub: Stub | PedestrianDeadReckoning) -> RecordingErrors:
    prepared = prepared_once(recording)
    return recording_errors(prepared, predictions(stub, prepared))


def test_with_poses_displacements_of_nine_tenths_give_that_length_ratio(walk: ImuSequence) -> None:
    stub = Stub(walk)
    size = float(np.sqrt(np.mean(np.sum(stub.displacement_H**2, axis=1))))
    found = errors_of(walk, Stub(walk, 0.9))
    assert found.kind == "poses"
    assert found.figures["length_ratio"] == pytest.approx(0.9, abs=0.02)
    assert found.figures["rms_1s_m"] == pytest.approx(0.1 * size, rel=0.02)
    assert found.figures["nis"] == pytest.approx(1.5 * (0.1 * size) ** 2 / 0.01, rel=0.05)
    assert found.figures["rms_10s_m"] > 4.0 * found.figures["rms_1s_m"]
    assert found.path_m == pytest.approx(horizontal_path(walk), rel=0.05)
    assert len(found.blocks["1"]) == 3  # of 30 s each, the last one shorter
    total, count = found.blocks["1"].sum(axis=0)
    assert np.sqrt(total / count) == pytest.approx(found.figures["rms_1s_m"])


def test_the_yaw_from_the_levelled_frame_to_the_world_is_the_truths(walk: ImuSequence) -> None:
    [piece] = prepared_once(walk).pieces
    known = np.isfinite(piece.yaw_WN)
    attitude_WB = about_z(piece.yaw_WN[known]) * Rotation.from_matrix(piece.stream.R_NB[known])
    assert walk.truth is not None
    true_WB = walk.truth.at(piece.stream.ticks[known]).attitude_WB
    assert (attitude_WB * true_WB.inv()).magnitude().max() < 0.1  # what levelling is off by


def test_with_poses_a_rotation_raises_displacement_errors_but_not_the_fitted_ate(
    walk: ImuSequence,
) -> None:
    exact = errors_of(walk, Stub(walk)).figures
    assert exact["rms_1s_m"] < 1e-9
    assert exact["rms_30s_m"] < 0.1  # windows overlap: a track through them is smoother
    assert exact["ate_fit_m"] < 0.1
    assert exact["ate_first_m"] < 0.2
    turned = errors_of(walk, Stub(walk, yaw=0.5)).figures
    assert turned["ate_fit_m"] == pytest.approx(exact["ate_fit_m"], rel=0.01)
    assert turned["ate_first_m"] > 10.0 * turned["ate_fit_m"]
    assert turned["rms_1s_m"] > 0.3


def test_with_positions_yaw_is_fitted_and_nothing_is_compared_across_a_jump(
    walk: ImuSequence,
) -> None:
    smooth = errors_of(with_positions(walk), Stub(walk, 0.9, yaw=2.0))
    jumped = errors_of(with_positions(walk, jump=9.0), Stub(walk, 0.9, yaw=2.0))
    for found in (smooth, jumped):
        assert found.kind == "positions"
        assert found.figures["length_ratio"] == pytest.approx(0.9, abs=0.02)
        assert found.figures["stretch_percent"] < 5.0
        assert np.isnan(found.figures["ate_fit_m"])
    assert jumped.figures["rms_10s_m"] == pytest.approx(smooth.figures["rms_10s_m"], rel=0.3)
    assert jumped.blocks["10"][:, 1].sum() < smooth.blocks["10"][:, 1].sum()


def test_positions_at_1_hz_give_the_same_errors(walk: ImuSequence) -> None:
    assert walk.truth is not None
    time = np.arange(1.0, 74.0)
    track = PositionTrack(time, walk.truth.at(time).position_W, "positions")
    slow = replace(walk, truth=None, positions=track)
    found = errors_of(slow, Stub(walk, 0.9, yaw=2.0))
    assert found.figures["length_ratio"] == pytest.approx(0.9, abs=0.02)
    frequent = errors_of(with_positions(walk), Stub(walk, 0.9, yaw=2.0))
    assert found.figures["rms_10s_m"] == pytest.approx(frequent.figures["rms_10s_m"], rel=0.05)


def test_with_waypoints_yaw_and_position_are_fitted_first(walk: ImuSequence) -> None:
    exact = errors_of(with_waypoints(walk), Stub(walk, yaw=-1.0))
    short = errors_of(with_waypoints(walk), Stub(walk, 0.9))
    assert exact.figures["ate_fit_m"] < 0.1
    assert exact.figures["length_ratio"] == pytest.approx(1.0, abs=0.02)
    assert short.figures["length_ratio"] == pytest.approx(0.9, abs=0.02)
    # A track scaled about its centre has an error of a tenth of the waypoints' spread.
    time = np.arange(1.0, 70.0, 8.0)
    assert walk.truth is not None
    xy = walk.truth.at(time).position_W[:, :2]
    spread = float(np.sqrt(np.mean(np.sum((xy - xy.mean(axis=0)) ** 2, axis=1))))
    assert short.figures["ate_fit_m"] == pytest.approx(0.1 * spread, rel=0.15)
    total, count = short.blocks["10"].sum(axis=0)
    assert np.sqrt(total / count) == pytest.approx(short.figures["ate_fit_m"])


def test_positions_are_unknown_in_their_gaps_and_beyond_their_ends(walk: ImuSequence) -> None:
    whole = with_positions(walk).positions
    assert whole is not None
    time = whole.time
    valid = ((time > 5.0) & (time < 20.0)) | ((time > 30.0) & (time < 70.0))
    with_gap = replace(walk, truth=None, positions=replace(whole, valid=valid))
    [piece] = prepare(with_gap, Path("walk")).pieces
    ticks, known = piece.stream.ticks, np.isfinite(piece.position_W)
    inside = ((ticks > 5.1) & (ticks < 19.9)) | ((ticks > 30.1) & (ticks < 69.9))
    outside = (ticks < 4.9) | ((ticks > 20.1) & (ticks < 29.9)) | (ticks > 70.1)
    assert known[inside].all()
    assert not known[outside].any()
    assert len(set(piece.breaks[(ticks > 5.1) & (ticks < 69.9)])) == 2  # before and after the gap


def test_equal_displacements_give_a_straight_track_at_constant_speed() -> None:
    displacement = np.tile([1.2, -0.4, 0.0], (9, 1))
    track = Predictions(displacement, np.tile(np.eye(3), (9, 1, 1))).track()
    np.testing.assert_allclose(track, (0.6 - 0.2j) * np.arange(11))


def test_a_recording_without_truth_is_refused(walk: ImuSequence) -> None:
    with pytest.raises(InputError, match="truth: found none"):
        prepare(walk.without_truth(), Path("walk"))


@pytest.mark.skipif(not ARCHIVES.exists(), reason=f"no recordings at {ARCHIVES}")
@pytest.mark.parametrize(
    ("name", "kind", "path_m", "error"),
    [
        ("kipd.h5:yk_01", "poses", 127.4, "ate_fit_percent"),
        ("rocip.h5:r4", "positions", 290.3, "stretch_percent"),
        ("ilc.h5:site2_F1_5dd35c7527889b0006b76852", "waypoints", 65.2, "ate_fit_percent"),
    ],
)
def test_pedestrian_dead_reckoning_is_near_the_truth_on_real_recordings(
    name: str, kind: str, path_m: float, error: str
) -> None:
    path = Path(f"{ARCHIVES}/{name}")
    prepared = prepare(read_recording(path), path)
    found = recording_errors(prepared, predictions(PedestrianDeadReckoning(), prepared))
    assert found.kind == kind
    assert found.path_m == pytest.approx(path_m, rel=0.05)
    assert found.figures["length_ratio"] == pytest.approx(1.0, abs=0.3)
    assert found.figures[error] < 15.0


@pytest.mark.parametrize("count", [0, 1])
def test_ground_truth_with_one_valid_pose_or_none_is_refused(walk: ImuSequence, count: int) -> None:
    valid = np.arange(len(walk.truth.time)) < count
    with pytest.raises(InputError, match=f"truth: found {count} valid"):
        prepare(replace(walk, truth=replace(walk.truth, valid=valid)), Path("walk"))


def test_prepared_recordings_are_cached(walk: ImuSequence, tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_text("stands for the recording")
    read: list[Path] = []

    def reading(path: Path) -> ImuSequence:
        read.append(path)
        return with_waypoints(walk)

    first, again = (
        next(prepared_recordings([path], reading, {}, tmp_path / "cache", 1)) for _ in range(2)
    )
    assert len(read) == 1
    assert isinstance(first, Prepared)
    assert isinstance(again, Prepared)
    assert again.kind == "waypoints"
    np.testing.assert_array_equal(again.pieces[0].waypoint_W, first.pieces[0].waypoint_W)
    np.testing.assert_array_equal(again.pieces[0].stream.imu_N, first.pieces[0].stream.imu_N)
    next(prepared_recordings([path], reading, {"axes": "y,-x,z"}, tmp_path / "cache", 1))
    assert len(read) == 2
    path.write_text("another recording")
    next(prepared_recordings([path], reading, {}, tmp_path / "cache", 1))
    assert len(read) == 3


def test_pedestrian_dead_reckoning_is_judged_like_a_network(walk: ImuSequence) -> None:
    [predicted] = PedestrianDeadReckoning().predictions(prepared_once(walk))
    np.testing.assert_allclose(predicted.covariance_N[0], 0.3**2 * np.eye(3))  # its usual error
    found = errors_of(walk, PedestrianDeadReckoning())
    assert 0.5 < found.figures["length_ratio"] < 1.6


def test_the_share_of_the_path_is_that_of_the_pieces_between_gaps(walk: ImuSequence) -> None:
    """Pieces are fitted one by one: a share of the whole path would shrink with every gap."""
    kept = np.abs(walk.time - walk.time.mean()) > 0.5
    samples = {name: getattr(walk, name)[kept] for name in ("time", "gyro", "accel")}
    found = errors_of(replace(walk, **samples), PedestrianDeadReckoning())
    share = 100.0 * found.figures["ate_fit_m"] / (0.5 * found.path_m)
    assert found.figures["ate_fit_percent"] == pytest.approx(share, rel=0.1)


@pytest.fixture(scope="module")
def judged_pair(walk: ImuSequence) -> list[RecordingResult]:
    prepared = [
        replace(prepare(recording, Path(name)), attributes={"person": person})
        for name, person, recording in (("one", "a", walk), ("two", "b", with_waypoints(walk)))
    ]
    groups = {Path("one"): "walks a", Path("two"): "walks b"}
    scales = {"walks a": 0.95, "walks b": 0.9}
    models = {
        "ours": lambda group: Stub(walk, scales[group]),
        "theirs": lambda group: Stub(walk, 0.8),
    }
    judged, skipped = judge([*prepared, Skipped("three", "why")], models, groups)
    assert [one.item for one in skipped] == ["three"]
    return judged


def test_a_recording_with_two_waypoints_is_named_as_not_compared(
    walk: ImuSequence, caplog: pytest.LogCaptureFixture
) -> None:
    prepared = [prepare(with_waypoints(walk, every), Path(f"{every:g}")) for every in (50.0, 8.0)]
    judged, _ = judge(prepared, {"ours": lambda group: Stub(walk)}, {})
    assert [record.getMessage()[:17] for record in caplog.records] == ["50: not compared,"]
    assert [one.errors["ours"].path_m > 0.0 for one in judged] == [False, True]
    caplog.clear()
    judge([prepared[0], *prepared], {"ours": lambda group: Stub(walk)}, {})
    [record] = caplog.records
    assert record.getMessage().startswith("2 of 3 recordings, the first 50: not compared,")


def test_a_device_at_rest_counts_in_no_median_or_ratio(
    walk: ImuSequence, caplog: pytest.LogCaptureFixture
) -> None:
    """Its errors relative to its path, the noise of its truth, would be a thousand percent."""
    still = 1e-4 * np.random.default_rng(0).normal(size=walk.truth.position_W.shape)
    resting = replace(walk, name="rest", truth=replace(walk.truth, position_W=still))
    prepared = [prepare(each, Path(each.name)) for each in (walk, resting)]
    models = {"ours": lambda group: Stub(walk), "theirs": lambda group: Stub(walk, 0.8)}
    judged, _ = judge(prepared, models, {})
    assert "rest: not compared, because the ground truth moves by less" in caplog.text
    both, alone = (rows_of(part, "set", "ours", "theirs")[-1] for part in (judged, judged[:1]))
    assert str(both.medians) == str(alone.medians)  # some are NaN
    assert both.ratios == alone.ratios
    assert both.recordings == 1


def test_rows_compare_weights_by_group_and_pooled(
    walk: ImuSequence, judged_pair: list[RecordingResult]
) -> None:
    rows = {row.name: row for row in rows_of(judged_pair, "person", "ours", "theirs")}
    assert list(rows) == ["a", "b", "all"]
    assert rows["a"].ratios["rms_1s_m"].ratio == pytest.approx(0.25, rel=0.01)
    assert rows["b"].ratios["rms_10s_m"].ratio == pytest.approx(0.5, abs=0.05)
    assert list(rows["b"].ratios) == ["rms_10s_m"]
    assert rows["all"].ratios["rms_10s_m"].ratio == pytest.approx(np.sqrt(0.25 * 0.5), abs=0.04)
    assert rows["a"].path_km == pytest.approx(1e-3 * horizontal_path(walk), rel=0.05)
    assert rows["a"].medians["theirs"]["length_ratio"] == pytest.approx(0.8, abs=0.02)


def test_without_a_list_intervals_are_drawn_over_the_persons_of_an_archive(
    walk: ImuSequence,
) -> None:
    """Over recordings alone, those of one person would pass for those of many."""
    scales = {"r.h5:1": ("a", 0.95), "r.h5:2": ("b", 0.9), "r.h5:3": ("b", 0.9)}
    prepared = [
        replace(prepare(walk, Path(name)), attributes={"person": person})
        for name, (person, _) in scales.items()
    ]
    by_group = {f"r {person}": scale for person, scale in scales.values()}
    models = {
        "ours": lambda group: Stub(walk, by_group[group]),
        "theirs": lambda group: Stub(walk, 0.8),
    }
    judged, _ = judge(prepared, models, {})
    ratio = rows_of(judged, "person", "ours", "theirs")[-1].ratios["rms_1s_m"].ratio
    assert ratio == pytest.approx(np.sqrt(0.25 * 0.5), rel=0.01)  # persons have equal weights


def test_a_file_named_without_its_folder_belongs_to_the_set_of_that_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert labels(Path("walk.csv"), {})["set"] == tmp_path.name


def test_stretches_at_rest_have_no_error_relative_to_their_path() -> None:
    rng, sums = np.random.default_rng(0), _Sums()
    track, truth = (0.01 * (rng.normal(size=100) + 1j * rng.normal(size=100)) for _ in range(2))
    breaks = np.zeros(100, dtype=np.int64)
    _stretches(_AtTicks(track, truth, breaks), sums)
    assert sums.squares == {}
    _stretches(_AtTicks(track, truth + np.arange(100.0), breaks), sums)
    assert len(sums.squares["stretch"]) == 3


def test_a_recording_without_errors_has_no_ratio(judged_pair: list[RecordingResult]) -> None:
    """Of a device at rest, for example."""
    first = judged_pair[0]
    perfect = {
        name: replace(found, blocks={key: 0.0 * sums for key, sums in found.blocks.items()})
        for name, found in first.errors.items()
    }
    [row] = rows_of([replace(first, errors=perfect)], "set", "ours", "theirs")
    assert row.ratios == {}


def test_a_judgement_is_written_as_tables_and_figure(
    judged_pair: list[RecordingResult], tmp_path: Path
) -> None:
    rows = rows_of(judged_pair, "set", "ours", "theirs")
    found = JudgingResult("ours", "theirs", rows, judged_pair)
    assert "ratio over 10 s" in judgement_text(found)
    write_judgement(tmp_path, found)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"groups.csv", "recordings.csv", "groups.json", "groups.png"}
    with (tmp_path / "groups.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["weights"] for line in lines] == ["ours", "theirs"]
    assert float(lines[0]["rms_10s_m_low"]) <= float(lines[0]["rms_10s_m_ratio"])
    content = json.loads((tmp_path / "groups.json").read_text())
    assert content["recordings"][1]["truth"] == "waypoints"
    assert (tmp_path / "groups.png").stat().st_size > 10_000
    fresh_folder(tmp_path)  # for a later run
    assert not list(tmp_path.iterdir())


def test_a_group_may_be_called_all(judged_pair: list[RecordingResult]) -> None:
    judged = [
        replace(one, labels=one.labels | {"person": person})
        for one, person in zip(judged_pair, ("a", POOLED), strict=True)
    ]
    rows = rows_of(judged, "person", "ours", "theirs")
    assert [(row.name, row.pooled) for row in rows] == [("a", False), ("all", False), ("all", True)]
    assert verdict(rows).startswith("not decided, 2 groups")
    assert len(groups_figure(rows, "ours", "theirs").axes[0].get_yticks()) == 3
    alone = rows_of(judged[1:], "person", "ours", "theirs")
    assert verdict(alone) == ""
    assert len(groups_figure(alone, "ours", "theirs").axes[0].get_yticks()) == 1


def test_a_wrong_truth_is_warned_of_also_from_the_cache(
    walk: ImuSequence, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    truth = walk.truth
    wrong = replace(walk, truth=replace(truth, position_W=truth.position_W * [-1.0, 1.0, 1.0]))
    path = tmp_path / "walk.csv"
    path.touch()
    for _ in range(2):
        caplog.clear()
        next(prepared_recordings([path], lambda _: wrong, {}, tmp_path / "cache", 1))
        assert "walk: truth: positions mirrored" in caplog.text
