"""A sensor that stops and a full disk are shown on the page, and cost no memory."""

from dataclasses import replace

import numpy as np
import pytest

from stario.fusion.live import storage
from stario.fusion.live import track as track_module
from stario.fusion.live.payload import GYRO, parse_push
from stario.fusion.live.session import Session
from stario.fusion.live.storage import LiveFile
from stario.sequences import InputError, read_recording


@pytest.fixture
def session(tmp_path, new_navigator):
    session = Session("phone", tmp_path, new_navigator)
    yield session
    session.close()


@pytest.fixture
def batches(pushes):
    return [parse_push(body) for body in pushes(seconds=9.0)]


def test_a_gyroscope_that_stops_is_shown(session, batches):
    for batch in batches[:15]:
        session.take(batch, 1.7e9)
    assert session.status()["problem"] == ""
    for batch in batches[15:]:
        others = [reading for reading in batch.readings if reading.sensor != GYRO]
        session.take(replace(batch, readings=others), 1.7e9)
    assert "no samples of gyroscope for 5 s" in session.status()["problem"]


def test_a_gyroscope_in_another_unit_is_shown_though_the_track_begins_again(session, pushes):
    batches = [parse_push(body) for body in pushes()]
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


def test_a_full_disk_is_shown_until_it_has_space_and_what_is_lost_is_counted(
    session, batches, monkeypatch
):
    append, attempts = LiveFile.append, []

    def full(self, samples, received, fields=()):
        attempts.append(len(samples))
        raise OSError("No space left on device")

    monkeypatch.setattr(track_module, "_MAX_UNWRITTEN", 100)
    monkeypatch.setattr(LiveFile, "append", full)
    for batch in batches[:-1]:
        try:
            session.take(batch, 1.7e9)
        except OSError:
            assert "No space left" in session.status()["problem"]
    assert max(attempts) < 150
    monkeypatch.setattr(LiveFile, "append", append)
    session.take(batches[-1], 1.7e9)
    assert session.status()["problem"] == ""
    written = len(read_recording(session.track.path))
    assert 100 < written == session.track.samples
    assert session.status()["dropped"] == {"not written": 900 - written}


def test_a_recording_that_never_gives_a_position_says_why(session, batches):
    """Bursts of 0.8 s every 1.4 s: no second of samples from which to level the attitude."""
    for k in range(0, 44, 4):
        for n, batch in enumerate(batches[k : k + 4]):
            late = 600_000_000 * (k // 4)
            readings = [replace(r, time_ns=r.time_ns + late) for r in batch.readings]
            session.take(replace(batch, readings=readings, number=k + n), 1.7e9)
    assert session.track.drawn.points == []
    assert session.status()["problem"].startswith("no position so far")
    assert any("gaps in the samples" in word["text"] for word in session.status()["health"])


def test_an_accelerometer_too_slow_to_interpolate_is_named(session, batches):
    for batch in batches[:25]:
        accel = [r for r in batch.readings if r.sensor != GYRO][:1]  # 5 Hz
        gyro = [r for r in batch.readings if r.sensor == GYRO]
        session.take(replace(batch, readings=gyro + accel), 1.7e9)
    assert "log both at 50 Hz" in session.status()["problem"]


def test_an_unwritable_folder_is_shown(tmp_path, new_navigator, batches):
    (tmp_path / "file").touch()
    session = Session("phone", tmp_path / "file", new_navigator)
    assert session.take(batches[0], 1.7e9) == 0
    longer = replace(batches[1], readings=[r for batch in batches[1:9] for r in batch.readings])
    with pytest.raises(InputError, match="a writable folder"):
        session.take(longer, 1.7e9)
    assert "a writable folder" in session.status()["problem"]


def test_a_file_without_space_for_its_header_is_removed(tmp_path, monkeypatch):
    def full(file, data):
        raise OSError("No space left on device")

    monkeypatch.setattr(storage, "_write_whole", full)
    with pytest.raises(InputError, match="No space left"):
        LiveFile(tmp_path, "phone")
    assert list(tmp_path.iterdir()) == []
