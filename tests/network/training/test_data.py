from dataclasses import replace
from itertools import chain
from pathlib import Path

import h5py
import numpy as np
import pytest

from stario.network.training.config import INSERTED, SIMULATED, TrainingConfig
from stario.network.training.data import (
    RecordingStreams,
    TrainingData,
    mix_sources,
    recording_streams,
    split_off,
)
from stario.network.training.made import moment_streams, virtual_recordings
from stario.sequences import STANDARD_GRAVITY, Skipped, WorldStream, generate_walk
from stario.sequences.errors import ConfigError, InputError
from stario.sequences.readers.archive import write_archive
from stario.sequences.simulation.imu import PERFECT_IMU, PHONE_IMU, simulate_imu


def stream(name: str, samples: int) -> WorldStream:
    count = np.arange(samples, dtype=np.float32)[:, None]
    six, three, two = (count + np.zeros(k, np.float32) for k in (6, 3, 2))
    return WorldStream(name, six, three, two)


def test_the_last_fifth_of_each_recording_is_held_out():
    recordings = recordings_of([stream("a", 6000), stream("a", 4000)], [stream("b", 5000)], [])
    first, last = (list(chain(*(r.streams for r in part))) for part in split_off(recordings))
    assert [(s.name, len(s)) for s in first] == [("a", 6000), ("a", 2000), ("b", 4000)]
    assert [(s.name, len(s)) for s in last] == [("a", 2000), ("b", 1000)]
    assert last[0].imu_W[0, 0] == 2000  # where the first part ends
    first, last = split_off(recordings_of([stream("a", 1500)]))
    assert [len(s) for s in first[0].streams] == [1200]
    assert not last[0].streams  # too short for windows
    assert first[0].has_poses
    assert not last[0].has_poses


def test_streams_are_drawn_alike_unless_they_have_a_weight_or_more_motion():
    streams = [stream("a", 3000), stream("b", 1000)]
    assert drawn_shares(TrainingData(streams)) == pytest.approx({"a": 0.75, "b": 0.25})
    assert drawn_shares(TrainingData(streams, np.array([1.0, 3.0])))["a"] == pytest.approx(0.5)
    with pytest.raises(InputError, match="weights: found 1, expected 2"):
        TrainingData(streams, [1.0])
    calm, lively = moving("calm", 0.5), moving("lively", 1.5)
    material = mix_sources(recordings_of([calm], [lively]), [])
    assert material.weights[1] / material.weights[0] == pytest.approx(3.0, rel=1e-3)
    assert sum(material.weights) * len(calm) / 200.0 == pytest.approx(0.6)


def drawn_shares(material: TrainingData, reach: int = 1) -> dict[str, float]:
    found: dict[str, float] = {}
    for one, weight in zip(material.streams, material.weights, strict=True):
        starts = max(0, len(one) - reach + 1)
        found[one.name] = found.get(one.name, 0.0) + weight * starts
    return {name: value / sum(found.values()) for name, value in found.items()}


LONG, SHORT = "a/long.h5:x", "a/short.h5:y"


@pytest.mark.parametrize(
    ("paths", "shares", "expected"),
    [
        ([LONG, SHORT, "z.csv"], {"long.h5": 0.5, "short.h5": 0.3}, {"x": 0.5, "y": 0.3, "z": 0.2}),
        ([LONG], {SIMULATED: 0.05}, {"x": 0.95, "simulated": 0.05}),
        ([LONG], {SIMULATED: 0.2, INSERTED: 0.1}, {"x": 0.7, "simulated": 0.2, "moments": 0.1}),
        # The share of an absent source goes to the other recordings.
        ([LONG, "z.csv"], {"long": 0.2, "kipd": 0.5, SIMULATED: 0.1},
         {"x": 0.36, "z": 0.54, "simulated": 0.1}),
        ([LONG], {"long": 0.2, "kipd": 0.5, SIMULATED: 0.1}, {"x": 0.9, "simulated": 0.1}),
    ],
)  # fmt: skip
def test_named_sources_get_their_shares_whatever_their_length(paths, shares, expected):
    names = {LONG: ["x"] * 9, SHORT: ["y"], "z.csv": ["z"]}
    recorded = [
        RecordingStreams(Path(path), [moving(name, 1.0) for name in names[path]]) for path in paths
    ]
    made = [moving("simulated", 1.0).part(0, 700)] if SIMULATED in shares else []
    moments = [moving("moments", 1.0)] if INSERTED in shares else []
    found = drawn_shares(mix_sources(recorded, made, shares, moments=moments))
    assert found == pytest.approx(expected)


