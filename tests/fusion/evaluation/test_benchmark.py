import csv
import json
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from recorded import DATA
from scipy.spatial.transform import Rotation

from stario.fusion.evaluation.displacement_error import (
    known_truth,
    recording_errors,
    usable_streams,
)
from stario.fusion.evaluation.groups import (
    RATIOS,
    alone_on,
    benchmark,
    groups_figure,
    labels,
    verdict,
    write_benchmark,
)
from stario.fusion.evaluation.pedestrian import Model, PedestrianDeadReckoning, piece_of
from stario.fusion.evaluation.scores import POOLED, values
from stario.sequences.attitude.rotations import yaw_of
from stario.sequences.errors import InputError
from stario.sequences.readers import read_recording
from stario.sequences.sequence import ImuSequence, PositionTrack
from stario.sequences.simulation.imu import PERFECT_IMU, simulate_imu
from stario.sequences.simulation.walks import WalkStyle, generate_walk

streams_of = cache(usable_streams)


def with_known(walk: ImuSequence, time: np.ndarray, kind="positions", jump=0.0) -> ImuSequence:
    """The walk with positions at these times instead of poses, which jump after 40 s."""
    position_W = walk.truth.at(time).position_W + np.where(time > 40.0, jump, 0.0)[:, None]
    known = position_W[:, :2] if kind == "waypoints" else position_W
    return replace(walk, truth=None, positions=PositionTrack(time, known, kind))


def with_waypoints(walk: ImuSequence, every: float = 8.0) -> ImuSequence:
    return with_known(walk, np.arange(1.0, 70.0, every), "waypoints")


