import errno
import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stario.fusion import (
    Comparison,
    FilterConfig,
    NavigatorConfig,
    compare,
    demonstration,
    position_fix,
    summary_table,
)
from stario.fusion.evaluation import compare as compare_module
from stario.fusion.evaluation.compare import TRACKS, distinct_name, measure, measured
from stario.fusion.evaluation.results import (
    RESULTS,
    Files,
    write_comparison,
    write_results,
    write_run,
)
from stario.fusion.evaluation.scores import joined, values
from stario.fusion.evaluation.text import error_words, summary
from stario.sequences.accuracy.metrics import evaluate_track
from stario.sequences.accuracy.nees import position_nees
from stario.sequences.drawing.figures import save_figure
from stario.sequences.errors import InputError
from stario.sequences.files import write_json
from stario.sequences.readers.tum import read_tum
from stario.sequences.sequence import PositionTrack, Trajectory

CONFIG = NavigatorConfig(filter=FilterConfig(update_rate=10, covariance_scale=1.0))
ORIGIN = {"stario": "0.1.0"}
KEYS = {
    *("ate_m", "ate_fit_m", "rte_m", "pde", "aye_rad", "coverage"),
    *("known_positions_m", "nees_median", "nis_mean", "seconds_network", "seconds_filter"),
}


class OracleWithFallback:
    """The oracle for windows that it contains; 1 m along x for all others."""

    def __init__(self, oracle: Any) -> None:
        self.oracle = oracle

    def predict(self, windows):
        try:
            return self.oracle.predict(windows)
        except KeyError:
            n = len(windows)
            return np.tile([1.0, 0.0, 0.0], (n, 1)), np.tile(0.01 * np.eye(3), (n, 1, 1))


@pytest.fixture(scope="module")
def model(walk, make_oracle):
    return OracleWithFallback(make_oracle(walk, walk.truth, CONFIG))


@pytest.fixture(scope="module")
def compared(walk, model):
    return compare(model, walk, CONFIG)


@pytest.fixture(scope="module")
def blind(walk, model):
    time, position = walk.truth.time[::10], walk.truth.position_W[::10, :2]
    waypoints = PositionTrack(time, position + np.array([5.0, -3.0]), "waypoints")
    return compare(model, replace(walk.without_truth(), name="blind", positions=waypoints), CONFIG)


@pytest.fixture(scope="module")
def folder(compared, blind, tmp_path_factory):
    path = tmp_path_factory.mktemp("compare") / "deep" / "out"

    def drawn(figure, path):  # most of the time goes into rendering
        save_figure(figure, path) if path.parts[-2:] == ("blind", "plan.png") else path.touch()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stario.fusion.evaluation.results.save_figure", drawn)
        written = write_comparison(path, [compared, blind], CONFIG, ORIGIN)
    assert sorted(written) == sorted(p for p in path.rglob("*") if p.is_file())
    return path


def test_path_length_is_horizontal_and_covers_only_the_compared_times(compared):
    """The truth rises as in a lift and continues after the IMU data: neither part counts."""
    truth = compared.sequence.truth
    lift = truth.position_W + np.outer(truth.time, [0.0, 0.0, 3.0])
    after = truth.time[-1] + 1.0 + truth.time
    time, attitude_WB = np.concatenate([truth.time, after]), [truth.attitude_WB] * 2
    longer = Trajectory(time, np.tile(lift, (2, 1)), Rotation.concatenate(attitude_WB))
    other = replace(compared, sequence=replace(compared.sequence, truth=longer))
    assert other.path_m == pytest.approx(compared.path_m)


def test_fixes_may_come_from_a_generator(walk, still_model):
    fixes = (position_fix(t, np.zeros(3), np.eye(3)) for t in (5.0, 6.0))
    tracks = compare(still_model, walk, fixes=fixes).tracks
    assert [sum(tracks[name].health.fixes.values()) for name in ("track", "filtered")] == [2, 2]


def test_figures_with_fixes_are_those_after_a_fit(compared):
    sequence, track = compared.sequence, compared.tracks["track"]
    figures = measure(track, sequence, "yaw")
    assert figures["ate_m"] == figures["ate_fit_m"]
    fitted = position_nees(track.trajectory, sequence.truth, "yaw").median
    assert figures["nees_median"] == fitted != compared.metrics["track"]["nees_median"]


def test_waypoints_replace_poses_in_the_error(compared, blind):
    track, truth = compared.tracks["track"].trajectory, compared.sequence.truth
    assert truth is not None
    fitted = evaluate_track(track, truth, alignment="yaw", horizontal=True).ate_m
    error = blind.metrics["track"]["known_positions_m"]
    assert error == pytest.approx(fitted, rel=0.2)
    assert blind.metrics["track"]["ate_m"] is None