@pytest.mark.parametrize(
    ("source", "path"),
    [
        ("ridi", "/data/archives/ridi.h5:dan_body1"),
        ("ridi.h5", "archives/ridi.h5:dan_body1"),
        ("archives", "archives/ridi.h5:dan_body1"),
        ("dan_body1", "archives/ridi.h5:dan_body1"),
        ("ridi", "/data/ridi/dan.csv"),
        ("ridi/dan", "/data/ridi/dan.csv"),
        ("walk", "walk.csv"),
    ],
)
def test_a_source_is_named_by_a_folder_an_archive_or_a_file(source, path):
    """Not by a part of such a name: somebody's home may be called /home/ridi-user."""
    other = RecordingStreams(Path("/home/ridi-user/walks/my-archives/x.csv"), [moving("z", 1.0)])
    recorded = [RecordingStreams(Path(path), [moving("x", 1.0)]), other]
    assert drawn_shares(mix_sources(recorded, [], {source: 0.2})) == pytest.approx(
        {"x": 0.2, "z": 0.8}
    )


def test_shares_count_the_windows_that_can_be_drawn():
    """Stretches hardly longer than a window hold few windows, which are drawn more often."""
    whole = moving("y", 1.0)
    recorded = [
        RecordingStreams(Path("a/ridi.h5:x"), [moving("x", 1.0)]),
        RecordingStreams(Path("a/kipd.h5:y"), [whole.part(0, 420)] * 5),
        RecordingStreams(Path("a/tyrex.h5:w"), [moving("w", 1.0).part(0, 300)]),
    ]
    shares = {"ridi": 0.3, "kipd": 0.3, "tyrex": 0.4}
    found = drawn_shares(mix_sources(recorded, [], shares, reach=361), reach=361)
    assert found == {"x": pytest.approx(0.5), "y": pytest.approx(0.5), "w": 0.0}


def test_shares_that_leave_nothing_are_refused():
    recorded, made = recordings_of([moving("x", 1.0)]), [moving("c", 1.0)]
    for given, recordings, generated, words in (
        ({SIMULATED: 1.0}, recorded, [], "found 0 for every"),
        ({SIMULATED: 0.0}, [], made, "found 0 for every"),
        ({"0": 1.0}, recordings_of([moving("x", 1.0)], [moving("z", 1.0)]), [], ""),
        ({SIMULATED: 0.4, INSERTED: 0.7}, recorded, [], r"1\.1 for simulated walks and moments"),
    ):
        with pytest.raises(ConfigError, match=f"shares: .*{words}"):
            mix_sources(recordings, generated, given, moments=made if INSERTED in given else [])
    with pytest.raises(ConfigError, match=r"shares: found a sum of 1\.2"):
        TrainingConfig(shares={"ridi": 0.6, "kipd": 0.6})
    TrainingConfig(shares={"ridi": 0.7, "kipd": 0.2, "tyrex": 0.1, SIMULATED: 0.5})


def test_streams_come_with_the_licence_of_their_archive_and_names_of_their_own(tmp_path):
    walk = simulate_imu(generate_walk(0, 4.0), 100.0, PERFECT_IMU, 0, name="walk")
    licensed = replace(walk, attributes={"licence": "CC BY 4.0"})
    write_archive(tmp_path / "walks.h5", [licensed])
    paths = [Path(f"{tmp_path / 'walks.h5'}:walk"), Path("other.csv"), Path("bad.csv")]
    outcomes = [[moving("walk", 1.0)], [moving("other", 1.0)], Skipped("bad.csv", "broken")]
    found, skipped = recording_streams(zip(paths, outcomes, strict=True))
    assert [(one.path, one.licence) for one in found] == [(paths[0], "CC BY 4.0"), (paths[1], "")]
    assert skipped == outcomes[2:]
    assert mix_sources(found, []).words[-1] == "walks.h5, licence CC BY 4.0: 1 recordings, 10 s"
    # Their errors would be averaged as those of one recording.
    outcomes = [[moving("walk", speed)] for speed in (1.0, 2.0, 3.0)]
    paths = [Path(f"{k}/walk.csv") for k in range(3)]
    found, _ = recording_streams(zip(paths, outcomes, strict=True))
    assert [one.streams[0].name for one in found] == ["walk", "walk-2", "walk-3"]


