import csv
import json
import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorded import DATA

from stario.fusion.live.merging import MAX_WAIT, Merger
from stario.fusion.live.payload import GYRO, TOTAL, Reading, parse_push
from stario.sequences import read_recording

SECOND = 10**9


def linear(sensor: str, rate: float, offset_ns: int, seconds: float = 2.0, slope: float = 1.0):
    """Readings whose axes are linear in time."""
    times = [offset_ns + round(k * SECOND / rate) for k in range(int(seconds * rate))]
    values = ((slope * t / SECOND, 2.0 * t / SECOND, 3.0 - t / SECOND) for t in times)
    return [Reading(sensor, *pair) for pair in zip(times, values, strict=True)]


def phone(*groups):
    """Readings as an app sends them: in batches of 0.2 s, each sorted by sensor."""
    readings = [r for group in groups for r in group]
    return sorted(readings, key=lambda r: (r.time_ns // (SECOND // 5), r.sensor))


def test_interpolation_is_exact_where_acceleration_is_linear_in_time():
    gyro = linear("gyroscope", 100, 0)
    accel = linear("totalacceleration", 61.7, 1_234_567)
    samples = Merger().add(phone(gyro, accel))
    assert len(samples) > 190
    for t, w, f in samples:
        s = t / SECOND
        assert w == pytest.approx((s, 2 * s, 3 - s), abs=1e-9)
        assert f == pytest.approx((s, 2 * s, 3 - s), abs=1e-9)


def test_linear_acceleration_and_gravity_are_added_at_common_times():
    gyro = linear("gyroscope", 100, 0)
    both = linear("accelerometer", 100, 700_000), linear("gravity", 52, 300_000, slope=5.0)
    samples = Merger().add(phone(gyro, *both))
    assert len(samples) > 190
    for t, _, f in samples:
        s = t / SECOND
        assert f == pytest.approx((6 * s, 4 * s, 6 - 2 * s), abs=1e-9)


def test_total_acceleration_is_preferred_and_uncalibrated_is_the_last_resort():
    gyro, raw = linear("gyroscope", 100, 0), linear("gyroscopeuncalibrated", 100, 0, slope=9.0)
    total = linear("totalacceleration", 100, 0)
    others = linear("accelerometer", 100, 0, slope=7.0), linear("gravity", 100, 0, slope=7.0)
    samples = Merger().add(phone(raw, gyro, *others, total))
    assert samples[100][1:] == (gyro[100].value, total[100].value)
    samples = Merger().add(phone(raw, linear("accelerometeruncalibrated", 100, 0)))
    assert samples[100][1] == raw[100].value


@settings(max_examples=25, deadline=None)
@given(st.lists(st.integers(1, 60), min_size=1, max_size=20))
def test_batches_of_any_size_give_the_same_samples(sizes):
    readings = phone(linear("gyroscope", 100, 0), linear("totalacceleration", 80, 1_000_000))
    whole = Merger().add(readings)
    merger, samples, begin = Merger(), [], 0
    cuts = np.cumsum(sizes) * 5
    for end in [*cuts[cuts < len(readings)].tolist(), len(readings)]:
        samples += merger.add(readings[begin:end])
        begin = end
    assert samples == whole


def test_a_gap_of_the_accelerometer_is_not_interpolated():
    accel = [r for r in linear("totalacceleration", 100, 0) if not 0.5 < r.time_ns / SECOND < 1.0]
    merger = Merger()
    times = [t / SECOND for t, _, _ in merger.add(phone(linear("gyroscope", 100, 0), accel))]
    assert not [t for t in times if 0.505 < t < 0.995]
    assert merger.dropped["without acceleration"] == pytest.approx(49, abs=1)


@pytest.mark.parametrize("stopped", ["gyroscope", "totalacceleration"])
def test_a_sensor_that_stops_is_named_until_it_continues(stopped):
    merger = Merger()
    sensors = [linear(name, 100, 0, seconds=20.0) for name in ("gyroscope", "totalacceleration")]
    readings = phone(*sensors)
    for end in (4, 8, 12, 16):
        group = [r for r in readings if end - 4 <= r.time_ns / SECOND < end]
        merger.add(r for r in group if r.sensor != stopped or end not in (8, 12))
        assert merger.silent == (stopped if end == 12 else "")
        if end == 12 and stopped != "gyroscope":  # those that waited too long are given up
            waited = 8 * SECOND - MAX_WAIT
            expected = pytest.approx(100 * waited / SECOND, abs=2)
            assert merger.dropped["without acceleration"] == expected


def test_a_missing_sensor_is_named():
    merger = Merger()
    merger.add(linear("gyroscope", 100, 0))
    assert "acceleration" in merger.missing
    merger = Merger()
    merger.add(linear("totalacceleration", 100, 0, seconds=30.0))
    assert merger.missing == "gyroscope"


SENSOR_LOGGER = DATA / "raw/sensor_logger/university_loop"


needs_walk = pytest.mark.skipif(not SENSOR_LOGGER.exists(), reason="no Sensor Logger walk")


@needs_walk
def test_a_pushed_real_walk_equals_the_one_read_from_its_files():
    rows = []
    for file, name in (("Gyroscope", GYRO), ("TotalAcceleration", TOTAL)):
        with (SENSOR_LOGGER / f"{file}.csv").open() as table:
            for row in csv.DictReader(table):
                rows.append(Reading(name, int(row["time"]), tuple(float(row[k]) for k in "xyz")))
    rows = phone(rows)
    merger = Merger()
    samples = [s for k in range(0, len(rows), 100) for s in merger.add(rows[k : k + 100])]
    recording = read_recording(SENSOR_LOGGER)
    assert len(samples) == len(recording)
    np.testing.assert_array_equal([s[1] for s in samples], recording.gyro)
    np.testing.assert_allclose([s[2] for s in samples], recording.accel, atol=1e-9)
    time = np.array([s[0] - samples[0][0] for s in samples]) / 1e9
    np.testing.assert_allclose(time, recording.time - recording.time[0], atol=1e-6)


@needs_walk
def test_specific_force_points_up_in_the_reported_attitude_of_a_real_phone():
    folder = SENSOR_LOGGER.parent / "shopping_mall_eight"
    payload = []
    for file in ("Gyroscope", "TotalAcceleration", "Orientation"):
        with (folder / f"{file}.csv").open() as table:
            for _, row in zip(range(120), csv.DictReader(table), strict=False):
                known = {*"xyz", "qx", "qy", "qz", "qw"} & {*row}
                values = {key: float(row[key]) for key in known}
                payload.append({"name": file, "time": row["time"], "values": values})
    merger = Merger()
    merger.add(parse_push(json.dumps({"deviceId": "d", "payload": payload}).encode()).readings)
    assert merger.upward > 0.9


def take(session, bodies, began=0.0):
    """Pass pushes to a session as if five arrived each second."""
    for k, body in enumerate(bodies):
        session.take(parse_push(body), began + 0.2 * k)


def test_shuffled_pushes_give_the_recording_of_ordered_ones(session, pushes, walk):
    bodies = pushes()
    places = [k + 4 * random.Random(k).random() for k in range(len(bodies))]
    take(session, [body for _, body in sorted(zip(places, bodies, strict=True))])
    session.close()
    assert session.track.samples == len(read_recording(session.track.path)) == len(walk)
    assert session.status()["dropped"] == {}


def test_nothing_waits_for_a_push_that_is_missing_in_the_recording_before(session, pushes):
    first, second = (pushes(session=name, offset_ns=k * 10**18) for k, name in ((1, "1"), (2, "2")))
    for body in [first[0], first[2], *second[:4]]:
        session.take(parse_push(body), 0.0)
    assert session.track.samples == 80


def test_what_waits_is_processed_when_the_track_ends(session, pushes):
    bodies = pushes(seconds=4.0)
    take(session, [*bodies[:-2], bodies[-1]])
    assert session.track.samples == 360
    session.stop()
    assert session.track.samples == 380


@pytest.mark.parametrize("seconds", [30, -30])
def test_a_reading_with_a_wild_time_is_dropped_alone(session, pushes, seconds):
    bodies = [parse_push(body) for body in pushes(seconds=8.0)]
    readings = bodies[20].readings
    readings[3] = replace(readings[3], time_ns=readings[3].time_ns + seconds * 10**9)
    track = session.track.drawn
    for k, batch in enumerate(bodies):
        session.take(batch, 0.2 * k)
    assert session.track.drawn is track
    assert session.status()["dropped"] == {"wrong time": 1}
    assert 798 <= session.track.samples <= 800


EMPTY = b'{"messageId": 0, "sessionId": "two", "deviceId": "phone", "payload": []}'


@pytest.mark.parametrize(
    ("order", "samples", "dropped", "tracks"),
    [
        # A push that comes much too late begins no new track.
        (lambda one, two, back: [*one[:20], *one[21:61], one[20], *one[61:]], 1981, 40, 1),
        # A delayed push does not bring back the recording before.
        (lambda one, two, back: [*one[:14], two[0], one[14], *two[1:15]], 300, 40, 2),
        # A clock that was set back within a recording begins a new track.
        (lambda one, two, back: [*one[:15], *back[15:30]], 300, 0, 2),
        # So does a recording that begins with an empty push.
        (lambda one, two, back: [*one[:15], EMPTY, *two[1:20]], 380, 0, 2),
    ],
)
def test_late_pushes_and_other_recordings(session, pushes, order, samples, dropped, tracks):
    second, back = pushes(session="two", offset_ns=10**18 + 10**10), 10**18 - 10**11
    take(session, order(pushes(), second, pushes(offset_ns=back)))
    assert session.track.samples == samples
    assert session.status()["dropped"] == ({"late": dropped} if dropped else {})
    assert any(f"({dropped} late" in w["text"] for w in session.status()["health"]) == (dropped > 0)
    assert len(list(session.track.path.parent.glob("*.csv"))) == tracks
