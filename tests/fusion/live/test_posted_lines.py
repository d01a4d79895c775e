"""Lines of JSON, posted to the server."""

import json


def test_posted_lines_are_accepted_all_or_none(client, hub, walk):
    rows = zip(walk.time[:150].tolist(), walk.gyro.tolist(), walk.accel.tolist(), strict=False)
    lines = [json.dumps({"device": "rig", "t": t, "gyro": g, "accel": a}) for t, g, a in rows]
    ndjson = {"content-type": "application/x-ndjson"}
    broken = client.post("/data", content="\n".join([*lines[:50], "{}"]), headers=ndjson)
    assert (broken.status_code, hub.sessions) == (400, {})
    assert client.post("/data", content="\n".join(lines), headers=ndjson).json() == {"samples": 150}
    assert hub.refused["http"] == 1


def test_the_content_type_of_lines_may_be_in_capitals_and_is_named_where_it_is_missing(client):
    line = json.dumps({"device": "rig", "t": 1, "gyro": [0, 0, 0], "accel": [0, 0, 9.8]})
    headers = {"content-type": "Application/X-NDJSON; charset=utf-8"}
    assert client.post("/data", content=line, headers=headers).status_code == 200
    answer = client.post("/data", content=line, headers={"content-type": "application/json"})
    assert "application/x-ndjson" in answer.json()["error"]


def test_an_invalid_line_is_reported_with_its_number(client):
    lines = [{"device": "rig", "t": t, "gyro": [0, 0, 0], "accel": [0, 0, 9.8]} for t in (1, 2)]
    lines[1]["gyro"] = [0, 0]
    body = "\n".join(map(json.dumps, lines))
    answer = client.post("/data", content=body, headers={"content-type": "application/x-ndjson"})
    assert answer.status_code == 400
    assert answer.json()["error"].startswith("line 2, gyro: found a list")


def test_a_body_of_too_many_devices_is_refused_before_any_is_taken(client, hub):
    lines = [
        {"device": f"rig {k}", "t": 1, "gyro": [0, 0, 0], "accel": [0, 0, 9.8]} for k in range(17)
    ]
    headers = {"content-type": "application/x-ndjson"}
    answer = client.post("/data", content="\n".join(map(json.dumps, lines)), headers=headers)
    assert (answer.status_code, "at most 16" in answer.json()["error"]) == (400, True)
    assert hub.sessions == {}
    sixteen = "\n".join(map(json.dumps, lines[:16]))
    assert client.post("/data", content=sixteen, headers=headers).status_code == 200
    assert len(hub.sessions) == 16
