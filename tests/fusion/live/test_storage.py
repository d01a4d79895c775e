import logging
from contextlib import ExitStack, closing, suppress
from dataclasses import replace

import numpy as np
import pytest

from stario.fusion import position_fix, read_fixes
from stario.fusion.live import storage
from stario.fusion.live import track as track_module
from stario.fusion.live.payload import GYRO, parse_push
from stario.fusion.live.session import Session
from stario.fusion.live.storage import LiveFile
from stario.sequences import InputError, read_recording

from .conftest import full_disk

VALUES = [((0.1 * k, 1 / 3, -2e-5), (1 / 7, 0.01 * k, 9.80665)) for k in range(40)]
SAMPLES = [(10**18 + k * 10**7, *pair) for k, pair in enumerate(VALUES)]


def test_recordings_begun_in_the_same_second_do_not_overwrite_each_other(tmp_path):
    with ExitStack() as stack:
        files = [stack.enter_context(closing(LiveFile(tmp_path, "phone"))) for _ in range(3)]
        assert len({file.path for file in files}) == 3


def test_recording_truncated_at_any_byte_keeps_every_complete_sample(tmp_path, caplog):
    file = LiveFile(tmp_path, "phone")
    file.append(SAMPLES, 1.7e9)
    file.close()
    content = file.path.read_bytes()
    caplog.set_level(logging.ERROR)
    third = content.index(b"\n", content.index(b"\n", content.index(b"\n") + 1) + 1)
    last = content[:-1].rindex(b"\n")
    for cut in [*range(third, third + 90), *range(last - 10, len(content))]:  # each a whole row
        file.path.write_bytes(content[:cut])
        whole = content[:cut].count(b"\n") - 1
        recording = read_recording(file.path)
        # Once the last column's comma is written, the line's data are complete.
        assert len(recording) - whole in (0, 1)
        np.testing.assert_array_equal(recording.accel, [a for _, _, a in SAMPLES[: len(recording)]])


class NearlyFull:
    """A file on a disk that becomes full: it writes only a part until `full` is cleared."""

    def __init__(self, file):
        self.file, self.full = file, True

    def write(self, data):
        return self.file.write(data[:100] if self.full else data)

    def __getattr__(self, name):
        return getattr(self.file, name)


def test_a_partial_write_on_a_full_disk_is_undone_and_the_rest_read_at_once(tmp_path):
    file = LiveFile(tmp_path / "new", "my phone/..\\x")
    assert file.path.parent == tmp_path / "new"
    file.append(SAMPLES[:10], 1.7e9)
    size = file.path.stat().st_size
    file._file = NearlyFull(file._file)
    with pytest.raises(OSError, match="space"):
        file.append(SAMPLES[10:], 1.7e9)
    assert file.path.stat().st_size == size
    file._file.full = False
    file.append(SAMPLES[10:], 1.7e9)
    recording = read_recording(file.path)
    np.testing.assert_array_equal(recording.gyro, [g for _, g, _ in SAMPLES])
    np.testing.assert_array_equal(recording.accel, [a for _, _, a in SAMPLES])
    np.testing.assert_array_equal(recording.time, [k * 10**7 / 1e9 for k in range(40)])
    file.close()


def test_nothing_is_left_of_a_header_that_a_full_disk_refused(tmp_path, monkeypatch):
    fix, write = position_fix(1.0, np.zeros(3), np.eye(3)), storage._write_whole
    monkeypatch.setattr(storage, "_write_whole", full_disk)
    with pytest.raises(InputError, match="No space left"):
        LiveFile(tmp_path, "phone")
    assert list(tmp_path.iterdir()) == []
    monkeypatch.setattr(storage, "_write_whole", write)
    file = LiveFile(tmp_path, "phone")
    monkeypatch.setattr(storage, "_write_whole", full_disk)
    with pytest.raises(OSError, match="space"):
        file.append_fix(fix)
    monkeypatch.setattr(storage, "_write_whole", write)
    file.append_fix(fix)
    file.append_fix(fix)
    assert len(read_fixes(file.fixes_path)) == 2
    file.close()


@pytest.fixture
def batches(pushes):
    return [parse_push(body) for body in pushes(seconds=9.0)]


def test_a_gyroscope_in_another_unit_is_shown_though_the_track_begins_again(session, batches):
    shown = []
    for batch in batches:
        degrees = [
            replace(r, value=tuple(np.degrees(r.value))) if r.sensor == GYRO else r
            for r in batch.readings
        ]
        session.take(replace(batch, readings=degrees), 1.7e9)
        shown.append(session.status()["problem"])
    first = next(k for k, problem in enumerate(shown) if problem)
    assert all(shown[first:])


def test_what_a_full_disk_loses_is_counted(session, batches, monkeypatch):
    monkeypatch.setattr(track_module, "_MAX_UNWRITTEN", 100)
    append = LiveFile.append
    monkeypatch.setattr(LiveFile, "append", full_disk)
    for batch in batches[:-1]:
        with suppress(OSError):
            session.take(batch, 1.7e9)
    monkeypatch.setattr(LiveFile, "append", append)
    session.take(batches[-1], 1.7e9)
    written = len(read_recording(session.track.path))
    assert 100 < written == session.track.samples < 150
    assert session.status()["dropped"] == {"not written": 900 - written}


def test_a_recording_that_never_gives_a_position_says_why(session, batches):
    """Bursts of 0.8 s every 1.4 s: no second of samples from which to level the attitude."""
    for k in range(0, 44, 4):
        for n, batch in enumerate(batches[k : k + 4]):
            late = 600_000_000 * (k // 4)
            readings = [replace(r, time_ns=r.time_ns + late) for r in batch.readings]
            session.take(replace(batch, readings=readings, number=k + n), 1.7e9)
    assert session.track.drawn.points == []
    assert "no position" in session.status()["problem"]
    assert any("gaps" in word["text"] for word in session.status()["health"])


@pytest.mark.parametrize(
    ("kept", "words"),
    [
        (lambda k, r: r.sensor == GYRO or r.time_ns % (10**9 // 5) == 0, "log both at 50 Hz"),
        (lambda k, r: r.sensor != GYRO or k < 15, "no samples of gyroscope for 5 s"),
    ],
)
def test_a_sensor_that_is_slow_or_stops_is_shown(session, batches, kept, words):
    for k, batch in enumerate(batches):
        if k == 15 and "gyroscope" in words:
            assert session.status()["problem"] == ""
        readings = [reading for reading in batch.readings if kept(k, reading)]
        session.take(replace(batch, readings=readings), 1.7e9)
    assert words in session.status()["problem"]


def test_an_unwritable_folder_is_shown(tmp_path, new_navigator, batches):
    (tmp_path / "file").touch()
    session = Session("phone", tmp_path / "file", new_navigator)
    assert session.take(batches[0], 1.7e9) == 0
    longer = replace(batches[1], readings=[r for batch in batches[1:9] for r in batch.readings])
    with pytest.raises(InputError, match="writable"):
        session.take(longer, 1.7e9)
    assert "a writable folder" in session.status()["problem"]