def test_metrics_json_has_the_documented_keys_and_null_for_what_is_unknown(folder, walk):
    content = json.loads((folder / "metrics.json").read_text())
    about = {"duration_s", "path_m", "alignment", "horizontal"}
    assert set(content["conventions"]) == KEYS | about
    known, blind = (content["recordings"].pop(name) for name in (walk.name, "blind"))
    assert content["recordings"] == {}
    for entry in (known, blind):
        assert set(entry) == {"duration_s", "path_m", "tracks"}
        assert set(entry["tracks"]) == set(TRACKS)
        assert all(set(figures) == KEYS for figures in entry["tracks"].values())
    assert known["duration_s"] == pytest.approx(20.0)
    horizontal_truth = replace(walk.truth, position_W=walk.truth.position_W * [1.0, 1.0, 0.0])
    assert known["path_m"] == pytest.approx(horizontal_truth.path_length(), rel=0.01)
    assert blind["path_m"] is None
    for figures in blind["tracks"].values():
        some = {"known_positions_m", "nis_mean", "seconds_network", "seconds_filter"}
        assert all(figures[k] is None for k in KEYS - some)
    assert set(blind["tracks"]["network_true_attitude"].values()) == {None}
    assert blind["tracks"]["track"]["nis_mean"] == known["tracks"]["track"]["nis_mean"]
    for name, unknown in (
        ("track", {"known_positions_m"}),
        ("dead_reckoning", {"known_positions_m", "nees_median", "nis_mean"}),
        ("network_true_attitude", {"known_positions_m", "nees_median", "nis_mean"}),
    ):
        assert {k for k, v in known["tracks"][name].items() if v is None} == unknown


def test_a_folder_holds_what_was_measured(folder, compared, walk):
    tracks = json.loads((folder / "metrics.json").read_text())["recordings"][walk.name]["tracks"]
    for name in TRACKS:
        again = evaluate_track(read_tum(folder / walk.name / f"{name}.tum"), walk.truth)
        assert again.ate_m == pytest.approx(tracks[name]["ate_m"], rel=1e-4, abs=1e-6)
        assert again.aye_rad == pytest.approx(tracks[name]["aye_rad"], rel=1e-4, abs=1e-6)
    assert len({track["ate_m"] for track in tracks.values()}) == len(TRACKS)
    with np.load(folder / walk.name / "track.npz", allow_pickle=False) as arrays:
        np.testing.assert_array_equal(arrays["time"], compared.tracks["track"].time)
        n = len(arrays["time"])
        assert arrays["covariance"].shape == (n, 15, 15)
        for name in ("velocity_W", "gyro_bias_B", "accel_bias_B"):
            assert arrays[name].shape == (n, 3)
    figures = {p.name for p in (folder / walk.name).glob("*.png")}
    assert figures == {"plan.png", "error.png", "innovations.png"}
    assert {p.name for p in (folder / "blind").glob("*.png")} == {"plan.png", "innovations.png"}
    assert (folder / "blind/plan.png").stat().st_size > 10_000


@pytest.mark.usefixtures("blank_figures")
def test_files_of_an_earlier_run_do_not_pass_for_those_of_a_later_one(tmp_path, compared, walk):
    track = compared.tracks["track"]
    two = {"track": track, "filtered": compared.tracks["filtered"]}
    write_run(tmp_path, Comparison(walk, two, {name: {} for name in two}), CONFIG, ORIGIN)
    (tmp_path / "report.html").touch()
    (tmp_path / "notes.txt").touch()
    (tmp_path / "truth.tum").touch()  # no result of a run
    blind = Comparison(walk.without_truth(), {"track": track}, {"track": {}})
    files = write_run(tmp_path, blind, CONFIG, ORIGIN)
    mine = {tmp_path / "notes.txt", tmp_path / "truth.tum"}
    assert {*files, *mine} == set(tmp_path.iterdir())


def test_truth_shorter_than_a_window_loses_only_the_true_attitude_track(walk, model, caplog):
    short_truth = replace(walk, truth=walk.truth.slice(3.0, 3.8))
    result = compare(model, short_truth, CONFIG)
    assert set(result.tracks) == {"dead_reckoning", "pdr", "network", "track", "filtered"}
    assert "no track network_true_attitude" in caplog.text
    assert result.metrics["track"]["rte_m"] is None  # it would be extrapolated 75 times


def test_a_recording_with_little_truth_counts_in_no_median(walk, compared):
    little = measured(replace(walk, truth=walk.truth.slice(3.0, 8.0)), compared.tracks)
    whole, part = compared.scores, little.scores.assign(recording="little")
    both = joined([whole, part])
    assert values(part, "coverage").min() == pytest.approx(0.25, abs=0.02)
    assert summary(both)["over_recordings"] == summary(whole)["over_recordings"]
    table = summary_table(both)
    assert "truth of 25%" in table
    assert "truth covers 25%" in error_words(little)
    assert "truth covers less than 50%" in table
    assert "truth of" not in summary_table(whole)