def recordings_of(*recordings: list[WorldStream]) -> list[RecordingStreams]:
    return [RecordingStreams(Path(str(k)), streams) for k, streams in enumerate(recordings)]


def moving(name: str, acceleration: float) -> WorldStream:
    imu_W = np.zeros((2000, 6), np.float32)
    imu_W[:, 3], imu_W[:, 5] = acceleration, STANDARD_GRAVITY
    return WorldStream(name, imu_W, np.zeros((2000, 3), np.float32), np.ones((2000, 2), np.float32))


def test_every_clip_of_motion_capture_has_devices_with_a_share_and_a_licence(tmp_path):
    file = tmp_path / "capture.h5"
    with h5py.File(file, "w") as written:
        for name, frames in (("long", 150), ("short", 40)):
            group = written.create_group(name)
            group.attrs.update({"rate": 50.0, "licence": "CC BY 4.0"})
            group.attrs["joints"] = ["hips", "l_thigh", "r_thigh", "l_foot", "r_foot"]
            ahead = np.array([0, 250, 0])  # in 0.1 mm per frame: 1.25 m/s
            group["position_first"] = 10 * np.array(
                [[0, 0, 950], [-100, 0, 900], [100, 0, 900], [-100, 0, 80], [100, 0, 80]], np.int32
            )
            group["position_step"] = np.tile(ahead, (frames, 5, 1)).astype(np.int16)
            group["quaternion"] = np.tile([0, 0, 0, 32767], (frames, 5, 1)).astype(np.int16)

    found = virtual_recordings([file], 1, tmp_path / "cache")

    assert [recording.path.name for recording in found] == ["capture.h5:long"]  # 0.8 s is too short
    assert len({s.name for s in found[0].streams}) == 2  # belt and back pocket: no other joints
    for one in found[0].streams:
        moved = np.hypot(*one.position_W[-1, :2])
        assert moved == pytest.approx(1.25 * len(one) / 200, abs=0.1)
    drawn = drawn_shares(
        mix_sources(
            [*recordings_of([stream("a", 900)]), *found], [], {"capture.h5": 0.3, SIMULATED: 0.0}
        )
    )
    assert drawn["a"] == pytest.approx(0.7)
    words = mix_sources(found, [], {"capture.h5": 0.3}).words
    assert any("capture.h5, licence CC BY 4.0" in word for word in words)


# --- inserted moments -----------------------------------------------------------------------------


WALK = simulate_imu(generate_walk(5, 50.0), 100.0, PHONE_IMU, 5, name="walk")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "walk.csv"
    path.write_text("read by the test")
    return path


def test_a_moment_turns_the_device_and_moves_it_by_no_more_than_a_hand_reaches(recording, tmp_path):
    found = moment_streams([recording] * 8, lambda path: WALK, {}, 3, tmp_path / "cache")
    assert found
    rates = [np.linalg.norm(stream.imu_W[:, :3], axis=1).max() for stream in found]
    assert max(rates) > 12.0 > np.linalg.norm(WALK.gyro, axis=1).max()
    for stream in found:
        middle = len(stream) // 2
        inside = stream.position_W[middle - 400 : middle + 400]
        assert np.ptp(inside[:, :2], axis=0).max() < 1.0
        force = np.linalg.norm(stream.imu_W[:, 3:], axis=1)
        assert force.mean() == pytest.approx(STANDARD_GRAVITY, rel=0.2)


def test_the_last_fifth_and_recordings_without_poses_have_no_moments(recording, tmp_path):
    start = WALK.time[0] + 0.8 * (WALK.time[-1] - WALK.time[0])
    of_the_end = WALK.truth.select(WALK.truth.time > start)
    for number, truth in enumerate((of_the_end, None)):
        cache = tmp_path / str(number)
        read = replace(WALK, truth=truth)
        assert not moment_streams([recording], lambda path, read=read: read, {}, 3, cache)
