"""Recordings with bad moments inserted, to learn from: shaken, dropped, laid down, held standing.

A network that has only seen people walk takes a shake for a walk of one to two metres, which a
stream follows until the next displacement corrects it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from stario.sequences.datasets.cache_files import recording_stamps
from stario.sequences.datasets.stream_cache import cached
from stario.sequences.errors import InputError
from stario.sequences.sequence import ImuSequence
from stario.sequences.simulation.insertion import insert_moment
from stario.sequences.simulation.moments import MOMENTS
from stario.sequences.windows import WorldStream, world_streams

log = logging.getLogger(__name__)

_DRAWN = ("shake 10 s", "shake 10 s", "shake 10 s", "drop", "table", "standing")
"""Moments in their proportions, without the lift: no second within it tells how fast it moves."""

_AROUND = 8.0
"""Time of the recording on either side of a moment [s]."""

_EVERY, _MOST = 40.0, 8
"""A moment for so many seconds of a recording, at most so many of them."""

_LEARNED = 0.8
"""Share of a recording, from its start, that moments are inserted in: the rest may judge."""


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
    streams: list[WorldStream] = []
    for index, path in enumerate(paths):
        key = {
            "kind": "moments",
            "values": [str(path), recording_stamps(path), seed, index],
            "options": dict(options),
            "module": Path(__file__).read_text(encoding="utf-8"),
        }
        found = cached(key, partial(_built, path, read, (seed, index)), folder)
        streams += [stream for stream in found if isinstance(stream, WorldStream)]
    return streams


def _built(
    path: Path, read: Callable[[Path], ImuSequence], seed: tuple[int, int]
) -> list[WorldStream]:
    return [stream for piece in _pieces(read(path), seed) for stream in world_streams(piece)]


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
