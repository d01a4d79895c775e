"""A live recording can be read at any moment, even if the program that wrote it was killed."""

import json
import logging
import os
import signal
import threading
import time
import urllib.request

import numpy as np
import pytest

from stario.fusion import read_fixes
from stario.fusion.fixes import position_fix
from stario.fusion.live import storage
from stario.fusion.live.payload import parse_push
from stario.fusion.live.session import Session
from stario.fusion.live.storage import LiveFile
from stario.sequences import read_recording

SAMPLES = [
    (10**18 + k * 10**7, (0.1 * k, 1 / 3, -2e-5), (1 / 7, 0.01 * k, 9.80665)) for k in range(40)
]


def test_recording_reads_back_exactly_while_it_is_open(tmp_path):
    file = LiveFile(tmp_path / "new", "my phone/..\\x")
    file.append(SAMPLES[:15], 1.7e9)
    file.append(SAMPLES[15:], 1.7e9)
    recording = read_recording(file.path)
    np.testing.assert_array_equal(recording.gyro, [g for _, g, _ in SAMPLES])
    np.testing.assert_array_equal(recording.accel, [a for _, _, a in SAMPLES])
    np.testing.assert_array_equal(recording.time, [k * 10**7 / 1e9 for k in range(40)])
    assert file.path.parent == tmp_path / "new"
    file.close()


def test_recordings_begun_in_the_same_second_do_not_overwrite_each_other(tmp_path):
    files = [LiveFile(tmp_path, "phone") for _ in range(3)]
    assert len({file.path for file in files}) == 3
    for file in files:
        file.close()


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


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL on this system")
def test_a_killed_server_leaves_all_samples_that_it_acknowledged(tmp_path, pushes, process):
    server, url = process
    acknowledged = 0
    for body in pushes(seconds=4.0):
        request = urllib.request.Request(url, body, {"content-type": "application/json"})
        with urllib.request.urlopen(request) as answer:
            acknowledged += json.load(answer)["samples"]
    sender = threading.Thread(target=_push_on, args=(url, pushes(seconds=8.0)[20:]))
    sender.start()
    time.sleep(0.3)
    os.kill(server.pid, signal.SIGKILL)
    server.wait()
    sender.join()
    (path,) = tmp_path.glob("*.csv")
    recording = read_recording(path)
    assert len(recording) >= acknowledged >= 380
    assert (np.diff(recording.time) > 0).all()


def _push_on(url, bodies):
    for body in bodies:
        try:
            urllib.request.urlopen(urllib.request.Request(url, body), timeout=5).close()
        except OSError:
            return


class NearlyFull:
    """A file on a full disk, which writes only a part until `full` is cleared."""

    def __init__(self, file):
        self.file, self.full = file, True

    def write(self, data):
        return self.file.write(data[:100] if self.full else data)

    def __getattr__(self, name):
        return getattr(self.file, name)


def test_a_partial_write_on_a_full_disk_is_undone(tmp_path):
    file = LiveFile(tmp_path, "phone")
    file.append(SAMPLES[:10], 1.7e9)
    file._file = NearlyFull(file._file)
    with pytest.raises(OSError, match="space"):
        file.append(SAMPLES[10:], 1.7e9)
    file._file.full = False
    file.append(SAMPLES[10:], 1.7e9)
    recording = read_recording(file.path)
    np.testing.assert_array_equal(recording.accel, [a for _, _, a in SAMPLES])
    file.close()


def test_a_fix_after_one_that_failed_on_a_full_disk_has_its_header(tmp_path, monkeypatch):
    file, write = LiveFile(tmp_path, "phone"), storage._write_whole

    def full(file, data):
        raise OSError("No space left on device")

    fix = position_fix(1.0, np.zeros(3), np.eye(3))
    monkeypatch.setattr(storage, "_write_whole", full)
    with pytest.raises(OSError, match="space"):
        file.append_fix(fix)
    monkeypatch.setattr(storage, "_write_whole", write)
    file.append_fix(fix)
    file.append_fix(fix)
    assert len(read_fixes(file.fixes_path)) == 2
    file.close()


def test_a_push_that_was_not_written_can_be_repeated(tmp_path, new_navigator, pushes, monkeypatch):
    session = Session("phone", tmp_path, new_navigator)
    *before, second = [parse_push(body) for body in pushes(seconds=2.0)]
    for batch in before:
        session.take(batch, 1.7e9)
    append, failed = LiveFile.append, []

    def full(self, samples, received, fields=()):
        failed.append(len(samples))
        raise OSError("No space left on device")

    monkeypatch.setattr(LiveFile, "append", full)
    with pytest.raises(OSError, match="space"):
        session.take(second, 1.7e9)
    monkeypatch.setattr(LiveFile, "append", append)
    assert session.take(second, 1.7e9) == failed[0] > 0
    assert len(read_recording(session.track.path)) == session.track.samples
    session.close()
