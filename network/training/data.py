"""Training material: recordings, simulated IMU along captured walks, generated walks."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stario.sequences.sequence import STANDARD_GRAVITY, Trajectory
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.walks import generate_walk
from stario.sequences.stream_cache import cached
from stario.sequences.windows import Attitude, WorldStream, world_streams

log = logging.getLogger(__name__)

_SHORTEST = 400
"""Samples of the shortest stretch that is kept, 2 s."""

_SMOOTH = 0.3
"""Deviation of the specific force's size [m/s^2] below which no gait shows."""


@dataclass(frozen=True)
class Material:
    """Streams with how often each is drawn, per second of it.

    Attributes:
        streams: stretches to learn from.
        weights: relative frequency of each.
        words: what they are, for the card.
    """

    streams: list[WorldStream]
    weights: list[float]
    words: list[str]


def gather(
    recorded: Sequence[WorldStream],
    captured: Sequence[WorldStream],
    generated: Sequence[WorldStream],
    shares: tuple[float, float, float] = (0.6, 0.28, 0.12),
) -> Material:
    """Mix three kinds of streams so that each kind makes up its share of the windows."""
    streams: list[WorldStream] = []
    weights: list[float] = []
    words = []
    kinds = zip(
        ("recorded", "simulated along captured walks", "simulated along generated walks"),
        (recorded, captured, generated),
        shares,
        strict=True,
    )
    for kind, members, share in kinds:
        if not members:
            continue
        seconds = sum(len(s) for s in members) / 200.0
        lively = [_liveliness(s) if kind == "recorded" else 1.0 for s in members]
        whole = sum(v * len(s) for v, s in zip(lively, members, strict=True)) / 200.0
        streams += members
        weights += [share * v / whole for v in lively]
        words.append(f"{kind}: {seconds / 60:.0f} min")
    return Material(streams, weights, words)


def _liveliness(stream: WorldStream) -> float:
    """Root mean square of the linear acceleration [m/s^2]: errors are large where it is."""
    linear = stream.imu_W[::10, 3:] - np.array([0.0, 0.0, STANDARD_GRAVITY], np.float32)
    return float(np.sqrt(np.square(linear).sum(axis=1).mean()))


def split_off(
    recordings: Sequence[Sequence[WorldStream]],
) -> tuple[list[WorldStream], list[WorldStream]]:
    """Streams of each recording without its last fifth, and that; scraps below 2 s are lost."""
    first: list[WorldStream] = []
    last: list[WorldStream] = []
    for streams in recordings:
        left = round(0.8 * sum(len(stream) for stream in streams))
        for stream in streams:
            first.append(_cut(stream, 0, left))
            last.append(_cut(stream, max(left, 0), len(stream)))
            left -= len(stream)
    return [s for s in first if len(s) >= _SHORTEST], [s for s in last if len(s) >= _SHORTEST]


def _cut(stream: WorldStream, start: int, stop: int) -> WorldStream:
    part = slice(start, max(stop, start))
    return WorldStream(
        stream.name, stream.imu_W[part], stream.position_W[part], stream.facing_W[part]
    )


def simulated_streams(
    kind: str,
    build: Callable[[], list[WorldStream]],
    folder: Path,
    *depends_on: object,
) -> list[WorldStream]:
    """Simulated streams from the cache in `folder`, built where they are not there yet.

    Args:
        kind: what they are called.
        build: makes them.
        folder: the cache's.
        depends_on: plain values and files that the result depends on besides the code.
    """
    values = [
        [str(x.resolve()), x.stat().st_size, x.stat().st_mtime_ns] if isinstance(x, Path) else x
        for x in depends_on
    ]
    key = {"kind": kind, "values": values, "module": Path(__file__).read_text(encoding="utf-8")}
    return cached(key, build, folder)


def captured_streams(
    walks: dict[str, list[Trajectory]], seed: int, attitude: Attitude = "levelled"
) -> list[WorldStream]:
    """Stretches of a simulated phone's IMU along captured trajectories.

    Captures are smoothed, and the rumble of wheels does not survive it: what then moves too
    smoothly (a trolley) shows nothing of its speed, and would only teach to predict none.
    """
    rng = np.random.default_rng(seed)
    streams = []
    for name, pieces in walks.items():
        for piece in pieces:
            sensor = int(rng.integers(2**31))
            simulated = simulate_imu(piece, 200.0, PHONE_IMU, sensor, name=name)
            if np.linalg.norm(simulated.accel, axis=1).std() > _SMOOTH:
                streams += world_streams(simulated, attitude=attitude)
    return streams


def generated_streams(
    count: int, seconds: float, seed: int, attitude: Attitude = "levelled"
) -> list[WorldStream]:
    """Stretches of a simulated phone's IMU along generated walks."""
    rng = np.random.default_rng(seed)
    streams = []
    for index in range(count):
        walk, sensor = (int(k) for k in rng.integers(2**31, size=2))
        trajectory = generate_walk(walk, seconds)
        name = f"walk-{index}"
        simulated = simulate_imu(trajectory, 200.0, PHONE_IMU, sensor, name=name)
        streams += world_streams(simulated, attitude=attitude)
    return streams
