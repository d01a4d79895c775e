"""Pushes that overtake one another, are repeated or come late do no harm to the track."""

import random
from dataclasses import replace

import pytest

from stario.fusion.live.ordering import MAX_DELAY, PushOrder
from stario.fusion.live.payload import Batch, parse_push
from stario.fusion.live.session import Session
from stario.sequences import read_recording


@pytest.fixture
def session(tmp_path, new_navigator):
    session = Session("phone", tmp_path, new_navigator)
    yield session
    session.close()


def take(session, bodies, began=0.0):
    """Pass pushes to a session as if five arrived each second."""
    for k, body in enumerate(bodies):
        session.take(parse_push(body), began + 0.2 * k)


def numbers(ready):
    return [batch.number for batch, _ in ready]


def test_a_push_waits_for_those_before_it_and_no_longer_than_allowed():
    order, taken = PushOrder(), []
    for number, received in ((4, 0.0), (6, 0.1), (7, 0.2), (5, 0.3), (9, 0.4), (10, 1.1)):
        order.add(Batch("phone", "one", [], number), received)
        taken.append(numbers(order.ready(received)))
    assert taken == [[4], [], [], [5, 6, 7], [], []]
    assert not order.is_due(1.1)
    assert order.is_due(0.4 + MAX_DELAY)
    assert numbers(order.ready(0.4 + MAX_DELAY)) == [9, 10]


def test_batches_without_a_number_and_those_of_another_recording_do_not_wait():
    order = PushOrder()
    for recording, number in (("one", 0), ("one", 2), ("two", 0), ("", -1), ("", -1)):
        order.add(Batch("phone", recording, [], number), 0.0)
    assert numbers(order.ready(0.0)) == [0, 2, 0, -1, -1]


def test_shuffled_pushes_give_the_recording_of_ordered_ones(session, pushes, walk):
    bodies = pushes()
    places = [k + 4 * random.Random(k).random() for k in range(len(bodies))]
    take(session, [body for _, body in sorted(zip(places, bodies, strict=True))])
    session.close()
    assert session.track.samples == len(read_recording(session.track.path)) == len(walk)
    assert session.status()["dropped"] == {}


def test_a_push_that_comes_much_too_late_does_not_begin_a_new_track(session, pushes, walk):
    bodies = pushes()
    delayed = bodies.pop(20)
    take(session, [*bodies[:60], delayed, *bodies[60:]])
    assert session.track.samples == len(walk) - 20
    assert session.status()["dropped"] == {"late": 40}
    assert any("dropped (40 late)" in word["text"] for word in session.status()["health"])
    assert len(list(session.track.path.parent.glob("*.csv"))) == 1


def test_a_delayed_push_does_not_bring_back_the_recording_before(session, pushes):
    first = pushes(seconds=3.0)
    second = pushes(session="two", offset_ns=10**18 + 10**10, seconds=3.0)
    take(session, [*first[:-1], second[0], first[-1], *second[1:]])
    assert session.track.samples == 300
    assert session.status()["dropped"] == {"late": 40}
    assert len(list(session.track.path.parent.glob("*.csv"))) == 2


def test_a_clock_that_was_set_back_within_a_recording_begins_a_new_track(session, pushes):
    bodies = pushes(seconds=6.0)
    take(session, [*bodies[:15], *pushes(seconds=6.0, offset_ns=10**18 - 10**11)[15:]])
    assert session.track.samples == 300
    assert session.status()["dropped"] == {}


def test_what_waits_is_processed_when_the_track_ends(session, pushes):
    bodies = pushes(seconds=4.0)
    take(session, [*bodies[:-2], bodies[-1]])
    assert session.track.samples == 360
    session.stop()
    assert session.track.samples == 380


def test_a_recording_that_begins_with_an_empty_push_begins_a_new_track(session, pushes):
    empty = b'{"messageId": 0, "sessionId": "two", "deviceId": "phone", "payload": []}'
    second = pushes(session="two", offset_ns=10**18 + 10**10, seconds=4.0)[1:]
    take(session, [*pushes(seconds=3.0), empty, *second])
    assert session.track.samples == 380
    assert len(list(session.track.path.parent.glob("*.csv"))) == 2


@pytest.mark.parametrize("seconds", [30, -30, 500])
def test_a_reading_with_a_wild_time_is_dropped_alone(session, pushes, walk, seconds):
    bodies = [parse_push(body) for body in pushes()]
    readings = bodies[20].readings
    readings[3] = replace(readings[3], time_ns=readings[3].time_ns + seconds * 10**9)
    track = session.track.drawn
    for k, batch in enumerate(bodies):
        session.take(batch, 0.2 * k)
    assert session.track.drawn is track
    assert session.status()["dropped"] == {"wrong time": 1}
    assert len(walk) - 2 <= session.track.samples <= len(walk)
