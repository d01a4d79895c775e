"""Streams that are made: simulated walks, devices on motion capture, bad moments in recordings.

A network that has only seen people walk takes a shake for a walk of one to two metres, which a
stream follows until the next displacement corrects it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from stario.network.training.data import RecordingStreams
from stario.sequences.datasets.stream_cache import cached, recording_stamps
from stario.sequences.errors import InputError
from stario.sequences.readers.archive import archive_attributes
from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.body import places_on, virtual_imu
from stario.sequences.simulation.imu import PHONE_IMU, simulate_imu
from stario.sequences.simulation.insertion import insert_moment
from stario.sequences.simulation.moments import MOMENTS
from stario.sequences.simulation.motion_capture import body_clips, read_body
from stario.sequences.simulation.walks import generate_walk
from stario.sequences.windows import Attitude, WorldStream, world_streams

log = logging.getLogger(__name__)

_WALK_SECONDS = 60.0

_NOT_CARRIED = ("foot",)
"""Places at which nobody carries a phone."""

_DRAWN = ("shake 10 s", "shake 10 s", "shake 10 s", "drop", "table", "standing")
"""Moments in their proportions, without the lift: no second within it tells how fast it moves."""

_AROUND = 8.0
"""Time of the recording on either side of a moment [s]."""

_EVERY, _MOST = 40.0, 8
"""A moment for so many seconds of a recording, at most so many of them."""

_LEARNED = 0.8
"""Share of a recording, from its start, that moments are inserted in: the rest may judge."""


def cached_walks(count: int, seed: int, folder: Path, attitude: Attitude) -> list[WorldStream]:
    """Return streams of a simulated phone's IMU along walks of one minute, cached in `folder`."""
    return _cached(
        "generated", [count, seed, attitude], lambda: _walks(count, seed, attitude), folder
    )


def _walks(count: int, seed: int, attitude: Attitude) -> list[WorldStream]:
    rng = np.random.default_rng(seed)
    streams = []
    for index in range(count):
        walk, sensor = (int(k) for k in rng.integers(2**31, size=2))
        trajectory = generate_walk(walk, _WALK_SECONDS)
        simulated = simulate_imu(trajectory, 200.0, PHONE_IMU, sensor, name=f"walk-{index}")
        streams += world_streams(simulated, attitude=attitude)
    return streams


def virtual_recordings(files: Iterable[Path], seed: int, folder: Path) -> list[RecordingStreams]:
    """Return streams of virtual devices, one at each place on the body, for each clip.

    They are along the true attitude: a clip of a few seconds is too short to be levelled. Clips
    below two seconds are left out. Streams are cached in `folder`.

    Raises:
        ReadError: a file cannot be read.
    """
    recordings: list[RecordingStreams] = []
    for index, clip in enumerate(clip for file in files for clip in body_clips(file)):
        values = [str(clip), recording_stamps(clip), seed, index]
        try:
            found = _cached("virtual", values, partial(_devices_on, clip, (seed, index)), folder)
        except InputError as error:
            log.info("%s: %s", clip, error)
            continue
        licence = str(archive_attributes(clip).get("licence", ""))
        recordings.append(RecordingStreams(clip, found, licence, is_virtual=True))
    return recordings


def _devices_on(clip: Path, seed: tuple[int, int]) -> list[WorldStream]:
    motion = read_body(clip)
    rng = np.random.default_rng(seed)
    streams = []
    for place in places_on(motion):
        if place not in _NOT_CARRIED:
            device = virtual_imu(motion, place, 200.0, PHONE_IMU, int(rng.integers(2**31)))
            streams += world_streams(device, attitude="true")
    return streams


def moment_streams(
    paths: Iterable[Path],
    read: Callable[[Path], ImuSequence],
    options: Mapping[str, object],
    seed: int,
    folder: Path,
) -> list[WorldStream]:
    """Return streams of pieces of recordings with poses, each with a bad moment in its middle.

    Args:
        paths: recordings with poses.
        read: function that reads a path.
        options: what `read` depends on besides the path, as plain values.
        seed: seed of all draws.
        folder: cache folder.
    """

    def build(path: Path, index: int) -> list[WorldStream]:
        return [s for piece in _pieces(read(path), (seed, index)) for s in world_streams(piece)]

    streams: list[WorldStream] = []
    for index, path in enumerate(paths):
        values = [str(path), recording_stamps(path), seed, index, dict(options)]
        streams += _cached("moments", values, partial(build, path, index), folder)
    return streams


def _pieces(sequence: ImuSequence, seed: tuple[int, int]) -> Iterator[ImuSequence]:
    """Yield pieces of a recording with a moment in the middle."""
    rng = np.random.default_rng(seed)
    moments = {moment.name: moment for moment in MOMENTS}
    start = float(sequence.time[0])
    stop = start + _LEARNED * (float(sequence.time[-1]) - start)
    if stop - start < 2.0 * _AROUND or sequence.truth is None:
        return
    for _ in range(int(np.clip((stop - start) / _EVERY, 1, _MOST))):
        moment = moments[str(rng.choice(_DRAWN))]
        at = rng.uniform(start + _AROUND, stop - _AROUND)
        piece, drawn = sequence.slice(at - _AROUND, at + _AROUND), int(rng.integers(2**31))
        if piece.truth is None:
            continue
        try:
            yield insert_moment(piece, piece.truth, moment, 0.5, drawn).sequence
        except InputError as error:  # no pose near its middle, for example
            log.info("%s: %s", sequence.name, error)


def _cached(
    kind: str, values: list[object], build: Callable[[], list[WorldStream]], folder: Path
) -> list[WorldStream]:
    """Return streams from the cache, or build them if they or this file's code are others."""
    key = {"kind": kind, "values": values, "module": Path(__file__).read_text(encoding="utf-8")}
    return [stream for stream in cached(key, build, folder) if isinstance(stream, WorldStream)]
