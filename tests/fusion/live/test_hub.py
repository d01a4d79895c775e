from types import SimpleNamespace

import numpy as np
import pytest

from stario.fusion.live import hub as hub_module
from stario.fusion.live.drawn import DisplayedTrack
from stario.fusion.live.hub import MAX_DEVICES, SILENT_SECONDS, Viewer
from stario.fusion.values.state import NavState
from stario.sequences import about_z, read_recording

from .conftest import command, full_disk, send


@pytest.fixture
def full(client, hub, pushes):
    for k in range(MAX_DEVICES):
        send(client, pushes(f"phone{k}", seconds=1.0))
    return hub


def test_the_device_silent_longest_makes_room_and_its_recording_is_whole(full, client, pushes):
    viewer = Viewer(full)
    viewer.message()
    for k, silent in ((3, 1.5), (5, 2.0)):
        full.sessions[f"phone{k}"].received -= silent * SILENT_SECONDS
    evicted = full.sessions["phone5"]
    send(client, pushes("another", seconds=0.4))
    assert "phone5" not in full.sessions
    assert len(full.sessions) == MAX_DEVICES
    assert len(read_recording(evicted.track.path)) == 100
    send(client, pushes("phone5", seconds=0.4))  # the other silent one makes room
    assert "phone3" not in full.sessions
    sent = {device["id"]: device for device in viewer.message()["devices"]}
    assert sent["phone5"]["fresh"]


def test_no_device_that_sends_makes_room_even_if_stopped(full, client, pushes):
    command(client, "stop", "phone5")
    (answer,) = send(client, pushes("another", seconds=0.2))
    assert (answer.status_code, "at most 16" in answer.json()["error"]) == (400, True)
    assert len(full.sessions) == MAX_DEVICES


def test_a_recording_whose_end_is_lost_makes_room(full, client, pushes, monkeypatch, caplog):
    silent = full.sessions["phone5"]
    silent.received = 0.0
    silent.close()
    monkeypatch.setattr(silent, "close", full_disk)
    send(client, pushes("another", seconds=0.2))
    assert "another" in full.sessions
    assert "the end of its recording is lost" in caplog.text


def state(time, yaw, p_W):
    covariance = np.diag([0.1, 0.1, 0.04, *[0.1] * 3, 4.0, 1.0, 0.5, *[0.1] * 6])
    R_WB, zero = about_z(yaw).as_matrix(), np.zeros(3)
    return NavState(time, R_WB, np.array([0.6, 0.8, 0.0]), np.array(p_W), zero, zero, covariance)


def test_a_new_map_frame_rotates_position_yaw_and_covariance_together():
    track, turn, shift = DisplayedTrack(), about_z(0.5), np.array([5.0, -3.0, 1.0])
    track.add(state(0.0, 0.2, (1.0, 2.0, 3.0)), np.array([0.5, 2.5, 3.0]))
    yaw, sigma = np.degrees([0.2, 0.2])
    expected = [0.0, 1.0, 2.0, 3.0, 1.0, yaw, 4.0, 0.0, 1.0, sigma, 0.5, 2.5]
    np.testing.assert_allclose(track.points, [expected], atol=1e-5)
    before = state(1.0, 0.9, (7.0, 7.0, 3.0))
    track.move(before, state(1.0, 1.4, turn.apply(before.p_W) + shift))
    [point] = track.points
    np.testing.assert_allclose(point[1:4], turn.apply([1.0, 2.0, 3.0]) + shift, atol=1e-4)
    np.testing.assert_allclose(point[10:], (turn.apply([0.5, 2.5, 3.0]) + shift)[:2], atol=1e-4)
    assert point[5] == pytest.approx(np.degrees(0.2 + 0.5), abs=1e-3)
    R = turn.as_matrix()[:2, :2]
    P = [[point[6], point[7]], [point[7], point[8]]]
    np.testing.assert_allclose(P, R @ np.diag([4.0, 1.0]) @ R.T, atol=1e-4)


@pytest.mark.parametrize("most", [7, 1000])
def test_a_new_viewer_gets_no_more_points_than_allowed(client, hub, pushes, monkeypatch, most):
    send(client, pushes(seconds=4.0))
    monkeypatch.setattr(hub_module, "MAX_SENT", most)
    [device] = Viewer(hub).message()["devices"]
    points = hub.sessions["phone"].track.drawn.points
    assert min(len(points), most) / 2 < len(device["points"]) <= most + 1
    assert (device["points"][0], device["points"][-1]) == (points[0], points[-1])
    assert device["rate"] == pytest.approx(100.0, rel=0.02)


def test_points_that_a_thread_moves_while_they_are_read_are_sent_again(hub):
    lists = iter([[[1.0]], [[2.0]]])
    last = [[2.0]]

    class Moving:
        """A track that moves right after its points are first read."""

        points = property(lambda self: next(lists, last))

    track = SimpleNamespace(drawn=Moving(), places=SimpleNamespace(drawn=[]))
    hub.sessions["phone"] = SimpleNamespace(track=track, status=dict)
    viewer = Viewer(hub)
    messages = [viewer.message()["devices"][0] for _ in range(2)]
    assert [message["points"] for message in messages] == [[[1.0]], [[2.0]]]
    assert all(message["fresh"] for message in messages)
    hub.sessions.clear()
