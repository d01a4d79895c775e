"""Training material: recordings, simulated IMU along captured walks, generated walks."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from stario.sequences.sequence import ImuSequence, Trajectory
from stario.sequences.simulate import PHONE_IMU, simulate_imu
from stario.sequences.walks import generate_walk
from stario.sequences.windows import WorldStream, world_streams

log = logging.getLogger(__name__)

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
        seconds = sum(len(s) for s in members) / 200.0
        if not members:
            continue
        streams += members
        weights += [share / seconds] * len(members)
        words.append(f"{kind}: {seconds / 60:.0f} min")
    return Material(streams, weights, words)


def recorded_streams(sequences: Iterable[ImuSequence]) -> list[WorldStream]:
    """Stretches of real recordings."""
    return [stream for sequence in sequences for stream in world_streams(sequence)]


def captured_streams(walks: dict[str, list[Trajectory]], seed: int) -> list[WorldStream]:
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
                streams += world_streams(simulated)
    return streams


def generated_streams(count: int, seconds: float, seed: int) -> list[WorldStream]:
    """Stretches of a simulated phone's IMU along generated walks."""
    rng = np.random.default_rng(seed)
    streams = []
    for index in range(count):
        walk, sensor = (int(k) for k in rng.integers(2**31, size=2))
        trajectory = generate_walk(walk, seconds)
        name = f"walk-{index}"
        streams += world_streams(simulate_imu(trajectory, 200.0, PHONE_IMU, sensor, name=name))
    return streams