def test_a_truth_that_cannot_be_compared_leaves_the_tracks(walk, compared, caplog):
    later = replace(walk.truth, time=walk.truth.time + 100.0)
    one = replace(walk.truth, valid=np.arange(len(walk.truth)) < 1)
    for truth in (later, one):
        caplog.clear()
        result = measured(replace(walk, truth=truth), compared.tracks)
        assert result.path_m is None
        assert result.metrics["track"]["ate_m"] is None
        assert "no errors are computed" in caplog.text


def test_summary_has_median_and_mean_over_recordings(compared, walk):
    ekf = compared.metrics["track"]
    ate = ekf["ate_m"]
    others = (
        replace(compared, metrics=compared.metrics | {"track": ekf | {"ate_m": error}}).scores
        for error in (3.0, 8.0)
    )
    scores = joined([compared.scores, *(one.assign(recording=k) for k, one in enumerate(others))])
    over_recordings = summary(scores)["over_recordings"]["track"]["ate_m"]
    assert over_recordings["median"] == pytest.approx(3.0)
    assert over_recordings["mean"] == pytest.approx((ate + 11.0) / 3.0)
    table = summary_table(scores)
    lines = table.splitlines()
    assert [line.split()[0] for line in lines[1:6]] == [walk.name, "0", "1", "median", "mean"]
    fitted = compared.metrics["track"]["ate_fit_m"]
    assert f"3.00 ({fitted:.2f})" in lines[4]
    assert "in x and y only" in table


def test_recordings_with_the_same_name_get_distinct_folders():
    taken = set()
    names = [distinct_name(name, taken) for name in ("walk", "walk", "walk-2", "walk", "..")]
    assert names == ["walk", "walk-2", "walk-2-2", "walk-3", "recording"]


def test_demonstration_is_reproducible_with_a_seed_outside_the_training_range():
    first, second = demonstration(), demonstration()
    np.testing.assert_array_equal(first.gyro, second.gyro)
    assert compare_module.DEMONSTRATION_SEED >= 2**31
    assert first.duration == pytest.approx(150.0)


def test_a_wrong_truth_is_warned_of(walk, model, caplog):
    short = walk.slice(0.0, 12.0)
    compare(model, short, CONFIG)
    assert "truth" not in caplog.text
    wrong = replace(short.truth, position_W=1e3 * short.truth.position_W)
    compare(model, replace(short, truth=wrong), CONFIG)
    assert "truth: positions that seem to be in mm" in caplog.text


NAMES = ("metrics.json", "config.json", "run.json", "walk/health.json")


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_text() for path in files}


def files_of(value: int) -> Files:
    return {name: partial(write_json, obj=value) for name in NAMES}


@pytest.mark.parametrize("failing", NAMES)
@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
@pytest.mark.parametrize("earlier", [True, False])
def test_a_run_that_fails_at_any_write_leaves_what_was_there(tmp_path, failing, error, earlier):
    out = tmp_path / "runs/out"
    if earlier:
        write_results(out, files_of(1))
        (out / "notes.txt").write_text("mine")
    before = contents(tmp_path)

    def full(path):
        path.write_text("partial")
        raise error

    with pytest.raises((InputError, KeyboardInterrupt)):
        write_results(out, {**files_of(2), failing: full})
    assert contents(tmp_path) == before
    assert list(tmp_path.rglob("out*")) == ([out] if earlier else [])
    assert (tmp_path / "runs").exists() == earlier


def test_a_later_set_replaces_results_and_removes_those_without_a_successor(tmp_path):
    write_results(tmp_path / "out", files_of(1))
    for name in ("walk/plan.png", "walk/filtered.tum", "walk/notes.txt", "other/health.json"):
        path = tmp_path / "out" / name
        path.parent.mkdir(exist_ok=True)
        path.write_text("1")
    written = write_results(tmp_path / "out", files_of(2))
    assert written == [tmp_path / "out" / name for name in NAMES]
    kept = {"walk/notes.txt": "1", "other/health.json": "1"}
    new = dict.fromkeys(NAMES, "2\n")
    assert contents(tmp_path) == {f"out/{name}": text for name, text in (kept | new).items()}


def test_a_removal_that_fails_is_named_and_can_be_repeated(tmp_path):
    for mark, names in RESULTS.items():
        for name in (mark, *names):
            (tmp_path / name).touch()
    (tmp_path / "network.npz").unlink()
    (tmp_path / "network.npz").mkdir()
    with pytest.raises(InputError, match="npz"):
        write_results(tmp_path, {})
    (tmp_path / "network.npz").rmdir()
    write_results(tmp_path, {})
    assert not list(tmp_path.iterdir())
