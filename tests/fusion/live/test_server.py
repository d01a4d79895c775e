import json
from dataclasses import replace

import numpy as np
import pytest
from starlette.testclient import TestClient

from stario.fusion.live import drawn
from stario.fusion.live.hub import Viewer
from stario.fusion.live.server import MAX_BYTES, live_app
from stario.fusion.live.storage import LiveFile
from stario.sequences import read_recording

from .conftest import (  # fmt: skip
    added,
    command,
    end_of_rerun,
    ends,
    full_disk,
    lines,
    send,
    send_lines,
)


def test_drawn_track_ends_as_that_of_the_recording(client, hub, pushes, new_navigator, walk):
    taken = [answer.json()["samples"] for answer in send(client, pushes())]
    session = hub.sessions["phone"]
    assert sum(taken) == session.track.samples == len(walk)
    np.testing.assert_allclose(ends(session), end_of_rerun(session, new_navigator()), atol=1e-5)
    recording = read_recording(session.track.path)
    np.testing.assert_array_equal(recording.gyro, walk.gyro)
    np.testing.assert_allclose(recording.time, walk.time - walk.time[0], atol=1e-9)


def test_two_phones_of_one_name_are_told_apart_and_the_earlier_is_refused(client, hub, pushes):
    one, two = pushes(seconds=3.0), pushes(session="two", offset_ns=10**18 + 10**6, seconds=3.0)
    answers = send(client, [body for pair in zip(one, two, strict=True) for body in pair])
    refused = [answer for answer in answers if answer.status_code != 200]
    assert len(refused) > len(one) - 5  # all but those before the first sample
    assert "two recordings in turn from 'phone'" in refused[0].json()["error"]
    assert hub.sessions["phone"].track.samples > 240
    assert len(list(hub.sessions["phone"].track.path.parent.iterdir())) <= 2


def test_times_in_milliseconds_are_named_and_do_not_begin_tracks_without_end(client, hub, walk):
    posted = lines(replace(walk, time=1e3 * walk.time))
    for begin in range(0, len(posted), 20):
        assert send_lines(client, posted[begin : begin + 20]).status_code == 200
    session = hub.sessions["rig"]
    assert "give times in s" in session.status()["problem"]
    assert len(list(session.track.path.parent.iterdir())) == 1


def test_stop_ignores_samples_and_start_begins_a_new_track(client, hub, pushes):
    bodies = pushes(seconds=6.0)
    send(client, bodies[:15])
    assert command(client, "stop").status_code == 200
    assert client.post("/data", content=bodies[15]).json() == {"samples": 0}
    session = hub.sessions["phone"]
    assert session.track.samples == 300
    assert command(client, "start").status_code == 200
    send(client, bodies[16:])
    assert session.track.samples == 280


@pytest.mark.parametrize("name", ["a/b", "..", "\x07 bell\n", "<a href='/'>x</a>"])
def test_a_device_of_any_name_can_be_stopped(client, hub, pushes, name):
    send(client, pushes(device=name, seconds=1.0))
    [shown] = hub.sessions
    assert shown.isprintable()
    assert command(client, "stop", shown).json() == {"done": "stop"}
    assert not hub.sessions[shown].running


def test_zero_moves_the_drawn_origin_and_not_the_estimate(client, hub, pushes, new_navigator):
    bodies = pushes(seconds=8.0)
    send(client, bodies[:30])
    session = hub.sessions["phone"]
    command(client, "zero")
    np.testing.assert_allclose(session.status()["origin"], ends(session), atol=1e-3)
    send(client, bodies[30:])
    np.testing.assert_allclose(ends(session), end_of_rerun(session, new_navigator()), atol=1e-5)