class Stub:
    """Predictor of the true displacements of successive windows, scaled and rotated."""

    def __init__(self, walk: ImuSequence, scale: float = 1.0, yaw: float = 0.0) -> None:
        [stream] = streams_of(walk)
        known = walk.truth.at(stream.ticks).position_W[:, :2] @ [1.0, 1j]
        R_NB = Rotation.from_matrix(stream.R_NB)
        attitude_WN = walk.truth.at(stream.ticks).attitude_WB * R_NB.inv()
        steps = np.exp(-1j * yaw_of(attitude_WN)[:-2]) * (known[2:] - known[:-2])
        steps = scale * np.exp(1j * yaw) * steps[: stream.window_count]
        steps = np.pad(steps, (0, stream.window_count - len(steps)), "edge")
        steps = np.exp(-1j * stream.headings) * steps  # in the windows' frames
        self.displacement_H = np.stack([steps.real, steps.imag, 0.0 * steps.real], axis=1)
        self.served = 0

    def predict(self, windows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first, self.served = self.served, self.served + len(windows)
        covariance = np.broadcast_to(0.01 * np.eye(3), (len(windows), 3, 3))
        return self.displacement_H[first : self.served], covariance


def errors_of(recording: ImuSequence, model: Model) -> tuple[dict[str, float], pd.DataFrame]:
    return recording_errors(recording, [piece_of(model, s) for s in streams_of(recording)])


def horizontal_path(walk: ImuSequence) -> float:
    truth = walk.truth
    return truth.path_length()


STYLE = WalkStyle(carry="trolley")  # without sway, which windows that overlap smooth


@pytest.fixture(scope="session")
def walk():
    return simulate_imu(generate_walk(9, 75.0, style=STYLE), 100.0, PERFECT_IMU, 3, name="walk")


@pytest.fixture(scope="session")
def stepping():
    """A person's walk, whose steps can be seen."""
    return simulate_imu(generate_walk(9, 75.0), 100.0, PERFECT_IMU, 3, name="steps")


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


def test_with_positions_yaw_is_fitted_and_nothing_is_compared_across_jumps_and_gaps(walk):
    time = walk.truth.time
    slow, gone = np.arange(1.0, 74.0), (time < 5.0) | ((time > 35.0) & (time < 45.0))
    (smooth, all_of_them), (jumped, after_jump), (gapped, after_gap), (at_1_hz, _) = (
        errors_of(with_known(walk, at, jump=jump), Stub(walk, 0.9, yaw=2.0))
        for at, jump in ((time, 0.0), (time, 9.0), (time[~gone], 0.0), (slow, 0.0))
    )
    for found, rel in ((smooth, 1e-9), (jumped, 0.3), (gapped, 0.3), (at_1_hz, 0.05)):
        assert found["length_ratio"] == pytest.approx(0.9, abs=0.02)
        assert found["rms_10s_m"] == pytest.approx(smooth["rms_10s_m"], rel=rel)
        assert found["stretch_percent"] < 5.0
        assert np.isnan(found["ate_fit_m"])
    all_blocks = all_of_them, after_jump, after_gap
    counts = (blocks.groupby("metric")["count"].sum() for blocks in all_blocks)
    whole, *fewer = (count["rms_10s_m"] for count in counts)
    assert max(fewer) < whole
    assert fewer[1] < whole - 2 * 15  # no window of 10 s in 15 s, two a second


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


@pytest.mark.skipif(not DATA.exists(), reason=f"no recordings at {DATA}")
@pytest.mark.parametrize(
    ("name", "kind", "path_m", "error"),
    [
        ("kipd.h5:yk_01", "poses", 127.4, "ate_fit_percent"),
        ("rocip.h5:r4", "positions", 290.3, "stretch_percent"),
        ("ilc.h5:site2_F1_5dd35c7527889b0006b76852", "waypoints", 65.2, "ate_fit_percent"),
    ],
)
def test_pedestrian_dead_reckoning_is_near_the_truth_on_real_recordings(name, kind, path_m, error):
    recording = read_recording(Path(f"{DATA}/archives/{name}"))
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


def judged(recordings: Mapping[str, ImuSequence], models: dict[str, Any], by="set", groups=None):
    """Compare networks that functions make for a group, by the name of the weights."""
    found = []
    for name, recording in recordings.items():
        path, group = Path(name), (groups or {}).get(name, "")
        found.append(alone_on(recording, path, group, lambda name, g: models[name](g), models))
    return benchmark(found, by, *models)


def of_person(recording: ImuSequence, person: str) -> ImuSequence:
    return replace(recording, attributes={"person": person})


@pytest.fixture(scope="module")
def pair(walk):
    recordings = {"one": of_person(walk, "a"), "two": of_person(with_waypoints(walk), "b")}
    scales = {"walks a": 0.95, "walks b": 0.9}
    models = {"ours": lambda name: Stub(walk, scales[name]), "theirs": lambda _: Stub(walk, 0.8)}
    return judged(recordings, models, "person", {"one": "walks a", "two": "walks b"})


def test_a_recording_without_truth_is_refused_and_a_wrong_truth_warned_of(stepping, caplog):
    mirrored = stepping.truth.position_W * [-1.0, 1.0, 1.0]
    wrong = replace(stepping, truth=replace(stepping.truth, position_W=mirrored))
    models = {"ours": lambda group: Stub(stepping)}
    judged({"wrong": wrong}, models)
    assert "steps: truth: positions mirrored" in caplog.text
    with pytest.raises(InputError, match="truth"):
        judged({"blind": stepping.without_truth()}, models)


def test_a_recording_with_two_waypoints_is_named_as_not_compared(walk, caplog):
    few, enough = with_waypoints(walk, 50.0), with_waypoints(walk)
    models = {"ours": lambda group: Stub(walk)}
    found = judged({"50": few, "8": enough}, models)
    [alone] = caplog.messages
    assert alone.startswith("50: not compared")
    assert (values(found.scores, "path_m") > 0.0).tolist() == [False, True]
    caplog.clear()
    judged({"50": few, "third": few}, models)
    [both] = caplog.messages
    assert both.startswith("2 of 2 recordings, the first 50")


@pytest.mark.parametrize("kind", ["poses", "positions"])
def test_a_device_at_rest_counts_in_no_median_or_ratio(walk, caplog, kind):
    """Its errors relative to its path, the noise of its truth, would be a thousand percent."""
    still = 1e-4 * np.random.default_rng(0).normal(size=walk.truth.position_W.shape)
    resting = replace(walk, name="rest", truth=replace(walk.truth, position_W=still))
    if kind == "positions":
        resting = with_known(resting, walk.truth.time)

    models = {"ours": lambda group: Stub(walk), "theirs": lambda group: Stub(walk, 0.8)}
    found, walking = judged({"walk": walk, "rest": resting}, models), judged({"walk": walk}, models)
    assert "rest: not compared" in caplog.text
    both, alone = (part.rows.iloc[-1] for part in (found, walking))
    assert str(both) == str(alone)  # some are NaN
    assert both["recordings"] == 1


def test_stretches_at_rest_have_no_error_relative_to_their_path(walk):
    """After half a minute the truth is but noise: errors would be half of its path."""
    late, position_W = walk.truth.time > 30.0, walk.truth.position_W.copy()
    noise = 1e-4 * np.random.default_rng(0).normal(size=(late.sum(), 3))
    position_W[late] = position_W[late][0] + noise
    halting = replace(walk, truth=replace(walk.truth, position_W=position_W))
    found, _ = errors_of(with_known(halting, walk.truth.time), Stub(halting, 0.9))
    assert 1.0 < found["stretch_percent"] < 5.0


def test_rows_compare_weights_by_group_and_pooled(walk, pair):
    rows = pair.rows.set_index(["group", "weights"])
    assert list(rows.index.unique("group")) == ["a", "b", "all"]
    a, b, pooled = (rows.loc[name, "ours"] for name in ("a", "b", "all"))
    assert a["ratio_1s"].ratio == pytest.approx(0.25, rel=0.01)
    assert b["ratio_10s"].ratio == pytest.approx(0.5, abs=0.05)
    assert (b["ratio_1s"], b["ratio_30s"]) == (None, None)
    assert pooled["ratio_10s"].ratio == pytest.approx(np.sqrt(0.25 * 0.5), abs=0.04)
    assert a["path_km"] == pytest.approx(1e-3 * horizontal_path(walk), rel=0.05)
    assert rows.loc[("a", "theirs"), "length_ratio"] == pytest.approx(0.8, abs=0.02)


def test_without_a_list_intervals_are_drawn_over_the_persons_of_an_archive(walk):
    """Over recordings alone, those of one person would pass for those of many."""
    scales = {"r.h5:1": ("a", 0.95), "r.h5:2": ("b", 0.9), "r.h5:3": ("b", 0.9)}
    recordings = {name: of_person(walk, person) for name, (person, _) in scales.items()}
    by_group = {f"r {person}": scale for person, scale in scales.values()}
    models = {"ours": lambda name: Stub(walk, by_group[name]), "theirs": lambda _: Stub(walk, 0.8)}
    pooled = judged(recordings, models, "person").rows.iloc[-1]
    # Persons have equal weights.
    assert pooled["ratio_1s"].ratio == pytest.approx(np.sqrt(0.25 * 0.5), rel=0.01)


def test_a_file_named_without_its_folder_belongs_to_the_set_of_that_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert labels(Path("walk.csv"), {})["set"] == tmp_path.name


def test_a_recording_without_errors_has_no_ratio(pair):
    """Of a device at rest, for example."""
    perfect = replace(pair, by="set", blocks=pair.blocks.assign(squares=0.0))
    assert perfect.rows[[*RATIOS]].isna().all(axis=None)


def test_a_benchmark_is_written_as_tables_and_figure(pair, tmp_path):
    found = replace(pair, by="set")
    assert "ratio over 10 s" in found.text()
    write_benchmark(tmp_path, found)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"groups.csv", "recordings.csv", "groups.json", "groups.png"}
    with (tmp_path / "groups.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert [line["weights"] for line in lines] == ["theirs", "ours"]
    assert float(lines[1]["ratio_10s_low"]) <= float(lines[1]["ratio_10s_ratio"])
    content = json.loads((tmp_path / "groups.json").read_text())
    assert content["recordings"][-1]["truth"] == "waypoints"
    assert (tmp_path / "groups.png").stat().st_size > 10_000


def test_a_group_may_be_called_all(pair):
    named = pair.scores.assign(person=pair.scores["person"].replace("b", POOLED))
    found = replace(pair, scores=named)
    ours = found.rows[found.rows["role"] == "ours"]
    assert ours["group"].to_list() == ["a", "all", "all"]
    assert ours["pooled"].to_list() == [False, False, True]
    assert verdict(found.rows).startswith("not decided, 2 groups")
    assert len(groups_figure(found).axes[0].get_yticks()) == 3
    alone = replace(found, scores=named[named["person"] == POOLED])
    assert verdict(alone.rows) == ""
    assert len(groups_figure(alone).axes[0].get_yticks()) == 1
