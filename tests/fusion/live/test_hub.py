"""Devices of the server, and what is drawn of their tracks."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stario.fusion.live import hub as hub_module
from stario.fusion.live.drawn import DisplayedTrack, point_of
from stario.fusion.live.hub import MAX_DEVICES, SILENT_SECONDS, Viewer
from stario.fusion.live.payload import parse_push
from stario.fusion.state import NavState
from stario.sequences import InputError, read_recording
from stario.sequences.attitude.rotations import about_z


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


def state(time=0.0, yaw=0.2, p_W=(1.0, 2.0, 3.0)):
    covariance = np.diag([0.1, 0.1, 0.04, *[0.1] * 3, 4.0, 1.0, 0.5, *[0.1] * 6])
    R_WB, zero = about_z(yaw).as_matrix(), np.zeros(3)
    return NavState(time, R_WB, np.array([0.6, 0.8, 0.0]), np.array(p_W), zero, zero, covariance)


def test_a_point_holds_position_speed_yaw_covariance_and_sigma_of_yaw():
    yaw, sigma = np.degrees([0.2, 0.2])
    expected = [0.0, 1.0, 2.0, 3.0, 1.0, yaw, 4.0, 0.0, 1.0, sigma, 0.5, 2.5]
    np.testing.assert_allclose(point_of(state(), np.array([0.5, 2.5, 3.0])), expected, atol=1e-5)


def test_a_new_map_frame_rotates_position_yaw_and_covariance_together():
    track, turn, shift = DisplayedTrack(), about_z(0.5), np.array([5.0, -3.0, 1.0])
    track.add(state(), np.array([0.5, 2.5, 3.0]))
    before, after = state(1.0, 0.9, (7.0, 7.0, 3.0)), state(1.0, 1.4)
    after.p_W[:] = turn.apply(before.p_W) + shift
    track.move(before, after)
    [point] = track.points
    np.testing.assert_allclose(point[1:4], turn.apply([1.0, 2.0, 3.0]) + shift, atol=1e-4)
    np.testing.assert_allclose(point[10:], (turn.apply([0.5, 2.5, 3.0]) + shift)[:2], atol=1e-4)
    assert point[5] == pytest.approx(np.degrees(0.2 + 0.5), abs=1e-3)
    R = turn.as_matrix()[:2, :2]
    np.testing.assert_allclose(
        [[point[6], point[7]], [point[7], point[8]]], R @ np.diag([4.0, 1.0]) @ R.T, atol=1e-4
    )


@pytest.mark.parametrize("most", [7, 1000])
def test_a_new_viewer_gets_no_more_points_than_a_message_may_hold(hub, pushes, monkeypatch, most):
    session = hub._session("phone")
    for body in pushes(seconds=4.0):
        session.take(parse_push(body), 0.0)
    monkeypatch.setattr(hub_module, "MAX_SENT", most)
    [device] = Viewer(hub).message()["devices"]
    points = session.track.drawn.points
    assert min(len(points), most) / 2 < len(device["points"]) <= most + 1
    assert (device["points"][0], device["points"][-1]) == (points[0], points[-1])
    assert session.status()["rate"] == pytest.approx(100.0, rel=0.02)


def test_points_that_a_thread_moves_while_they_are_read_are_sent_again(hub):
    class Moving:
        """A track that moves right after its points are first read."""

        def __init__(self):
            self.lists, self.revision = [[[1.0]], [[2.0]]], 0

        @property
        def points(self):
            self.revision = 1
            return self.lists.pop(0) if len(self.lists) > 1 else self.lists[0]

    track = SimpleNamespace(drawn=Moving(), places=SimpleNamespace(drawn=[]))
    hub.sessions["phone"] = SimpleNamespace(track=track, status=dict)
    viewer = Viewer(hub)
    messages = [viewer.message()["devices"][0] for _ in range(3)]
    assert [message["points"] for message in messages] == [[[1.0]], [[2.0]], []]
    assert [message["fresh"] for message in messages] == [True, True, False]
    hub.sessions.clear()
