"""A device that has been silent for long makes room for another."""

import asyncio
from dataclasses import replace

import pytest

from stario.fusion.live.hub import MAX_DEVICES, SILENT_SECONDS, Viewer
from stario.fusion.live.payload import parse_push
from stario.sequences import InputError, read_recording


@pytest.fixture
def full(hub, pushes):
    """A hub with as many devices as it may have, and a function that sends two seconds of one."""
    batches = [parse_push(body) for body in pushes(seconds=2.0)]

    def send(device):
        for batch in batches:
            asyncio.run(hub.take(replace(batch, device=device)))

    for k in range(MAX_DEVICES):
        send(f"phone{k}")
    return hub, send


def test_the_device_silent_longest_makes_room_and_its_recording_is_closed(full):
    hub, send = full
    viewer = Viewer(hub)
    viewer.message()
    for k, silent in ((3, 1.5), (5, 2.0)):
        hub.sessions[f"phone{k}"].received -= silent * SILENT_SECONDS
    evicted = hub.sessions["phone5"]
    send("another")
    assert "phone5" not in hub.sessions
    assert len(hub.sessions) == MAX_DEVICES
    assert evicted.track._file._file.closed
    assert len(read_recording(evicted.track.path)) == 200
    send("phone5")  # the other silent one makes room
    assert "phone3" not in hub.sessions
    sent = {device["id"]: device for device in viewer.message()["devices"]}
    assert sent["phone5"]["fresh"]


def test_no_device_that_sends_makes_room_even_if_stopped(full):
    hub, send = full
    asyncio.run(hub.command("phone5", "stop"))
    with pytest.raises(InputError, match="at most 16"):
        send("another")
    assert len(hub.sessions) == MAX_DEVICES


def test_a_recording_whose_end_cannot_be_written_makes_room_too(full, monkeypatch, caplog):
    hub, send = full
    silent = hub.sessions["phone5"]
    silent.received = 0.0
    silent.close()

    def no_space():
        raise OSError("No space left on device")

    monkeypatch.setattr(silent, "close", no_space)
    send("another")
    assert "another" in hub.sessions
    assert "the end of its recording is lost" in caplog.text
