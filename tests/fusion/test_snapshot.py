import gc
import tracemalloc
import zlib
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from simulated import Still
from support import samples, stream

from stario.fusion import FilterConfig, Navigator, NavigatorConfig, NavState, PriorPose
from stario.fusion.filter.alternative import AlternativeHypothesis
from stario.fusion.snapshot import VERSION, plain, unpack
from stario.sequences import ImuSequence, InputError

CONFIG = NavigatorConfig(filter=FilterConfig(update_rate=5))


def push(navigator: Navigator, walk: ImuSequence, start: float, stop: float) -> list[NavState]:
    return stream(navigator, walk.slice(start, stop - 1e-9))


def assert_same(ours: list[NavState], theirs: list[NavState]) -> None:
    assert len(ours) == len(theirs) > 0
    for a, b in zip(ours, theirs, strict=True):
        for name in ("time", "R_WB", "v_W", "p_W", "b_g", "b_a", "covariance", "map_frame"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


STOPS = [("ekf", 0.5), ("ekf", 1.0), ("ekf", 7.37), ("ekf", 12.2), ("ekf", 14.41), ("graph", 14.41)]


@pytest.mark.parametrize(("backend", "stop"), STOPS)
def test_a_restored_stream_continues_bit_for_bit(walk, make_oracle, without, backend, stop):
    """Stopped in the first second, later, or next to a gap, with a prior, and with fixes."""
    holed = without(walk, (walk.time > 12.3) & (walk.time < 13.8))
    accel = holed.accel.copy()
    accel[300] += 400.0
    holed = replace(holed, accel=accel)
    model = make_oracle(holed, walk.truth, CONFIG)

    def late_fix(navigator):
        if navigator.state is not None:
            p = walk.truth.at(np.array([stop - 0.4])).position_W[0]
            navigator.update_position(stop - 0.4, p, 0.01 * np.eye(3))

    prior = PriorPose(np.eye(3), np.ones(3), np.array([5.0, 6.0, 7.0]))
    whole, first, second = (Navigator(model, CONFIG, p, backend) for p in (prior, prior, None))
    for navigator in (whole, first):
        navigator.update_position(stop + 0.5, np.ones(3), np.eye(3))
        navigator.update_position(4.0, np.zeros(3), 0.01 * np.eye(3))
        navigator.update_position(1.0, [np.nan, 0.0, 0.0], np.eye(3))
    push(whole, holed, 0.0, stop)
    push(first, holed, 0.0, stop)
    data = first.snapshot()
    assert isinstance(data, bytes)
    second.restore(data)
    for navigator in (whole, second):
        late_fix(navigator)
    later = stop + 4.0
    states = push(whole, holed, stop, later)
    assert_same(push(second, holed, stop, later), states)
    # A stream is silent until a second after a gap.
    assert not any(12.35 < state.time < 14.75 for state in states)
    assert second.health == whole.health
    assert second.health.fixes["value that is not finite"] == 1


def model_with_card(sha256: str) -> Any:
    return SimpleNamespace(predict=Still().predict, card=SimpleNamespace(sha256=sha256))


def test_a_snapshot_of_another_configuration_or_model_is_refused_by_name(walk):
    navigator = Navigator(model_with_card("abc"), CONFIG)
    push(navigator, walk, 0.0, 2.0)
    coarser = replace(CONFIG, filter=replace(CONFIG.filter, yaw_sigma=0.5))
    for sha256, config, backend, named in (
        ("abc", coarser, "ekf", r"config\.filter\.yaw_sigma.*0\.001.*0\.5"),
        ("def", CONFIG, "ekf", "model: found 'abc'"),
        ("abc", CONFIG, "graph", "backend"),
    ):
        other = Navigator(model_with_card(sha256), config, backend=backend)
        with pytest.raises(InputError, match=named):
            other.restore(navigator.snapshot())
        assert other.state is None


def test_bytes_that_are_no_snapshot_are_refused(walk, still_model):
    """An edited one may have a valid structure: it would be restored, and give other states."""
    navigator = Navigator(still_model, CONFIG)
    push(navigator, walk, 0.0, 3.0)
    data, before = navigator.snapshot(), navigator.state.p_W
    flipped = bytearray(data)
    flipped[data.index(b"front end")] ^= 0x01
    older = data.replace(f" {VERSION}\n".encode(), b" 1\n", 1)
    edited = data.replace(b"false", b"true ", 1), data.replace(b"<f8", b"<i8", 1)
    for bad, words in (
        *((part, "snapshot") for part in (b"", b"nonsense", data[:1000], data[:-30], flipped)),
        *((part, "snapshot: found edited") for part in edited),
        (older, f"version.*1.*{VERSION}"),
    ):
        assert bad != data
        with pytest.raises(InputError, match=words) as caught:
            navigator.restore(bytes(bad))
        assert "\n" not in str(caught.value)
        np.testing.assert_array_equal(navigator.state.p_W, before)


LAYOUTS = {43: "39ef4004"}
"""CRC of the classes and attributes in a snapshot, by version."""


def test_a_snapshot_with_other_classes_or_attributes_has_another_version(walk, still_model):
    """Otherwise an older one would be taken for damaged, or restored in part."""
    found = set()

    def visit(value):
        if isinstance(value, dict):
            if "is" in value:
                names = sorted(name for name, _ in value["has"]["map"])
                found.add(f"{value['is']}: {', '.join(names)}")
            list(map(visit, value.values()))
        elif isinstance(value, list):
            list(map(visit, value))

    zero = np.zeros(3)
    for backend in ("ekf", "graph"):
        navigator = Navigator(still_model, CONFIG, backend=backend)
        navigator.update_position(1.5, zero, 0.01 * np.eye(3))
        navigator.update_yaw(1.8, 0.3, 0.1)
        for time in (2.2, 9.0):
            navigator.update_position(time, zero, np.eye(3))
            navigator.update_velocity(time, zero, np.eye(3))
            navigator.update_yaw(time, 0.3, 0.5)
        for row in samples(walk.select(slice(400))):
            navigator.push_magnetometer(row[0], np.array([20.0 + row[0], 5.0, -40.0]))
            navigator.push_pressure(row[0], 1000.0 + 0.01 * row[0])
            navigator.push(*row)
        visit(plain(unpack(navigator.snapshot()), {}))
    rare = [AlternativeHypothesis(navigator._stream.state.ekf, (0.0,))]
    rare += [PriorPose(np.eye(3), zero, zero)]
    visit(plain(rare, {}))
    names = {line.partition(":")[0] for line in found}
    assert names >= {"FieldState", "FrameTransform", "Fix", "Bearing", "Position", "Yaw"}
    assert names >= {"PressureOffset", "Height", "HeightSample"}
    layout = format(zlib.crc32("\n".join(sorted(found)).encode()), "08x")
    assert LAYOUTS.get(VERSION) == layout, f"raise VERSION, and note its layout {layout} here"


RATE = 50.0


def memory_growth(navigator: Navigator, walk: ImuSequence, warm_up: float, seconds: float) -> int:
    """Growth [bytes], from the half with less of it: caches fill once, leaks grow in both.

    The recording's samples are pushed over and over.
    """
    rows = list(zip(walk.gyro.tolist(), walk.accel.tolist(), strict=True))
    held = []
    tracemalloc.start()
    try:
        for start, stop in pairwise([0.0, warm_up, warm_up + 0.5 * seconds, warm_up + seconds]):
            for k in range(round(start * RATE), round(stop * RATE)):
                navigator.push(k / RATE, *rows[k % len(rows)])
            gc.collect()  # free lists are no growth
            held.append(tracemalloc.get_traced_memory()[0])
        return 2 * min(after - before for before, after in pairwise(held))
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("backend", "warm_up", "seconds", "numbers"),
    [
        ("ekf", 8.0, 12.0, RATE),  # one per sample
        *(
            pytest.param(backend, 120.0, 3600.0, 1.0, marks=pytest.mark.slow)  # and per 2 updates
            for backend in ("ekf", "graph")
        ),
    ],
)
def test_a_streams_memory_is_bounded(make_walk, still_model, backend, warm_up, seconds, numbers):
    """By that many numbers a second, of 16 bytes each."""
    navigator = Navigator(still_model, backend=backend)
    growth = memory_growth(navigator, make_walk(1, 12.0, RATE), warm_up, seconds)
    assert growth < 16 * numbers * seconds
