from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np
import pytest

from stario.network.training.data import (
    SIMULATED,
    Recorded,
    gather,
    split_off,
)
from stario.sequences.errors import ConfigError
from stario.sequences.sequence import STANDARD_GRAVITY
from stario.sequences.windows import WorldStream


def stream(name: str, samples: int) -> WorldStream:
    count = np.arange(samples, dtype=np.float32)[:, None]
    six, three, two = (count + np.zeros(k, np.float32) for k in (6, 3, 2))
    return WorldStream(name, six, three, two)


def test_the_last_fifth_of_each_recording_is_held_out() -> None:
    recordings = of([stream("a", 6000), stream("a", 4000)], [stream("b", 5000)], [])
    first, last = (list(chain(*(r.streams for r in part))) for part in split_off(recordings))
    assert [(s.name, len(s)) for s in first] == [("a", 6000), ("a", 2000), ("b", 4000)]
    assert [(s.name, len(s)) for s in last] == [("a", 2000), ("b", 1000)]
    assert last[0].imu_W[0, 0] == 2000  # where the first part ends


def test_scraps_too_short_to_cut_windows_from_are_lost() -> None:
    first, last = split_off(of([stream("a", 1500)]))
    assert [len(s) for s in first[0].streams] == [1200]
    assert not last[0].streams


def test_kinds_of_streams_make_up_their_shares() -> None:
    recorded = of([stream("a", 3000), stream("a", 1000)])
    material = gather(recorded, [stream("c", 700)], {SIMULATED: 0.05})
    drawn = np.array([len(s) for s in material.streams]) * material.weights
    assert drawn[2:].sum() / drawn.sum() == pytest.approx(0.05)
    assert material.words[0].startswith("recorded")


def test_sources_that_are_named_make_up_their_shares_whatever_their_length() -> None:
    recorded = [
        Recorded(Path("a/long.h5:x"), [moving("x", 1.0)] * 9),
        Recorded(Path("a/short.h5:y"), [moving("y", 1.0)]),
        Recorded(Path("other.csv"), [moving("z", 1.0)]),
    ]
    material = gather(recorded, [], {"long.h5": 0.5, "short.h5": 0.3})
    drawn = {name: 0.0 for name in "xyz"}
    for one, weight in zip(material.streams, material.weights, strict=True):
        drawn[one.name] += weight * len(one)
    assert drawn["y"] / drawn["x"] == pytest.approx(0.6)
    assert drawn["z"] / drawn["x"] == pytest.approx(0.4)
    with pytest.raises(ConfigError, match="shares"):
        gather(recorded, [], {"long.h5": 0.5, "short.h5": 0.5})


def of(*recordings: list[WorldStream]) -> list[Recorded]:
    return [Recorded(Path(str(k)), streams) for k, streams in enumerate(recordings)]


def test_lively_recordings_are_drawn_more_often() -> None:
    calm, lively = moving("calm", 0.5), moving("lively", 1.5)
    material = gather(of([calm], [lively]), [])
    assert material.weights[1] / material.weights[0] == pytest.approx(3.0, rel=1e-3)
    assert sum(material.weights) * len(calm) / 200.0 == pytest.approx(0.6)


def moving(name: str, acceleration: float) -> WorldStream:
    imu_W = np.zeros((2000, 6), np.float32)
    imu_W[:, 3], imu_W[:, 5] = acceleration, STANDARD_GRAVITY
    return WorldStream(name, imu_W, np.zeros((2000, 3), np.float32), np.ones((2000, 2), np.float32))