def test_tapped_fixes_move_and_rotate_the_whole_drawn_track(client, hub, pushes, new_navigator):
    bodies = pushes(seconds=17.0)
    send(client, bodies[:20])
    session = hub.sessions["phone"]
    shape = np.array(session.track.drawn.points)[:, 1:3]
    assert command(client, "fix", x=50.0, y=-20.0, sigma=0.1).status_code == 200
    moved = np.array(session.track.drawn.points)[: len(shape), 1:3]
    np.testing.assert_allclose(session.track.drawn.points[-1][1:3], [50.0, -20.0], atol=0.2)
    np.testing.assert_allclose(moved - moved[0], shape - shape[0], atol=1e-4)
    send(client, bodies[20:75])
    walked = np.array(session.track.drawn.points[-1][1:3]) - [50.0, -20.0]
    assert np.linalg.norm(walked) > 5.0
    turned = [50.0 - walked[1], -20.0 + walked[0]]  # a quarter turn to the left
    command(client, "fix", x=turned[0], y=turned[1], sigma=0.1)
    np.testing.assert_allclose(session.track.drawn.points[-1][1:3], turned, atol=0.5)
    start = np.array(session.track.drawn.points[len(shape) // 2][1:3])
    before = moved[len(shape) // 2] - [50.0, -20.0]
    np.testing.assert_allclose(start - [50.0, -20.0], [-before[1], before[0]], atol=0.6)
    send(client, bodies[75:])
    np.testing.assert_allclose(ends(session), end_of_rerun(session, new_navigator()), atol=1e-3)
    assert session.status()["fixes"] == 2


def scaled(bodies, factor):
    for body in bodies:
        message = json.loads(body)
        for entry in message["payload"]:
            if entry["name"] == "totalacceleration":
                entry["values"] = {axis: factor * v for axis, v in entry["values"].items()}
        yield json.dumps(message)


def test_apples_sign_and_g_are_converted_by_accel_unit_in_the_address(client, hub, pushes, walk):
    send(client, scaled(pushes(seconds=3.0), -1.0 / 9.80665), "?accel_unit=-g")
    recording = read_recording(hub.sessions["phone"].track.path)
    np.testing.assert_allclose(recording.accel, walk.accel[:300], atol=1e-9)


def test_a_wrong_unit_is_shown_on_the_page_and_the_samples_are_kept(client, hub, pushes):
    send(client, pushes(seconds=3.0), "?accel_unit=g")
    session = hub.sessions["phone"]
    assert "m/s^2" in session.status()["problem"]
    assert len(read_recording(session.track.path)) == 300


def test_malformed_pushes_between_others_are_refused_and_change_nothing(client, hub, pushes):
    for body in pushes(seconds=8.0):
        message = json.loads(body)
        message["payload"][-1]["values"]["z"] = None
        for malformed in (body[:-9], body[9:], json.dumps(message), b"null", b"\xff"):
            answer = client.post("/data", content=malformed)
            assert (answer.status_code, bool(answer.json()["error"])) == (400, True)
        assert client.post("/data", content=body).status_code == 200
    send(client, pushes("undisturbed", seconds=8.0))
    assert [*hub.sessions] == ["phone", "undisturbed"]
    one, other = hub.sessions.values()
    assert one.track.drawn.points == other.track.drawn.points


def test_a_full_disk_is_told_until_it_has_space_and_affects_no_other(
    client, hub, pushes, monkeypatch
):
    append = LiveFile.append

    def only_one_is_full(file, *arguments):
        (full_disk if "full" in file.path.name else append)(file, *arguments)

    bodies = pushes("full", seconds=2.0)
    send(client, bodies[:5])
    monkeypatch.setattr(LiveFile, "append", only_one_is_full)
    full, phone = send(client, bodies[5:6]), send(client, pushes("phone", seconds=1.0))
    assert (full[-1].status_code, "No space" in full[-1].json()["error"]) == (507, True)
    assert all(answer.is_success for answer in phone)
    session = hub.sessions["full"]
    assert "No space left" in session.status()["problem"]
    monkeypatch.setattr(LiveFile, "append", append)
    assert send(client, bodies[5:])[0].is_success
    assert session.status()["problem"] == ""
    assert len(read_recording(session.track.path)) == session.track.samples == 200


def test_a_fix_that_cannot_be_written_moves_nothing(client, hub, pushes, monkeypatch):
    send(client, pushes(seconds=4.0))
    track = hub.sessions["phone"].track
    points = list(track.drawn.points)
    monkeypatch.setattr(LiveFile, "append_fix", full_disk)
    assert command(client, "fix", x=50.0, y=-20.0, sigma=0.1).status_code == 507
    assert track.drawn.points == points


def test_fixes_after_a_gap_leave_the_track_before_it_unchanged(client, hub, pushes):
    bodies = pushes()
    for part in (bodies[:20], bodies[20:60]):
        send(client, part)
        session = hub.sessions["phone"]
        x, y = session.track.drawn.points[-1][1:3]
        command(client, "fix", x=x, y=y, sigma=0.1)
    before = list(session.track.drawn.points)
    for body in pushes(offset_ns=10**18 + 30 * 10**9)[60:90]:  # half a minute is missing
        client.post("/data", content=body)
    assert session.track.drawn.points[-1][9] > 30.0  # yaw sigma [deg]: the direction is lost
    command(client, "fix", x=30.0, y=30.0, sigma=0.1)
    assert session.track.drawn.points[: len(before)] == before
    np.testing.assert_allclose(session.track.drawn.points[-1][1:3], [30.0, 30.0], atol=0.5)


@pytest.mark.parametrize(
    ("body", "headers", "words"),
    [
        (b" " * (MAX_BYTES + 1), {}, "bytes"),
        (None, {"content-encoding": "gzip"}, "send it uncompressed"),
        (None, {"origin": "http://evil.example"}, ""),
        (None, {"host": "evil.example"}, ""),
    ],
)
def test_what_may_not_be_pushed_is_refused(client, hub, pushes, body, headers, words):
    answer = client.post("/data", content=body or pushes()[0], headers=headers)
    assert (answer.status_code, words in answer.text) == (400, True)
    assert hub.sessions == {}


def test_what_is_no_command_is_refused(client, pushes):
    send(client, [pushes("phone1", seconds=0.2)[0]])
    assert client.get("/data").status_code == 405
    assert client.get("/", headers={"host": "evil.example"}).status_code == 400
    assert command(client, "stop", "nobody").status_code == 400
    assert command(client, "explode", "phone1").status_code == 400
    assert command(client, "zero", "phone1").status_code == 400  # no position yet
    assert "frame-ancestors 'none'" in client.get("/").headers["content-security-policy"]
    wrong = [{"x": 1, "y": None, "sigma": 1}, {"x": True, "y": 1, "sigma": 1}]
    for values in ({}, *wrong, {"x": 1, "y": 1, "sigma": 0}):
        answer = command(client, "fix", "phone1", **values)
        assert (answer.status_code, "position" in answer.json()["error"]) == (400, False)


def test_every_request_off_loopback_needs_the_token(hub, pushes):
    body = pushes(seconds=0.2)[0]
    with TestClient(live_app(hub, "secret"), base_url="http://192.168.0.2:8000") as client:
        answers = [client.get(path) for path in ("/", "/events", "/page/plotly.min.js")]
        answers += [client.post(f"/data{query}", content=body) for query in ("", "?token=secre")]
        assert {answer.status_code for answer in [*answers, command(client, "stop")]} == {401}
        assert hub.sessions == {}
        assert client.post("/data?token=secret", content=body).status_code == 200
        bearer = {"authorization": "Bearer secret"}
        client.cookies.clear()
        assert client.post("/data", content=body, headers=bearer).status_code == 200
        assert client.get("/").status_code == 401
        assert client.get("/?token=secret").status_code == 200
        assert client.get("/page/live.js").status_code == 200  # authorised by the page's cookie


def test_viewers_get_new_points_and_after_a_change_the_whole_track(client, hub, pushes):
    bodies = pushes(seconds=6.0)
    send(client, bodies[:15])
    viewer = Viewer(hub)
    (first,) = viewer.message()["devices"]
    assert first["fresh"]
    assert viewer.message()["devices"][0]["points"] == []
    send(client, bodies[15:])
    (second,) = viewer.message()["devices"]
    assert not second["fresh"]
    assert first["points"] + second["points"] == hub.sessions["phone"].track.drawn.points
    command(client, "fix", x=5, y=5, sigma=1)
    (third,) = viewer.message()["devices"]
    assert third["fresh"]
    assert third["points"] == hub.sessions["phone"].track.drawn.points


def test_long_tracks_are_thinned_so_that_memory_stays_small(client, hub, pushes, monkeypatch):
    monkeypatch.setattr(drawn, "MAX_POINTS", 50)
    for body in pushes(seconds=9.0):
        send(client, [body])
        assert len(hub.sessions["phone"].track.drawn.points) <= 50
    assert hub.sessions["phone"].track.drawn.points[-1][0] > 8.0


@pytest.mark.parametrize(("unit", "detected"), [("m/s2", True), ("-m/s2", False)])
def test_apples_sign_is_detected_by_the_attitude(client, hub, walk, pushes, unit, detected):
    def attitude(time):
        quat = walk.truth.at(walk.time[:1] + time).quat_xyzw[0].tolist()
        return dict(zip(("qx", "qy", "qz", "qw"), quat, strict=True))

    bodies = scaled(added(pushes(seconds=3.0), "orientation", attitude), -1.0)
    assert all(answer.is_success for answer in send(client, bodies, f"?accel_unit={unit}"))
    problem = hub.sessions["phone"].status()["problem"]
    assert ("accel_unit=-m/s2" in problem) == detected


@pytest.mark.parametrize(("lag", "first"), [(0, 0), (2, 0), (0, 150)])
def test_a_magnetometer_is_recorded_and_used(client, hub, pushes, new_navigator, walk, lag, first):
    """Its samples may arrive slightly later than the gyroscope's, and its first much later."""
    turned = walk.truth.at(walk.time).attitude_WB
    field = turned.apply([18.0, 5.0, -43.0], inverse=True)
    entries = []
    for t, value in zip(walk.time.tolist(), field.tolist(), strict=True):
        stamp = {"name": "magnetometer", "time": 10**18 + round(t * 1e9)}
        entries.append(stamp | {"values": dict(zip("xyz", value, strict=True))})
    for k, body in enumerate(pushes(seconds=6.0)):
        message = json.loads(body)
        message["payload"] += entries[max(first, 20 * k - lag) : 20 * (k + 1) - lag]
        assert client.post("/data", json=message).status_code == 200
    session = hub.sessions["phone"]
    recording = read_recording(session.track.path)
    np.testing.assert_array_equal(recording.gyro, walk.gyro[:600])
    known = field[first : first + len(recording.magnetometer)]
    np.testing.assert_array_equal(recording.magnetometer.field, known)
    assert 600 - first - len(recording.magnetometer) <= lag + 1
    end = end_of_rerun(session, new_navigator())
    np.testing.assert_allclose(ends(session), end, atol=1e-2 if lag else 1e-5)
