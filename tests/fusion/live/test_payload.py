import json
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from stario.fusion.live.payload import parse_lines, parse_push
from stario.sequences.errors import InputError

VALUES = {"z": 3, "y": 2.5, "x": 1}
PAYLOAD = [
    {"name": "gyroscope", "time": 1698501144401773001, "values": VALUES},
    {"name": "gravity", "time": "1698501144401773002", "x": 0, "y": 0, "z": 9.8},
    {"name": "location", "time": 1, "values": {"latitude": None}},
]
PUSH = {"messageId": 7, "sessionId": "s", "deviceId": "d", "payload": PAYLOAD}
LINE = {"device": "rig", "t": 12.5, "gyro": [1, 2, 3], "accel": [4, 5, 6]}

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=8,
)


def changed(message: dict, path: tuple, value: object) -> bytes:
    copy = json.loads(json.dumps(message))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return json.dumps(copy).encode()


def test_push_keeps_nanoseconds_and_skips_sensors_that_are_not_used():
    batch = parse_push(json.dumps(PUSH).encode())
    assert (batch.device, batch.recording) == ("d", "s")
    gyro, gravity = batch.readings
    assert (gyro.sensor, gyro.time_ns, gyro.value) == (
        "gyroscope", 1698501144401773001, (1.0, 2.5, 3.0),
    )  # fmt: skip
    assert (gravity.sensor, gravity.time_ns, gravity.value) == (
        "gravity", 1698501144401773002, (0.0, 0.0, 9.8),
    )  # fmt: skip


def test_the_vertical_is_that_of_the_attitude_of_the_phone():
    attitude = Rotation.from_rotvec([0.4, -0.9, 0.3])
    values = dict(zip(("qx", "qy", "qz", "qw"), attitude.as_quat().tolist(), strict=True))
    entry = {"name": "orientation", "time": 1698501144401773003, "values": values}
    found = parse_push(changed(PUSH, ("payload", 2), entry)).readings[-1]
    np.testing.assert_allclose(found.value, attitude.inv().apply([0.0, 0.0, 1.0]))


def test_line_is_a_sample_of_both_sensors_at_one_time():
    nameless = {"t_ns": 7, "accel": [0, 0, 9.8]}
    body = "\n".join(map(json.dumps, (LINE, LINE, nameless)))
    rig, other = parse_lines(body.encode(), "http 10.0.0.1")
    assert {r.time_ns for r in rig.readings} == {12_500_000_000}
    assert [r.value for r in rig.readings] == [(1.0, 2.0, 3.0), (4.0, 5.0, 6.0)] * 2
    assert (other.device, other.readings[0].time_ns) == ("http 10.0.0.1", 7)


@pytest.mark.parametrize(
    ("path", "value", "field"),
    [
        (("payload",), None, "payload"),
        (("payload",), {}, "payload"),
        (("deviceId",), "", "deviceId"),
        (("deviceId",), None, "deviceId"),
        (("payload", 0), 5, r"payload\[0\]"),
        (("payload", 0, "name"), None, r"payload\[0\]\.name"),
        (("payload", 0, "time"), -1, r"payload\[0\]\.time"),
        (("payload", 0, "time"), 2**70, r"payload\[0\]\.time"),
        (("payload", 0, "time"), True, r"payload\[0\]\.time"),
        (("payload", 0, "values"), [1, 2, 3], r"payload\[0\]\.values"),
        (("payload", 0, "values", "x"), "1", r"payload\[0\]\.values\.x"),
        (("payload", 0, "values", "x"), None, r"payload\[0\]\.values\.x"),
        (("payload", 0, "values", "x"), float("nan"), r"payload\[0\]\.values\.x"),
        (("payload", 0, "values", "x"), 10**400, r"payload\[0\]\.values\.x"),
        (("payload", 0, "values", "x"), 1e15, r"payload\[0\]\.values\.x"),
        (("payload", 1, "time"), 5, "payload: found times"),
    ],
)
def test_an_invalid_field_is_named(path, value, field):
    with pytest.raises(InputError, match=f"^{field}"):
        parse_push(changed(PUSH, path, value))


@settings(max_examples=40)
@given(st.binary() | json_values.map(lambda value: json.dumps(value).encode()))
@example(b"[" * 100_000)
@example(b"1" * 10_000)
def test_arbitrary_bodies_are_refused(body):
    with pytest.raises(InputError):
        parse_push(body)
    with pytest.raises(InputError):
        parse_lines(b"[" + body, "x")


PATHS = [("payload", 0, "values", "y"), ("payload", 0, "time"), ("payload", 1), ("deviceId",)]


@given(st.sampled_from(PATHS), json_values)
def test_a_push_with_one_arbitrary_field_is_read_or_refused(path, value):
    with suppress(InputError):
        parse_push(changed(PUSH, path, value))


@pytest.mark.parametrize("per_second", [1, 1_000, 1_000_000])
def test_a_push_whose_times_are_not_in_nanoseconds_is_refused_with_the_reason(per_second):
    times = (round((1.7e9 + 0.01 * k) * per_second) for k in range(20))
    payload = [PAYLOAD[0] | {"time": time} for time in times]
    with pytest.raises(InputError, match=r"gyroscope.*nanoseconds"):
        parse_push(json.dumps(PUSH | {"payload": payload}).encode())
